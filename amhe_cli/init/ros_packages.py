"""Folders of ROS packages, from the variables of the environment that ROS sets up."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

#: File that makes a folder a ROS package.
_MANIFEST = "package.xml"

#: The name of a ROS package in its manifest.
_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")


def packages_in(environment: Mapping[str, str]) -> dict[str, Path]:
    """Name of each package in ROS_PACKAGE_PATH and AMENT_PREFIX_PATH -> its folder, the first one found."""
    found: dict[str, Path] = {}
    for folder in _crawled(environment.get("ROS_PACKAGE_PATH", "")):
        named = _NAME.search((folder / _MANIFEST).read_text(encoding="utf-8", errors="replace"))
        found.setdefault(named.group(1) if named else folder.name, folder)
    for prefix in _folders(environment.get("AMENT_PREFIX_PATH", "")):
        for manifest in sorted(prefix.glob(f"share/*/{_MANIFEST}")):
            found.setdefault(manifest.parent.name, manifest.parent)
    return found


def _folders(path: str) -> list[Path]:
    return [Path(part) for part in path.split(os.pathsep) if part]


def _crawled(path: str) -> Iterator[Path]:
    """Packages below the folders of a path; as in ROS, none is looked for inside another."""
    for top in _folders(path):
        for folder, inner, files in os.walk(top):
            if _MANIFEST in files:
                yield Path(folder)
                inner.clear()
            inner[:] = sorted(name for name in inner if not name.startswith("."))
