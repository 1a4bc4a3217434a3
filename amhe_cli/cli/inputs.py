"""What the commands that read logs share: which system the logs are about, and what is read of them."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amhe_cli.cli.kinds import MENAGERIE
from amhe_cli.cli.settings import NONE, Overrides
from amhe_cli.core.yaml_file import merged

if TYPE_CHECKING:
    from amhe_cli.core.log import Log
    from amhe_cli.init.folder import Proposal
    from amhe_cli.system.model.urdf import UrdfOptions
    from amhe_cli.system.system import System


#: What belongs to the logs of a folder, in that folder: their system, noise, priors and settings.
BESIDE = "amhe.toml"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The options --system, --topic, --msg-path, --from, --to, --set and --config.

    Args:
        system: Name or folder of the system; None: the one that the logs name.
        topics: Name of a signal -> topic to read it from.
        msg_path: Folder of .msg files for message types that the logs do not define.
        start, end: Part of each log, in seconds from its start.
        overrides: The user's settings.
    """

    system: str | Path | None = None
    topics: Mapping[str, str] = field(default_factory=dict)
    msg_path: Path | None = None
    start: float | None = None
    end: float | None = None
    overrides: Overrides = NONE

    def open(self, logs: Sequence[Path]) -> System:
        """Load the system that the user named, or else the one that amhe.toml or the logs name.

        What the logs state of their system, such as the size of a box, is taken where the system is theirs;
        amhe.toml beside them wins over that, and the user's settings over both.

        Args:
            logs: Paths of the logs.

        Raises:
            ConfigError: There is no such system, the logs name none or several, or a setting is wrong.
        """
        import logging  # not at the top: --help needs none

        from amhe_cli.core.errors import NOTE
        from amhe_cli.system.description.folders import find_system
        from amhe_cli.system.system import System

        beside = _beside(logs)
        named = self.system or beside.system
        stated = {} if named else _stated(logs)
        folder = find_system(named) if named else _folder_named_in(stated)
        own: dict[str, Any] = {}
        for metadata in stated.values():
            own = merged(own, _own_settings(metadata))
        if beside.system is None or folder.resolve() == find_system(beside.system).resolve():
            own = merged(own, beside.settings)
            if beside.file:
                logging.getLogger(__name__).log(
                    NOTE, "%s says which system and settings these are", beside.file
                )
        settings, schema = self.overrides.suited(folder, own)
        loaded = System.load(folder, settings, schema=schema)
        return loaded.reading(self.topics)

    def names_system(self, logs: Sequence[Path]) -> bool:
        """Whether the user or amhe.toml says which system logs are about."""
        return bool(self.system or _beside(logs).system)

    def read(self, system: System, logs: Sequence[Path]) -> list[Log]:
        """Read logs for a system; where that fails, the error also names what they may be about instead.

        Raises:
            LogError: A log cannot be read, or lacks what the system needs.
        """
        from amhe_cli.core.errors import LogError
        from amhe_cli.logs import read_log

        try:
            return read_log(logs, system, start=self.start, end=self.end, msg_path=self.msg_path)
        except LogError as error:
            others = [name for name in _systems(_stated(logs)) if name != system.name] if self.system else []
            if not others:
                raise
            about = f"{', '.join(others)}, not {system.name}"
            raise LogError(f"{error}. The log says that it is about {about}") from None

    def proposal(
        self, model: Path, logs: Sequence[Path], *, meshes: bool = True, efforts: bool = False
    ) -> Proposal:
        """What `amhe init` makes of a model and logs, with the settings that lie beside these.

        Args:
            model: Its file.
            logs: Paths of the logs.
            meshes: Whether a URDF is read with its meshes.
            efforts: Whether measured torques are compared also where commands are known.

        Raises:
            ConfigError: The model cannot be read, or nothing in the logs is a part of it.
            LogError: A log cannot be read.
        """
        from amhe_cli.init.folder import proposed

        made = proposed(model, logs, self.msg_path, urdf_options(model, meshes), efforts=efforts)
        beside = _beside(logs)
        return replace(made, settings=merged(made.settings, {} if beside.system else beside.settings))

    def of_model(self, model: Path | str, logs: Sequence[Path], folder: Path) -> Inputs:
        """The same for the system that `amhe init` makes of a model and logs.

        Args:
            model: Its file, or the name of one of the menagerie.
            logs: Paths of the logs.
            folder: System folder to write.

        Raises:
            ConfigError: The model cannot be read, or nothing in the logs is a part of it.
            LogError: A log cannot be read.
        """
        import logging

        from amhe_cli.core.errors import NOTE
        from amhe_cli.init.folder import init_system

        path = model_file(model)
        made = init_system(path, logs, folder, msg_path=self.msg_path, force=True, urdf=urdf_options(path))
        for note in made.notes:
            logging.getLogger(__name__).log(NOTE, "%s", note)
        return replace(self, system=str(folder))


