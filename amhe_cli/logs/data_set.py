"""Data set files: logs, and what is known of each of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from amhe_cli.core.each_log import mistakes_of
from amhe_cli.core.errors import LogError, one_of
from amhe_cli.core.mistakes import validated
from amhe_cli.core.signals import Measured
from amhe_cli.core.yaml_file import Place, YamlFile
from amhe_cli.logs.containers.lerobot import episode_paths

#: Endings of a data set file's name.
SUFFIXES = (".yaml", ".yml")


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    log: Annotated[str, Field(min_length=1)]
    begin: FiniteFloat | None = Field(None, alias="from")
    end: FiniteFloat | None = Field(None, alias="to")
    held_out: bool = False
    known: dict[str, FiniteFloat] = {}
    own: list[str] | dict[str, str] = []
    topics: dict[str, str] = {}


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    logs: Annotated[list[_Entry], Field(min_length=1)]
    trend: list[str] = []


#: What would be valid, by key.
_EXAMPLES = {
    "known": "a mapping such as {gain: 0.2, load: 0.49}",
    "own": "a list of parameters",
    "trend": "a list of parameters",
    "topics": "a mapping from signals to topics",
    "logs": "a list such as [{log: run1.mcap}, {log: run2.mcap}]",
}


@dataclass(frozen=True, slots=True)
class Member:
    """One log of a data set, or of none.

    Args:
        path: Path of the log.
        start, end: Part of the log [s]; None: its start and its end.
        topics: Signal -> topic to read it from.
        known, own, held_out: See `Log`.
        trend: Parameters that change along a straight line in time, over all logs of the data set.
    """

    path: Path
    start: float | None = None
    end: float | None = None
    topics: dict[str, str] = field(default_factory=dict)
    known: dict[str, float] = field(default_factory=dict)
    own: list[str] | dict[str, str] = field(default_factory=list)
    held_out: bool = False
    trend: tuple[str, ...] = ()


def is_data_set(path: Path) -> bool:
    """Whether a path is that of a data set file."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def members(path: Path, system: Measured | None = None) -> list[Member]:
    """The logs of a data set file; of any other path that log, or the episodes of a LeRobot dataset.

    Args:
        system: The system that the file's parameters and signals must be of; None: any.

    Raises:
        ConfigError: The file is no data set; one line for each mistake, `file:line:column: what`.
    """
    if not is_data_set(path):
        return [Member(one) for one in episode_paths(path)]
    file = YamlFile(path)
    content = validated(file, _File, _EXAMPLES)
    for number, entry in enumerate(content.logs):
        for key, text in _mistakes(path.parent, entry, system):
            file.problem(("logs", number, *key), text)
    if system is not None:
        for _, text in mistakes_of({}, content.trend, system.space, system.fixed):
            file.problem(("trend",), text)
    file.raise_problems()
    trend = tuple(content.trend)
    return [
        Member(one, entry.begin, entry.end, entry.topics, entry.known, entry.own, entry.held_out, trend)
        for entry in content.logs
        for one in episode_paths(path.parent / entry.log)
    ]


def only_member(path: Path) -> Member:
    """The one log of a path.

    Raises:
        LogError: It holds several.
    """
    found = members(path)
    if len(found) > 1:
        raise LogError(f"{path} holds {len(found)} logs; name one, such as {found[0].path}")
    return found[0]


def _mistakes(folder: Path, entry: _Entry, system: Measured | None) -> list[tuple[Place, str]]:
    """Mistakes of an entry of the right shape, and their keys."""
    found: list[tuple[Place, str]] = []
    if not (folder / entry.log.partition("#")[0]).exists():
        found.append((("log",), f"no file or folder {entry.log!r} beside this file"))
    if entry.begin is not None and entry.end is not None and entry.end <= entry.begin:
        found.append((("to",), f"to: {entry.end:g} is not after from: {entry.begin:g}"))
    if system is not None:
        found += mistakes_of(entry.known, entry.own, system.space, system.fixed)
        names = [signal.name for signal in system.signals]
        found += [
            (("topics", name), one_of("signal", name, names)) for name in entry.topics if name not in names
        ]
    return found
