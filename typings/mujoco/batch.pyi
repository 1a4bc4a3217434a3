"""MuJoCo ships no type stubs: whatever is taken from it has any type."""

from typing import Any

def __getattr__(name: str) -> Any: ...
