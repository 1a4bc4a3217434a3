"""Where models come from: the MuJoCo Menagerie by name, and folders of ROS packages."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

from amhe_cli.core.errors import ConfigError, one_of


def menagerie_names() -> list[str]:
    """Names of the models; none without the package."""
    try:
        import mujoco_menagerie
    except ImportError:
        return []
    return mujoco_menagerie.names()


def menagerie_model(name: str) -> Path:
    """The XML file of a model, which the package downloads on first use.

    Args:
        name: `MODEL`, such as unitree_go2, for its scene with a floor or else the robot alone; `MODEL/FILE`,
            such as unitree_go2/go2, for another file of it.

    Raises:
        ConfigError: The package is not installed, has no such model, or cannot download it.
    """
    try:
        import mujoco_menagerie
    except ImportError:
        raise ConfigError(
            f"menagerie:{name} needs the package mujoco-menagerie: pip install 'amhe[robots]'; or give the "
            "model's XML file in a clone of the MuJoCo Menagerie"
        ) from None
    robot, _, entry = name.partition("/")
    if robot not in menagerie_names():
        raise ConfigError(one_of("model of the menagerie", robot, menagerie_names()))
    try:
        return mujoco_menagerie.get(robot).xml(entry or None)
    except mujoco_menagerie.DownloadError as error:
        folder = mujoco_menagerie.Cache().model_path(mujoco_menagerie.get(robot))
        raise ConfigError(
            f"menagerie:{name}: {error}; offline, copy the folder {folder} from a computer that has it"
        ) from None
    except mujoco_menagerie.MenagerieError as error:
        raise ConfigError(f"menagerie:{name}: {error}") from None


#: File that makes a folder a ROS package.
_MANIFEST = "package.xml"

#: The name of a ROS package in its manifest.
_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")


def packages_in(environment: Mapping[str, str]) -> dict[str, Path]:
    """Name of each package in ROS_PACKAGE_PATH and AMENT_PREFIX_PATH -> its folder, the first one found."""
    found: dict[str, Path] = {}
    for top in _folders(environment.get("ROS_PACKAGE_PATH", "")):
        for name, inner, files in os.walk(top):
            inner[:] = [] if _MANIFEST in files else sorted(one for one in inner if not one.startswith("."))
            if _MANIFEST in files:  # as in ROS, no package is looked for inside another
                folder = Path(name)
                named = _NAME.search((folder / _MANIFEST).read_text(encoding="utf-8", errors="replace"))
                found.setdefault(named.group(1) if named else folder.name, folder)
    for prefix in _folders(environment.get("AMENT_PREFIX_PATH", "")):
        for manifest in sorted(prefix.glob(f"share/*/{_MANIFEST}")):
            found.setdefault(manifest.parent.name, manifest.parent)
    return found


def _folders(path: str) -> list[Path]:
    return [Path(part) for part in path.split(os.pathsep) if part]
