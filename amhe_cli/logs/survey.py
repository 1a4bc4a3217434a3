"""The content of a log: topics, rates, gaps, clocks, and reasons why something cannot be read."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import IntArray
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Signal
from amhe_cli.logs.clocks import Clock, Stamp, Timeline, header_steps, offset_words, step_words, timeline
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import Batch, Connection, messages, readable
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.decode import SignalSamples, nanoseconds, time_leaves
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import Layout
from amhe_cli.logs.messages.split import MessageGroup, Splitter
from amhe_cli.logs.messages.types import TYPES, TypeInfo
from amhe_cli.logs.tables import table_columns

#: Messages that it takes to judge a topic's clock by.
_ENOUGH = 10
#: Silence of all topics [s] behind which few stamps are no part of the recording.
_FAR = 10.0
#: Share of all messages that is the recording, where silences divide them.
_NEARLY_ALL = 0.99
#: Paths of times, which are no measurements.
_TIME_PATHS = re.compile(r"(^|\.)(stamp|time_from_start)(\.|$)|(^|\.)header\.")


@dataclass(frozen=True, slots=True)
class TopicSurvey:
    """One topic of a log.

    Args:
        name, type, encoding: Name, type and encoding as the log declares them; type as 'pkg/msg/Type'.
        count: Number of messages.
        rate: Rate from the median period [Hz]; 0 for fewer than two messages.
        longest_gap: Longest silence [s], and
        gap_at: when it begins [s from the log's first message].
        first_ns, last_ns: First and last stamp [ns] on each clock: 'header' (where set), 'publish', 'log'.
        header: State of the header stamps: 'none' (the type has no header), 'unset', 'partly set',
            'not monotone' or 'good'.
        clock: The clock that would be used: 'header', 'publish' or 'log'.
        quantities: Quantities that signals can read without naming fields; an array that is empty in every
            message counts as absent.
        entries: Names in it: joints, child frames; '[n]' for an array of n numbers.
        paths: Paths of the numbers in every message of a type that is not built in, for the `fields` of a
            signal -> their count where the path is of an array.
        problem: Why it cannot be read, in words; None if it can.
        notes: Anomalies of its stamps or messages, in words.
    """

    name: str
    type: str
    encoding: str
    count: int
    rate: float
    longest_gap: float
    gap_at: float
    first_ns: Mapping[str, int]
    last_ns: Mapping[str, int]
    header: str
    clock: Clock
    quantities: tuple[str, ...]
    entries: tuple[str, ...]
    paths: Mapping[str, int | None]
    problem: str | None
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Survey:
    """What is in a log.

    Args:
        path: Path of the log.
        format: Name of the format: 'MCAP', 'rosbag2 sqlite3', 'ROS 1 bag'.
        duration: Time from the first message to the last, by the recorder's clock [s].
        topics: Topics by name.
        problems: What is damaged, in words.
        metadata: The record named 'amhe'.
        offsets: Clock offsets between topics above 5 ms, in words.
    """

    path: Path
    format: str
    duration: float
    topics: tuple[TopicSurvey, ...]
    problems: tuple[str, ...]
    metadata: Mapping[str, str]
    offsets: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SignalCheck:
    """Whether a log has what one signal of a system needs.

    Args:
        problem: Why the signal cannot be read, in words; None if it can.
        valid: Share of the time in which the signal is measured, gaps left out.
    """

    signal: Signal
    problem: str | None
    valid: float


@dataclass(frozen=True, slots=True)
class Inspection:
    """What is in one log, and whether a system can use it.

    Args:
        survey: What is in the log.
        system: Name of the system that the log was checked for; None: it was checked for none.
        checks: One check for each of the system's signals.
        duration: Time in which all signals are there [s].
        problem: Why the log cannot be used, though each signal can be read; None if it can be used.
        log: The log as the system reads it; None where it cannot.
        remarks: What is wrong in it, in sentences.
    """

    survey: Survey
    system: str | None = None
    checks: tuple[SignalCheck, ...] = ()
    duration: float = 0.0
    problem: str | None = None
    log: Log | None = None
    remarks: tuple[str, ...] = ()

    @property
    def usable(self) -> bool | None:
        """Whether `identify` can use the log; None where it was checked for no system."""
        if self.system is None:
            return None
        return self.problem is None and not any(check.problem for check in self.checks)


@dataclass(slots=True)
class _Scan:
    """Counts and stamps of one connection.

    Args:
        splitter: Sorts its messages; None: they cannot be read.
        info: Where its type keeps its quantities; None: it is not built in.
    """

    splitter: Splitter | None = None
    info: TypeInfo | None = None
    log_ns: list[IntArray] = field(default_factory=list)
    publish_ns: list[IntArray] = field(default_factory=list)
    header_ns: list[IntArray] = field(default_factory=list)
    entries: dict[str, None] = field(default_factory=dict)
    carried: dict[str, None] = field(default_factory=dict)
    paths: dict[str, int | None] | None = None
    has_header: bool = False

    def take(self, batch: Batch) -> None:
        header_ns = _zeros(batch.starts.size)
        for group in self.splitter.split(batch) if self.splitter else ():
            if (stamps := self._look(group)) is not None:
                header_ns = header_ns if header_ns.flags.writeable else np.array(header_ns)
                header_ns[group.members] = stamps
        self.log_ns.append(batch.log_ns)
        self.publish_ns.append(batch.publish_ns)
        self.header_ns.append(header_ns)

    def _look(self, group: MessageGroup) -> IntArray | None:
        """Notes what is in the messages, and returns their header stamps."""
        layout = group.layout
        self.entries |= dict.fromkeys(_entries(layout))
        if self.info is None:
            here = {p: leaf.count for p, leaf in layout.leaves.items() if not _TIME_PATHS.search(p)}
            known = here if self.paths is None else self.paths
            self.paths = {path: size for path, size in known.items() if here.get(path, 0) == size}
        else:
            self.carried |= dict.fromkeys(_carried(layout, self.info))
        for path in ("header.stamp", "stamp", "transforms[0].header.stamp", "transforms[0].stamp"):
            if leaves := time_leaves(layout, path):
                self.has_header = True
                return nanoseconds(group.rows, leaves)
        return None

    def samples(self) -> SignalSamples:
        """The stamps by log time; what a file does not have takes no memory."""
        one_clock = all(a is b for a, b in zip(self.log_ns, self.publish_ns, strict=True))
        log_ns = _joined(self.log_ns)
        sorts = bool(np.any(log_ns[1:] < log_ns[:-1]))
        order = np.argsort(log_ns, kind="stable") if sorts else slice(None)
        log_ns = log_ns[order]
        publish_ns = log_ns if one_clock else _joined(self.publish_ns)[order]
        header_ns = _joined(self.header_ns)[order] if self.has_header else _zeros(log_ns.size)
        return SignalSamples(log_ns, publish_ns, header_ns, _zeros(log_ns.size), {}, {}, self.has_header)


def _zeros(count: int) -> IntArray:
    return np.broadcast_to(np.int64(0), count)


def _joined(parts: list[IntArray]) -> IntArray:
    """All parts in one array, which takes their place."""
    parts[:] = [np.concatenate([*parts, _zeros(0)])]
    return parts[0]


def survey(
    path: Path, *, msg_path: Path | None = None, watch: Callable[[Batch], None] | None = None
) -> Survey:
    """Look through a whole log; damage is reported, not raised, as long as anything can be read.

    Args:
        path: A .mcap, .db3 or .bag file, or a rosbag2 folder.
        msg_path: Folder of .msg files for types that the log does not define.
        watch: Called with each batch of messages.

    Raises:
        ConfigError: If the path does not exist.
        LogError: If it is not a log, or nothing in it can be read.
    """
    with readable(path):
        log = replace(open_log(path), watch=watch)
        definitions = Definitions(msg_path)
        scans: dict[Connection, _Scan] = {}
        for batch in log.batches(None):
            connection = batch.connection
            if connection not in scans:
                usable = definitions.problem(connection) is None
                splitter = Splitter(connection, definitions) if usable else None
                scans[connection] = _Scan(splitter, TYPES.get(connection.type))
            scans[connection].take(batch)
        for connection in log.connections:
            scans.setdefault(connection, _Scan())
        samples = {connection: scan.samples() for connection, scan in scans.items()}
        origin, duration = _span(samples)
        steps = {connection: header_steps(found) for connection, found in samples.items()}
        # As in reading: where one topic's header clock steps, only the recorder's is common to all.
        stamp: Stamp = "log" if any(steps.values()) else "auto"
        topics, lags = [], {}
        for connection in sorted(scans, key=lambda connection: (connection.topic, connection.type)):
            found, jumps = samples[connection], steps[connection]
            times = (
                timeline(found, "log" if _mixes_frames(connection) else stamp) if found.log_ns.size else None
            )
            if times is not None and times.clock == "header" and found.log_ns.size >= _ENOUGH:
                lags[connection.topic] = times.lag
            if jumps and times is not None:
                note = f"{step_words(jumps)}: the recorder's stamps are used for all topics"
                times = replace(times, notes=(note, *times.notes))
            problem = definitions.problem(connection)
            topics.append(_topic(connection, scans[connection], found, times, stamp, origin, problem))
    words = tuple(offset_words(lags))
    return Survey(path, log.format, duration, tuple(topics), tuple(log.problems), log.metadata, words)


def read_metadata(path: Path) -> dict[str, str]:
    """The MCAP metadata record named 'amhe' of a log; {} where there is none.

    Raises:
        ConfigError: If the path does not exist.
        LogError: If it is not a log.
    """
    with readable(path):
        return {key: value for file in open_log(path).files for key, value in file.read_metadata().items()}


def _span(samples: Mapping[Connection, SignalSamples]) -> tuple[int, float]:
    """First stamp [ns] and duration [s] by the recorder's clock, stamps far from nearly all others left out.

    A ULog has what was last said before the recording, with its stamp of then.
    """
    stamps = [timeline(s, "log").stamps_ns for s in samples.values() if s.log_ns.size]
    if not stamps:
        return 0, 0.0
    every = np.concatenate(stamps)
    del stamps
    every.sort()
    most = max(np.split(every, np.flatnonzero(np.diff(every) > _FAR * 1e9) + 1), key=len)
    every = most if most.size >= _NEARLY_ALL * every.size else every
    return int(every[0]), int(every[-1] - every[0]) / 1e9


def _mixes_frames(connection: Connection) -> bool:
    """Whether a topic's messages are of several frames: only reading one frame can judge its own clock."""
    info = TYPES.get(connection.type)
    return bool(info and info.elements and not info.names)


def _topic(
    connection: Connection,
    scan: _Scan,
    samples: SignalSamples,
    times: Timeline | None,
    stamp: Stamp,
    origin: int,
    problem: str | None,
) -> TopicSurvey:
    """What there is to say of a topic.

    Args:
        connection: The topic.
        scan: What is in its messages.
        samples: Stamps of all its messages.
        times: The stamps that reading it would use; None: it has no messages.
        stamp: The clock that another topic's steps demand, or 'auto'.
        origin: First stamp of the log [ns].
        problem: Why it cannot be read.
    """
    info, damaged = scan.info, scan.splitter.damaged if scan.splitter else 0
    damage = (f"{messages(damaged)} damaged ({scan.splitter.reason})",) if scan.splitter and damaged else ()
    clock, header = times.clock if times else "log", _header(samples)
    if times and _mixes_frames(connection) and stamp == "auto" and samples.header_ns.all():
        clock, header = "header", "good"
    rate = gap = gap_at = 0.0
    if times and times.kept.size > 1:
        periods = np.diff(times.stamps_ns) / 1e9
        widest = int(np.argmax(periods))
        gap = float(periods[widest])
        rate = float(1.0 / np.median(periods, overwrite_input=True))
        gap_at = (int(samples.log_ns[times.kept[widest]]) - origin) / 1e9
    header_ns = samples.header_ns[samples.header_ns != 0]
    stamps = {"header": header_ns, "publish": samples.publish_ns, "log": samples.log_ns}
    return TopicSurvey(
        name=connection.topic,
        type=connection.type,
        encoding=connection.encoding,
        count=samples.log_ns.size,
        rate=rate,
        longest_gap=gap,
        gap_at=gap_at,
        first_ns={clock: int(s[0]) for clock, s in stamps.items() if s.size},
        last_ns={clock: int(s[-1]) for clock, s in stamps.items() if s.size},
        header=header,
        clock=clock,
        quantities=tuple(q for q in info.fields if q in scan.carried or not scan.carried) if info else (),
        entries=tuple(scan.entries) or table_columns(connection),
        paths=(scan.paths or {}) if connection.encoding != TABLE else {},
        problem=problem,
        notes=(*damage, *(times.notes if times else ())),
    )


def _header(samples: SignalSamples) -> str:
    if not samples.has_header:
        return "none"
    present = samples.header_ns != 0
    if not present.any():
        return "unset"
    if not present.all():
        return "partly set"
    return "good" if np.all(np.diff(samples.header_ns) > 0) else "not monotone"


def _entries(layout: Layout) -> list[str]:
    """Names of joints and child frames; '[n]' for an array of n numbers."""
    names = [*layout.names("name"), *layout.names("joint_names")]
    frames = [text for path, text in layout.strings.items() if path.split(".")[-1] == "child_frame_id"]
    data = layout.leaves.get("data")
    sizes = [f"[{data.count}]"] if data is not None and data.count is not None else []
    return [*names, *frames, *sizes]


def _carried(layout: Layout, info: TypeInfo) -> list[str]:
    """Quantities with values in this layout; an empty array, such as an unmeasured effort, is absent."""
    count = layout.counts.get(info.elements, 0) if info.elements else 1
    prefixes = [f"{info.elements}[{i}]." if info.elements else "" for i in range(count)]
    return [
        quantity
        for quantity, paths in info.fields.items()
        if any(layout.columns(prefix + paths[0]) for prefix in prefixes)
    ]
