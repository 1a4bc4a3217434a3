"""From a recording to a `Log`: decode the requested signals, choose clocks, convert to SI, resample."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import overload

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.bundled import example
from amhe_cli.core.corrections import corrected
from amhe_cli.core.each_log import trended
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Log, warn_of
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Measured, Series, Signal, remapped
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import readable
from amhe_cli.logs.data_set import is_data_set, members, only_member
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.survey import Inspection, SignalCheck, survey
from amhe_cli.logs.tracks import grid_of, read_tracks, series_of, warn_of_gaps


@overload
def read_log(
    paths: str | Path,
    system: Measured,
    *,
    topics: Mapping[str, str] | None = None,
    start: float | None = None,
    end: float | None = None,
    msg_path: str | Path | None = None,
) -> Log: ...
@overload
def read_log(
    paths: Sequence[str | Path],
    system: Measured,
    *,
    topics: Mapping[str, str] | None = None,
    start: float | None = None,
    end: float | None = None,
    msg_path: str | Path | None = None,
) -> list[Log]: ...
def read_log(
    paths: str | Path | Sequence[str | Path],
    system: Measured,
    *,
    topics: Mapping[str, str] | None = None,
    start: float | None = None,
    end: float | None = None,
    msg_path: str | Path | None = None,
) -> Log | list[Log]:
    """Read what a system needs from one log or several, onto the clock of its model.

    Args:
        paths: A log of any format that docs/logs.md lists, `example:NAME`, or a sequence of them; in a
            sequence, a LeRobot dataset stands for all its episodes, and a data set file for all its logs.
        system: Says which topics are read, and the time step.
        topics: Name of a signal -> topic to read it from instead.
        start, end: Part of each log, in seconds from its start.
        msg_path: Folder of .msg files for message types that the log does not define.

    Returns:
        One log for a single path, a list for a sequence.

    Raises:
        ConfigError: A path does not exist, or an argument makes no sense.
        LogError: A log cannot be read, or lacks what the system needs.
    """
    if start is not None and end is not None and end <= start:
        raise ConfigError(f"`end`: {end:g} is not after `start` {start:g}")
    given = [example(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    found = [(path, one) for path in given for one in members(path, system)]
    if any(is_data_set(path) for path in given) and (start is not None or end is not None):
        raise ConfigError("`start` and `end`: a data set file says which part of each log counts: from, to")
    if isinstance(paths, str | Path) and len(found) > 1:
        only_member(given[0])
    folder, settings = None if msg_path is None else Path(msg_path), system.settings.logs
    how = {"topics": dict(topics or {}), "start": start, "end": end, "msg_path": folder and str(folder)}
    logs = []
    for path, one in found:
        first, last = (start, end) if one.start is None and one.end is None else (one.start, one.end)
        signals = remapped(system.signals, {**(topics or {}), **one.topics})
        log = read_signals(one.path, signals, system.dt, settings, start=first, end=last, msg_path=folder)
        warn_of(log, system)
        log = log.with_(known=one.known, own=one.own, held_out=one.held_out)
        logs.append(replace(log, reading={"path": str(path), **how}, units=system.units))
    if trend := list(dict.fromkeys(name for _, one in found for name in one.trend)):
        logs = trended(logs, trend)
    return logs[0] if isinstance(paths, str | Path) else logs


def inspect_log(
    path: Path,
    system: Measured | None = None,
    *,
    start: float | None = None,
    end: float | None = None,
    msg_path: Path | None = None,
) -> Inspection:
    """See what is in a log, and how it suits a system.

    Args:
        path: Path of the log.
        system: The system that the log is checked for; None: the log is only surveyed.
        start, end, msg_path: See `read_log`.

    Raises:
        LogError: The log cannot be read at all.
    """
    found = survey(path, msg_path=msg_path)
    if system is None:
        return Inspection(found)
    dt, settings = system.dt, system.settings.logs

    def read(*signals: Signal) -> Log | str:
        """The log with these signals; in words, why it cannot be read."""
        try:
            return read_signals(path, signals, dt, settings, start=start, end=end, msg_path=msg_path)
        except LogError as error:
            return str(error).removeprefix(f"{path}: ")

    checks = []
    for signal in system.signals:
        alone = read(signal)
        problem = alone if isinstance(alone, str) else None  # as it would stop `identify`
        valid = alone.usable(tuple(alone.series)).mean() if isinstance(alone, Log) and alone.steps else 0.0
        checks.append(SignalCheck(signal, problem, float(valid)))
    if any(check.problem for check in checks):
        return Inspection(found, system.name, tuple(checks))
    log = read(*system.signals)
    if isinstance(log, str):
        return Inspection(found, system.name, tuple(checks), problem=log)
    warn_of(log, system)
    return Inspection(found, system.name, tuple(checks), log.duration, log=log)


def read_signals(
    path: Path,
    signals: Sequence[Signal],
    dt: float,
    settings: LogSettings,
    *,
    start: float | None = None,
    end: float | None = None,
    msg_path: Path | None = None,
    warn: bool = True,
) -> Log:
    """Read the given signals of one log onto one uniform clock.

    Row 0 is the first instant at which every signal has begun, in phase with the first message of the
    state topic that begins last: a log recorded at multiples of `dt` is taken over as it is. Commands are
    held until the next one, states interpolated, orientations along the arc; silences longer than
    `settings.max_gap` (or five periods of the topic) stay invalid.

    An odometry's linear velocity is turned from its child frame into the world. A TwistStamped, whose frame
    ROS leaves to the sender, is taken as it is: linear velocity in the world, angular in the body's frame.

    Args:
        path: A .mcap, .db3 or .bag file, or a rosbag2 folder.
        signals: What to read; topics that are not named are not decoded.
        dt: Step of the clock [s].
        settings: Clock and gap settings.
        start: Where to begin [s], counted from row 0.
        end: Where to stop [s], counted from row 0.
        msg_path: Folder of .msg files for types that the log does not define.
        warn: Warn of long gaps.

    Raises:
        ConfigError: If the path does not exist, or a signal or option makes no sense.
        LogError: If the log is unreadable, or lacks a requested topic, joint or quantity.
    """
    if not signals or not dt > 0:
        raise ConfigError("reading a log takes at least one signal and a positive time step")
    with readable(path):
        log = open_log(path)
        tracks = read_tracks(log, signals, Definitions(msg_path), settings)
        grid, start_ns = grid_of(path, tracks, dt, start, end)
        series: dict[str, Series] = {}
        for track in tracks:
            of_signal = series_of(path, track, grid, start_ns, settings.max_gap)
            if warn:
                warn_of_gaps(path, track.signal, of_signal, dt)
            series |= of_signal
    begun = 0.0 if start is None else dt * np.ceil(start / dt - 1e-6)
    return Log(dt, corrected(series, signals, dt, begun), str(path), start_ns, log.metadata, path)


#: A JointState whose names are the parameters, and whose positions are their values.
TOPIC = "/amhe/truth"
#: Resolution in time [s]; and no silence is too long for a truth to hold.
_STEP, _FOREVER = 0.01, 1e9


def read_truth(path: Path, stamps_ns: IntArray, settings: LogSettings) -> dict[str, FloatArray]:
    """Values on `/amhe/truth` at some instants; {} where the log has no such topic.

    Args:
        path: The log.
        stamps_ns: The instants [ns] on the log's clock, shape (n,).
        settings: Clock settings.

    Returns:
        Parameter -> values, shape (n,). Each holds until the next; NaN before the first.
    """
    lasting = settings.model_copy(update={"max_gap": _FOREVER})
    try:
        log = read_signals(path, [Signal("truth", TOPIC, ("position",), is_input=True)], _STEP, lasting)
    except LogError:
        return {}
    series = log["truth.position"]
    row = np.floor((stamps_ns - log.start_ns) / (1e9 * _STEP) + 1e-6).astype(int)
    held = np.clip(row, 0, log.steps - 1)
    known = (row >= 0) & series.valid[held]
    return {
        name: np.where(known, series.values[held, column], np.nan)
        for column, name in enumerate(series.columns)
    }


def truth_in_metadata(logs: Sequence[Log]) -> dict[str, float]:
    """True parameters in the logs' metadata, as simulations write them; {} if they differ or are none."""
    texts = {log.metadata.get("truth") for log in logs}
    try:
        truth = json.loads(texts.pop() or "{}") if len(texts) == 1 else {}
        return {str(name): float(value) for name, value in truth.items()}
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}  # somebody else's use of the key
