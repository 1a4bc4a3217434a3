"""System folders by path and by name; quick to import, as completion needs it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.yaml_file import YamlFile

#: The file that makes a folder a system.
FILE_NAME = "system.yaml"


def bundled_systems() -> dict[str, Path]:
    """Names and folders of the systems that come with amhe."""
    return {p.parent.name: p.parent for p in sorted((bundled_root() / "models").glob(f"*/{FILE_NAME}"))}


def find_system(name_or_dir: str | Path) -> Path:
    """Folder of a system: a path to it, or the name of a bundled one.

    Raises:
        ConfigError: Neither exists; the text lists the bundled ones.
    """
    folder = Path(name_or_dir).expanduser()
    if (folder / FILE_NAME).is_file():
        return folder
    if folder.name == FILE_NAME and folder.is_file():
        return folder.parent
    bundled = bundled_systems()
    if str(name_or_dir) in bundled:
        return bundled[str(name_or_dir)]
    if folder.is_dir():
        raise ConfigError(f"{folder}: no {FILE_NAME} in this folder; `amhe init` writes one")
    raise ConfigError(f"{one_of('system', str(name_or_dir), bundled)} (or any folder with a {FILE_NAME})")


def named_system(name: str, source: str, folder: str | None = None) -> Path:
    """Folder of the bundled system that a file names: a file chooses none of the user's folders.

    Args:
        name: Name of the system in the file.
        source: The file.
        folder: The folder that the file names, if any: it is shown, not opened.

    Raises:
        ConfigError: It is a system of the user's, who gives its folder.
    """
    bundled = bundled_systems().get(name)
    if folder is not None or bundled is None:
        raise ConfigError(
            f"{source}: about the system {name!r}{f' in {folder}' if folder else ''}, which does not come "
            f"with amhe: give its folder with `system={folder or 'DIR'}`"
        )
    return bundled


def parameter_names(folder: Path) -> list[str]:
    """Names under `parameters:` in a system folder, as they stand there; nothing is checked."""
    try:
        named = YamlFile(folder / FILE_NAME, patient=True).own.get("parameters")
    except ConfigError:
        return []
    return [str(name) for name in named] if isinstance(named, Mapping) else []
