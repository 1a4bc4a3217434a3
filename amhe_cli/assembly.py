"""Paths and options become objects: a system, trajectories, a belief to start from."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from amhe_cli.core.belief_file import read_belief
from amhe_cli.core.errors import ConfigError, LogError, one_of
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Belief
from amhe_cli.core.signals import Signal
from amhe_cli.logs import Inspection, SignalCheck, read_metadata, read_signals, survey
from amhe_cli.system import overrides
from amhe_cli.system.load import bundled_systems, find_system
from amhe_cli.system.system import System

#: What a log is taken to be about when neither it nor the user says.
DEFAULT_SYSTEM = "go1_push"


@dataclass(frozen=True, slots=True)
class LogSource:
    """Where logs are, and what to take from them.

    Args:
        paths: Log files and rosbag2 folders.
        topics: Signal name -> topic to read it from instead.
        msg_path: Folder of `.msg` files for types that the log does not define.
        start, end: Part of each log, in seconds from its start.
    """

    paths: tuple[Path, ...]
    topics: Mapping[str, str]
    msg_path: Path | None
    start: float | None
    end: float | None

    def __post_init__(self) -> None:
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise ConfigError(f"--to {self.end:g} is not after --from {self.start:g}")


@dataclass(frozen=True, slots=True)
class IdentifyProblem:
    """All that an identification starts from.

    Args:
        system: What is identified.
        training, held_out: Its logs; no held-out ones: a share of the training logs.
        prior: A belief to start from.
        truth: Parameters that the logs themselves call true, as simulated ones do; nothing is fitted to it.
    """

    system: System
    training: tuple[Log, ...]
    held_out: tuple[Log, ...] | None
    prior: Belief | None
    truth: Mapping[str, float]


def identify_problem(
    source: LogSource,
    held_out: Sequence[Path],
    system: str | None,
    assignments: Sequence[str],
    config: Path | None,
    belief: Path | None,
) -> IdentifyProblem:
    """Read everything that `amhe identify` needs.

    Raises:
        ConfigError: A setting, the system folder or the belief is wrong.
        LogError: A log cannot be read, or lacks what the system needs.
    """
    fitted = {path.resolve() for path in source.paths}
    for path in held_out:
        if path.resolve() in fitted:
            raise ConfigError(f"{path}: is both fitted and held out; validation needs a log of its own")
    loaded = open_system(system, source, assignments, config)
    prior = read_belief(belief, loaded) if belief else None
    training = understood(loaded, source, system)
    validation = trajectories(loaded, replace(source, paths=tuple(held_out), start=None, end=None))
    return IdentifyProblem(loaded, training, validation or None, prior, told_truth(training))


def understood(loaded: System, source: LogSource, named: str | None) -> tuple[Log, ...]:
    """The logs' trajectories; where that fails, the error also says what the logs may be about instead.

    Args:
        loaded: The system.
        source: The logs.
        named: What the user called the system; None: the logs were asked, or the default taken.

    Raises:
        LogError: A log cannot be read, or lacks what the system needs.
    """
    try:
        return trajectories(loaded, source)
    except LogError as error:
        about = {str(name) for path in source.paths if (name := read_metadata(path).get("system"))}
        if not named and not about:
            raise LogError(f"{error}. {_unnamed(source.paths)}") from None
        if named and about - {loaded.name}:
            others = ", ".join(sorted(about))
            raise LogError(f"{error}. The log says that it is about {others}, not {loaded.name}") from None
        raise


def _unnamed(logs: Sequence[Path]) -> str:
    known = ", ".join(bundled_systems())
    return (
        f"{_listed(logs)} does not say which system it is about, and was taken for {DEFAULT_SYSTEM}: "
        f"name one with --system NAME|DIR (bundled: {known}), or describe your own: "
        f"amhe init MODEL.xml LOG -o my_system/"
    )


def told_truth(logs: Sequence[Log]) -> dict[str, float]:
    """The `truth` of the logs' metadata, a JSON object of numbers; {} where they disagree or have none."""
    said = {log.metadata.get("truth") for log in logs}
    try:
        truth = json.loads(said.pop() or "{}") if len(said) == 1 else {}
        return {str(name): float(value) for name, value in truth.items()}
    except (ValueError, TypeError, AttributeError):
        return {}  # somebody else's idea of the key: not for us