def model_file(model: Path | str) -> Path:
    """The file of a model; one of the menagerie is downloaded."""
    from amhe_cli.init.sources import menagerie_model

    return menagerie_model(model.removeprefix(MENAGERIE)) if isinstance(model, str) else model


def urdf_options(
    path: Path, meshes: bool = True, packages: Mapping[str, str] | None = None
) -> UrdfOptions | None:
    """How a URDF is read, with the packages that the environment names and more; None: the file is none."""
    from amhe_cli.init.sources import packages_in
    from amhe_cli.system.model.urdf import UrdfOptions, is_urdf

    more = {name: Path(folder) for name, folder in (packages or {}).items()}
    return UrdfOptions({**packages_in(os.environ), **more}, meshes) if is_urdf(path) else None


@dataclass(frozen=True, slots=True)
class _Beside:
    """What amhe.toml says: a system, and settings as they stand in system.yaml."""

    file: Path | None = None
    system: str | Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


def _beside(logs: Sequence[Path]) -> _Beside:
    """What amhe.toml says, in the folder of the logs.

    Raises:
        ConfigError: It cannot be read, or two folders have one each.
    """
    from amhe_cli.core.errors import ConfigError, one_of

    files = {path.absolute().parent / BESIDE for path in logs}
    found = sorted(file for file in files if file.is_file())
    if not found:
        return _Beside()
    if len(files) > 1:
        raise ConfigError(f"{found[0]}: is beside some of the logs only; give logs of one folder")
    try:
        said = tomllib.loads(found[0].read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{found[0]}: {error}") from None
    keys = ("system", "noise", "priors", "settings")
    if unknown := [key for key in said if key not in keys]:
        raise ConfigError(f"{found[0]}: {one_of('key', unknown[0], keys)}")
    system = said.get("system")
    if system is not None and (found[0].parent / str(system)).is_dir():
        system = found[0].parent / str(system)
    noise, priors = said.get("noise") or {}, said.get("priors") or {}
    described = {
        "signals": {name: {"noise": sd} for name, sd in noise.items()},
        "parameters": {
            name: prior if isinstance(prior, dict) else {"nominal": prior} for name, prior in priors.items()
        },
    }
    settings = merged(said.get("settings") or {}, described)
    return _Beside(found[0], system, {key: value for key, value in settings.items() if value})


def _stated(logs: Sequence[Path]) -> dict[Path, Mapping[str, str]]:
    """What each log says of itself; a data set file is replaced by its logs."""
    from amhe_cli.logs import members, read_metadata

    return {one.path: read_metadata(one.path) for path in logs for one in members(path)}


def _systems(stated: Mapping[Path, Mapping[str, str]]) -> list[str]:
    """The systems that logs name."""
    return sorted({name for metadata in stated.values() if (name := metadata.get("system"))})


def _own_settings(metadata: Mapping[str, str]) -> dict[str, Any]:
    """What a log states of its system, but for its model: a log chooses no file."""
    try:
        own = json.loads(metadata.get("overrides") or "{}")
    except (ValueError, RecursionError):
        return {}  # somebody else's use of the key
    return {key: value for key, value in own.items() if key != "model"} if isinstance(own, dict) else {}


def _folder_named_in(stated: Mapping[Path, Mapping[str, str]]) -> Path:
    """Folder of the bundled system that logs name: a log may choose none of the user's files."""
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.system.description.folders import bundled_systems, named_system

    names = _systems(stated)
    if len(names) > 1:
        listed = ", ".join(names)
        raise ConfigError(f"the logs are about different systems ({listed}); choose one with --system")
    if names:
        return named_system(names[0], ", ".join(map(str, stated)))
    first = next(iter(stated))
    says = f"{first} does not say" if len(stated) == 1 else f"none of the {len(stated)} logs says"
    bundled = ", ".join(bundled_systems())
    raise ConfigError(
        f"{says} which system it is about: name one with --system NAME|DIR (bundled: {bundled}), or describe "
        f"your own: amhe init {_to_describe(first)} -o my_system/"
    )


def _to_describe(log: Path) -> str:
    """Model and log for `amhe init`: those of a bundled example where the log is one."""
    from amhe_cli.core.bundled import bundled_logs, bundled_models

    names = (name for name in bundled_models() if bundled_logs().get(name) == log)
    return next((f"example:{name} example:{name}" for name in names), f"MODEL.xml {log}")
