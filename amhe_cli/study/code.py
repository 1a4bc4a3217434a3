"""Versions and hashes of everything that decides a cell's result, besides the cell itself."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path

import amhe_cli
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.system.provenance import sha256, system_files, versions
from amhe_cli.system.system import System

#: The rooms and files whose code runs in a cell; a test runs one and looks for others.
RUN_IN_CELLS = (
    "core", "logs", "system", "engine", "matching", "estimation", "control", "live", "robots",
    "study/__init__.py", "study/cells.py", "study/code.py", "study/results.py", "study/run.py",
)  # fmt: skip


@cache
def code() -> dict[str, str]:
    """Versions of the libraries, and hashes of our sources and of the robot's model."""
    files = system_files(System.load(SYSTEM, warn=False))
    numbers = {name: version for name, version in versions().items() if name != "python"}
    return {**numbers, "sources": _hash(source_files(Path(amhe_cli.__file__).parent)), "model": _hash(files)}


def source_files(package: Path) -> dict[str, str]:
    """Hashes of the source files that run in cells, by their path in the package."""
    places = [package / name for name in RUN_IN_CELLS]
    files = [file for place in places for file in ([place] if place.is_file() else place.rglob("*.py"))]
    return {file.relative_to(package).as_posix(): sha256(file) for file in files}


def _hash(files: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:12]
