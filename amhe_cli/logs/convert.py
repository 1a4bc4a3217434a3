"""A log as tables: CSV, npz, or a folder of CSV files, in the form that is read without a word."""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.files import filling, whole
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Measured, Signal, remapped
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import Batch, Connection, readable
from amhe_cli.logs.containers.table_file import START, clock_among, unit_of
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.types import TYPES
from amhe_cli.logs.survey import Survey, TopicSurvey, read_metadata, survey
from amhe_cli.logs.tables import fields_of, table_columns, table_name
from amhe_cli.logs.tracks import SignalTrack, read_tracks

logger = logging.getLogger(__name__)


_TIME = "time [s]"
#: Numbers of which the text is made at once.
_NUMBERS = 2**18


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Columns that share their times.

    Args:
        stamps_ns: Times [ns], strictly increasing, shape (n,).
        names: Name of each column.
        values: SI values, NaN where there is none, shape (n, k).
    """

    stamps_ns: IntArray
    names: tuple[str, ...]
    values: FloatArray


def joined(parts: Sequence[Columns]) -> Columns:
    """Columns side by side, a row for each time that any of them has, NaN where one has no such time."""
    stamps = np.unique(np.concatenate([part.stamps_ns for part in parts]))
    values = np.full((stamps.size, sum(len(part.names) for part in parts)), np.nan)
    place = 0
    for part in parts:
        values[np.searchsorted(stamps, part.stamps_ns), place : place + len(part.names)] = part.values
        place += len(part.names)
    return Columns(stamps, tuple(name for part in parts for name in part.names), values)


def write_csv(path: Path, table: Columns, metadata: Mapping[str, str], start_ns: int) -> None:
    """Write a CSV file.

    Args:
        path: The file; it appears whole.
        table: Its columns.
        metadata: Metadata of the log: a comment in the first line.
        start_ns: The stamp that its times count from.
    """
    head = io.StringIO()
    if text := _metadata_text(metadata, start_ns):
        head.write(f"# amhe: {text}\n")
    csv.writer(head, lineterminator="\n").writerow([_TIME, *map(_in_si, table.names)])
    with whole(path) as file:
        file.write(head.getvalue().encode())
        seconds = ((table.stamps_ns - start_ns) / 1e9)[:, None]
        size = 1 + _NUMBERS // (1 + len(table.names))
        for first in range(0, len(seconds), size):
            block = slice(first, first + size)
            rows = np.concatenate([seconds[block], table.values[block]], axis=1).tolist()
            lines = (",".join([repr(v) if v == v else "" for v in row]) for row in rows)
            file.write(("\n".join(lines) + "\n").encode())


def write_npz(path: Path, table: Columns, metadata: Mapping[str, str], start_ns: int) -> None:
    """Write an .npz file of an array for each column; see `write_csv`."""
    arrays = {_TIME: (table.stamps_ns - start_ns) / 1e9}
    arrays |= {_in_si(name): column for name, column in zip(table.names, table.values.T, strict=True)}
    if text := _metadata_text(metadata, start_ns):
        arrays["amhe"] = np.array(text)
    with whole(path) as file, ZipFile(file, "w") as archive:  # np.savez allows no array called "file"
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def _metadata_text(metadata: Mapping[str, str], start_ns: int) -> str:
    """Metadata with the stamp of time 0, as JSON; '' where there is nothing."""
    content = dict(metadata) | ({START: str(start_ns)} if start_ns else {})
    return json.dumps(content) if content else ""


def _in_si(name: str) -> str:
    """The header of a column that is in SI units, whatever unit its name ends in."""
    return f"{name} [SI]" if unit_of(name)[1] else name


#: Endings of the files that are written; a path without an ending is a folder of CSV files.
FORMS = (".csv", ".npz", "")
#: A longer array in a message is an image or a cloud of points; such a topic has no place in a table.
_LONGEST = 1000
#: Messages between two calls of `Progress`.
_SHOWN = 100_000
#: Called with the number of messages that have been read.
Progress = Callable[[int], None]


def convert(
    path: str | Path,
    out: str | Path,
    system: Measured | None = None,
    *,
    topics: Mapping[str, str] | None = None,
    msg_path: str | Path | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write a log as tables, with its metadata.

    The times count from the log's first sample, and values are in SI units. Signals or topics
    with clocks of their own share the rows of one table, with blank cells; in a folder, each has a file of
    its own.

    Args:
        path: A log of any format that docs/logs.md lists; of a LeRobot dataset, one episode.
        out: What to write: a file that ends in .csv or .npz; without an ending, a folder of CSVs.
        system: Only its signals are written, called by their names; None: everything that is numeric.
        topics: Name of a signal of the system -> topic to read it from instead.
        msg_path: Folder of .msg files for message types that the log does not define.
        force: Replace a file that exists; write into a folder that is not empty.
        progress: Called now and then with the number of messages read.

    Raises:
        ConfigError: `out` exists, or has another ending; or an argument makes no sense.
        LogError: The log cannot be read, or lacks what the system needs.
    """
    path, out = Path(path), Path(out)
    check_out(out, force)
    signals = None if system is None else remapped(system.signals, topics or {})
    settings = LogSettings() if system is None else system.settings.logs
    folder = None if msg_path is None else Path(msg_path)
    watch = _counter(progress)
    with readable(path):
        log = replace(open_log(path), watch=watch)
        metadata = read_metadata(path)
        tables = [one for one in log.connections if table_columns(one)]
        only_tables = signals is None and 0 < len(tables) == len(log.connections)
        if only_tables:
            wanted = [_of_table(one) for one in tables]
        else:
            wanted = signals or _of_topics(survey(path, msg_path=folder, watch=watch))
        # a system's own offsets are left for those who read the result
        tracks = read_tracks(log, [replace(one, offset=0.0) for one in wanted], Definitions(folder), settings)
    parts = _columns(tracks, plain=signals is None)
    start_ns = min(int(part.stamps_ns[0]) for group in parts.values() for part in group)
    out.parent.mkdir(parents=True, exist_ok=True)
    if not out.suffix:
        files: dict[str, str] = {}
        for name in parts:
            if (other := files.setdefault(table_name(name), name)) != name:
                raise ConfigError(f"{out}: topics {other!r} and {name!r} would share a file; write .csv")
        with filling(out) as filled:
            for name, group in parts.items():
                write_csv(filled / f"{table_name(name)}.csv", joined(group), metadata, start_ns)
        return
    as_it_was = only_tables and len(tables) == 1
    named = [
        replace(part, names=tuple(column if as_it_was else f"{name}.{column}" for column in part.names))
        for name, group in parts.items()
        for part in group
    ]
    write = write_npz if out.suffix == ".npz" else write_csv
    write(out, joined(named), metadata, start_ns)