def open_system(
    name: str | None, source: LogSource, assignments: Sequence[str] = (), config: Path | None = None
) -> System:
    """Load the system that the user named, or else the one that the logs name, with its topics remapped."""
    folder = find_system(name) if name else _folder_of(source.paths)
    settings = overrides.gathered(config, os.environ, assignments)
    own = _own_overrides(source.paths) if name is None else {}
    return _remapped(System.load(folder, overrides.merged(own, settings)), source.topics)


def _own_overrides(logs: Sequence[Path]) -> dict[str, Any]:
    """What the logs say of the system they are about, such as the size of their box; the user's word wins."""
    said: dict[str, Any] = {}
    for path in logs:
        try:
            own = json.loads(read_metadata(path).get("overrides") or "{}")
        except ValueError:
            continue  # somebody else's idea of the key: not for us
        said = overrides.merged(said, own if isinstance(own, dict) else {})
    return said


def system_of(logs: Sequence[Path]) -> str:
    """Name of the system that the logs say they are about; they must agree."""
    named = {path: str(name) for path in logs if (name := read_metadata(path).get("system"))}
    names = sorted(set(named.values()))
    if len(names) > 1:
        raise ConfigError(
            f"the logs are about different systems ({', '.join(names)}); choose one with --system"
        )
    if names:
        return names[0]
    return DEFAULT_SYSTEM


def _folder_of(logs: Sequence[Path]) -> Path:
    name = system_of(logs)
    try:
        return find_system(name)
    except ConfigError:
        raise ConfigError(
            f"{_listed(logs)}: about the system {name!r}, which does not come with amhe: "
            f"give its folder with --system DIR"
        ) from None


def inspections(source: LogSource, system: str | None) -> list[Inspection]:
    """Look through every log, and hold it against the system that the user or the log names, if any."""
    return [_inspection(replace(source, paths=(path,)), system) for path in source.paths]


def _inspection(source: LogSource, system: str | None) -> Inspection:
    found = survey(source.paths[0], msg_path=source.msg_path)
    if not system and not found.metadata.get("system"):
        if source.topics or source.start is not None or source.end is not None:
            raise ConfigError("--topic, --from and --to are about a system's signals: name it with --system")
        return Inspection(found)
    held = open_system(system, source)
    checks = tuple(_checked(held, signal, source) for signal in held.signals)
    if any(check.problem for check in checks):
        return Inspection(found, held.name, checks)
    try:
        whole = trajectories(held, source)[0]
    except LogError as error:
        return Inspection(found, held.name, checks, problem=_without_path(error, source))
    return Inspection(found, held.name, checks, whole.duration)


def _checked(system: System, signal: Signal, source: LogSource) -> SignalCheck:
    """Read one signal alone: whatever would stop `identify` is found in the same words."""
    try:
        alone = trajectories(replace(system, signals=(signal,)), source)[0]
    except LogError as error:
        return SignalCheck(signal, _without_path(error, source), 0.0)
    valid = alone.usable(tuple(alone.series))
    return SignalCheck(signal, None, float(valid.mean()) if valid.size else 0.0)


def _without_path(error: LogError, source: LogSource) -> str:
    return str(error).removeprefix(f"{source.paths[0]}: ")


def trajectories(system: System, source: LogSource) -> tuple[Log, ...]:
    """One trajectory per log, on the model's clock."""
    return tuple(
        read_signals(
            path,
            system.signals,
            system.model.opt.timestep,
            system.settings.logs,
            start=source.start,
            end=source.end,
            msg_path=source.msg_path,
        )
        for path in source.paths
    )


def _remapped(system: System, topics: Mapping[str, str]) -> System:
    """The system with some signals read from other topics."""
    names = [signal.name for signal in system.signals]
    for name in topics:
        if name not in names:
            raise ConfigError(f"--topic: {one_of('signal', name, names)}")
    return replace(
        system,
        signals=tuple(replace(s, topic=topics.get(s.name, s.topic)) for s in system.signals),
    )


def _listed(paths: Sequence[Path]) -> str:
    return str(paths[0]) if len(paths) == 1 else f"none of the {len(paths)} logs"
