"""What the commands that read logs share: which system the logs are about, and what is read of them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amhe_cli.cli.settings import Overrides
    from amhe_cli.core.log import Log
    from amhe_cli.system.system import System

#: The system of a log if neither the user nor the log names one.
DEFAULT_SYSTEM = "go1_push"


@dataclass(frozen=True, slots=True)
class Inputs:
    """The options --system, --topic, --msg-path, --from and --to.

    Args:
        system: Name or folder of the system; None: the one that the logs name.
        topics: Name of a signal -> topic to read it from.
        msg_path: Folder of .msg files for message types that the logs do not define.
        start, end: Part of each log, in seconds from its start.
    """

    system: str | None
    topics: Mapping[str, str]
    msg_path: Path | None
    start: float | None
    end: float | None

    def open(
        self, logs: Sequence[Path], overrides: Overrides | None = None, *, boxes_for_meshes: bool = False
    ) -> System:
        """Load the system that the user named, or else the one that the logs name.

        What the logs state of their system, such as the size of a box, is taken where the system is theirs;
        the user's settings win.

        Args:
            logs: Paths of the logs.
            overrides: The user's settings; None: there are none.
            boxes_for_meshes: See `System.load`.

        Raises:
            ConfigError: There is no such system, the logs differ in it, or a setting is wrong.
        """
        from amhe_cli.cli.settings import Overrides
        from amhe_cli.core.yaml_file import merged
        from amhe_cli.system.description.folders import find_system
        from amhe_cli.system.system import System

        own: dict[str, Any] = {}
        if self.system:
            folder = find_system(self.system)
        else:
            folder = _folder_named_by(logs)
            for path in _files(logs):
                own = merged(own, _own_settings(path))
        settings, schema = (overrides or Overrides({}, {})).suited(folder, own)
        loaded = System.load(folder, settings, schema=schema, boxes_for_meshes=boxes_for_meshes)
        return loaded.reading(self.topics)

    def named(self, logs: Sequence[Path]) -> bool:
        """Whether the user or a log names the system; else the default one is tried."""
        return bool(self.system or _systems_of(logs))

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
            if not self.named(logs):
                raise LogError(_unnamed(logs, str(error))) from None
            named = set(_systems_of(logs).values())
            if self.system and named - {system.name}:
                about = f"{', '.join(sorted(named))}, not {system.name}"
                raise LogError(f"{error}. The log says that it is about {about}") from None
            raise


def bundled_log() -> Path:
    """The log that is replayed if none is given: a Go1 pushes a box onto another floor."""
    from amhe_cli.system.description.folders import bundled_logs

    return bundled_logs()["t4"]


def _systems_of(logs: Sequence[Path]) -> dict[Path, str]:
    """The system that each log names, if it names one."""
    from amhe_cli.logs import read_metadata

    return {path: str(name) for path in _files(logs) if (name := read_metadata(path).get("system"))}


def _files(logs: Sequence[Path]) -> list[Path]:
    """The logs, each data set file replaced by its logs."""
    from amhe_cli.logs import members

    return [one.path for path in logs for one in members(path)]


def _own_settings(path: Path) -> dict[str, Any]:
    """What a log states of its system."""
    from amhe_cli.logs import read_metadata

    try:
        own = json.loads(read_metadata(path).get("overrides") or "{}")
    except (ValueError, RecursionError):
        return {}  # somebody else's use of the key
    return own if isinstance(own, dict) else {}


def _folder_named_by(logs: Sequence[Path]) -> Path:
    """Folder of the bundled system that logs name: a log may choose none of the user's files."""
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.system.description.folders import named_system

    names = sorted(set(_systems_of(logs).values()))
    if len(names) > 1:
        listed = ", ".join(names)
        raise ConfigError(f"the logs are about different systems ({listed}); choose one with --system")
    return named_system(names[0] if names else DEFAULT_SYSTEM, ", ".join(map(str, logs)))


def _unnamed(logs: Sequence[Path], error: str) -> str:
    from amhe_cli.system.description.folders import bundled_logs, bundled_models, bundled_systems

    examples = (f"example:{name}" for name in bundled_models() if bundled_logs().get(name) == logs[0])
    own = next((f"{name} {name}" for name in examples), f"MODEL.xml {logs[0]}")
    what = error.partition("; there is: ")[0]  # the rest is about signals of a system that is not the log's
    says = "the log does not say" if len(logs) == 1 else f"none of the {len(logs)} logs says"
    return (
        f"{what} ({says} which system it is about, and {DEFAULT_SYSTEM} was tried): name one with --system "
        f"NAME|DIR (bundled: {', '.join(bundled_systems())}), or describe your own: amhe init {own} "
        f"-o my_system/"
    )