def check_out(out: Path, force: bool) -> None:
    """Refuse a place to write to, before any work is done.

    Raises:
        ConfigError: It exists and `force` is not given, or its ending is none of `FORMS`.
    """
    if out.suffix not in FORMS:
        raise ConfigError(
            f"{out}: a log is written as .csv, .npz, or, without an ending, as a folder; rosbags-convert, "
            "which comes with amhe, writes bags and MCAP files"
        )
    if out.exists() and out.is_dir() == bool(out.suffix):
        raise ConfigError(f"{out}: is a {'folder' if out.is_dir() else 'file'}; choose another name")
    if not force and out.exists() and (out.suffix or any(out.iterdir())):
        raise ConfigError(f"{out}: exists; choose another name, or give `force=True` to write over it")


def _counter(progress: Progress | None) -> Callable[[Batch], None]:
    count = shown = 0

    def watch(batch: Batch) -> None:
        nonlocal count, shown
        count += batch.starts.size
        if progress is not None and count - shown >= _SHOWN:
            shown = count
            progress(count)

    return watch


def _of_table(connection: Connection) -> Signal:
    """A signal that holds all numbers of a table but its times."""
    fields = fields_of(connection)
    clock = clock_among(fields)
    kept = {name: size for name, size in fields.items() if name != clock}
    if not kept:
        raise LogError(f"table {connection.topic!r} has no column of numbers but its times")
    columns = {"value": tuple(kept)}
    return Signal(connection.topic, connection.topic, ("value",), names=_each(kept), columns=columns)


def _of_topics(found: Survey) -> list[Signal]:
    """Signals that hold all numbers of a log's topics."""
    readable_topics = [topic for topic in found.topics if topic.count and not topic.problem]
    signals = [signal for topic in readable_topics for signal in _of_topic(topic)]
    if not signals:
        raise LogError(f"{found.path}: no topic in it has numbers that can be read")
    return [replace(signal, name=f"{signal.topic} {i}") for i, signal in enumerate(signals)]


def _of_topic(topic: TopicSurvey) -> list[Signal]:
    info = TYPES.get(topic.type)
    if info is None:
        large = any(size is not None and size > _LONGEST for size in topic.paths.values())
        if large or not topic.paths:
            return []
        names, fields = _each(topic.paths), {"value": tuple(topic.paths)}
        return [Signal("", topic.name, ("value",), topic.type, names=names, fields=fields)]
    frames = topic.entries if info.elements and not info.names else (None,)
    return [
        Signal("", topic.name, topic.quantities, topic.type, child_frame=frame)
        for frame in frames
        if topic.quantities
    ]


def _each(numbers: Mapping[str, int | None]) -> tuple[str, ...]:
    """A name for each number: that of its field or column, with an index in an array."""
    return tuple(
        name if size is None else f"{name}[{i}]" for name, size in numbers.items() for i in range(size or 1)
    )


def _columns(tracks: Sequence[SignalTrack], plain: bool) -> dict[str, list[Columns]]:
    """Columns of each signal; of each topic where all of its numbers are taken (`plain`)."""
    found: dict[str, list[Columns]] = {}
    for track in tracks:
        signal, names, blocks = track.signal, [], []
        frame = f"{signal.child_frame}." if plain and signal.child_frame else ""
        for quantity in track.samples.values:
            values = track.carried(quantity)
            if values is None:
                continue
            own = signal.names if plain and signal.names else _entries(track, quantity, values.shape[1])
            names += [f"{frame}{name}" for name in own]
            blocks.append(values)
        if blocks:
            columns = Columns(track.times.stamps_ns, tuple(names), np.concatenate(blocks, axis=1))
            found.setdefault(signal.topic.strip("/") if plain else signal.name, []).append(columns)
    if not found:
        raise LogError("its topics have no value that is a number")
    return found


def _entries(track: SignalTrack, quantity: str, width: int) -> list[str]:
    """Names of a quantity's columns: position.hinge, position.x or value[0]."""
    entries = track.signal.names if len(track.signal.names) == width else track.samples.columns[quantity]
    if entries[0].startswith("[") and quantity != "value" and width in (3, 4):
        entries = ("w", "x", "y", "z")[-width:]
    return [quantity + (entry if entry.startswith("[") else f".{entry}") for entry in entries]
