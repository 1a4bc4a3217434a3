"""A test that fails with a page open leaves a picture of it in its folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.view.browser import Browser, picture_of_failure


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Function) -> Iterator[None]:
    """Run a test."""
    shown, folder = item.funcargs.get("opened"), item.funcargs.get("tmp_path")
    if isinstance(shown, Browser) and isinstance(folder, Path):
        with picture_of_failure(shown, folder):
            return (yield)
    return (yield)
