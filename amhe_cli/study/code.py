"""Versions and hashes of everything that decides a cell's result, besides the cell itself."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import amhe_cli
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.system.provenance import sha256, system_files, versions
from amhe_cli.system.system import System

#: The module that runs cells: what it imports, directly or not, makes their results.
_RUNS_CELLS = "amhe_cli.study.run"


@cache
def code() -> dict[str, str]:
    """Versions of the libraries, and hashes of our sources and of the robot's model."""
    sources = source_hash(_RUNS_CELLS, Path(amhe_cli.__file__).parent)
    files = system_files(System.load(SYSTEM, warn=False))
    model = hashlib.sha256(json.dumps(files, sort_keys=True).encode())
    numbers = {name: version for name, version in versions().items() if name != "python"}
    return {**numbers, "sources": sources, "model": model.hexdigest()[:12]}


def source_hash(module: str, package: Path) -> str:
    """Hash over the source files of a module and of all that it imports; see `imported_by`."""
    digest = hashlib.sha256()
    for name, path in sorted(imported_by(module, package).items()):
        digest.update(f"{name} {sha256(path)}\n".encode())
    return digest.hexdigest()[:12]


def imported_by(module: str, package: Path) -> dict[str, Path]:
    """Files of a module and of all modules of the package that it imports, directly or not.

    Imports inside functions count; those for type checking alone do not. The package's own `__init__` does
    not count either: it holds the version, which `code` has, and names that are imported on demand.

    Args:
        module: Dotted name of the module.
        package: Folder of the top-level package that the module is in.
    """
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = _file_of(name, package)
        if path is not None and name not in found:
            found[name] = path
            waiting += _imports(ast.parse(path.read_bytes()))
            waiting.append(name.rpartition(".")[0])  # importing a module runs its package's __init__
    return found


def _file_of(name: str, package: Path) -> Path | None:
    """Source file of a module below the package; None for any other name."""
    if not name.startswith(f"{package.name}."):
        return None
    place = package.parent.joinpath(*name.split("."))
    candidates = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in candidates if path.is_file()), None)


def _imports(tree: ast.AST) -> Iterator[str]:
    """Dotted names that a syntax tree imports; of `from a import b` both a and a.b, which may be a module."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names))
        elif not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            yield from _imports(node)
