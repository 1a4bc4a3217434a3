"""Tables as logs: a table is a topic, its rows are messages, its columns their fields.

The rows become messages in the encoding 'table': float64 numbers side by side, as the definition lists them.
So clocks, signals and inspection treat a table like any other log.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.signals import FACTORS
from amhe_cli.logs.containers.raw import Batch, Connection, LogFile

#: Type and encoding of a table's connection.
TYPE, ENCODING = "table/msg/Row", "table"
#: Key of a table's metadata: the stamp [ns] that its times count from. A time in float64 since 1970 would be
#: off by hundreds of nanoseconds.
START = "start_ns"
#: Names of a time column, the best first; a unit may follow.
_TIMES = (
    "time", "t", "timestamp", "stamp", "datetime", "date", "ts", "clock", "sec", "secs", "seconds", "millis",
    "micros",
)  # fmt: skip
#: Unit of a time column, or its name -> nanoseconds.
_NANOSECONDS = {
    "s": 1e9, "sec": 1e9, "seconds": 1e9, "ms": 1e6, "millis": 1e6, "us": 1e3, "µs": 1e3, "micros": 1e3,
    "ns": 1.0,
}  # fmt: skip
_BRACKETS = re.compile(r"^(.*?)\s*[\[({<]\s*([^\d\])}>][^\])}>]*?)\s*[\])}>]$")
_SUFFIX = re.compile(r"^(.+)_(deg|ms|us|ns|rpm|mm)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Args:
        name: Its name, a unit behind it.
        kind: 'number', 'date' [ns since 1970], or 'text', which is not read.
        count: Numbers in a row of it; None: a single one, and no array.
    """

    name: str
    kind: str
    count: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NumberTable:
    """One table, whatever file it is in.

    Args:
        name: Name of the table; its topic.
        columns: Columns of the table, in order.
        rows: Yields its rows in order, shape (n, numbers in a row); takes the list of problems to add to.
        comments: Comments in the file; one may hold the log's metadata.
        notes: What is damaged in its file, in words.
    """

    name: str
    columns: tuple[Column, ...]
    rows: Callable[[list[str]], Iterator[FloatArray]]
    comments: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


class TableFile(LogFile):
    """A table as a log file; see `LogFile`."""

    def __init__(self, path: Path, format: str, table: NumberTable) -> None:
        super().__init__()
        self.format = format
        self.path = path
        self.problems += table.notes
        self.metadata = _metadata(table.comments)
        start = self.metadata.pop(START, "0")
        self._start_ns = int(start) if start.isdecimal() and len(start) < 20 and int(start) < 2**62 else 0
        self._table = table
        numbers = [column.kind == "number" for column in table.columns]
        counts = [column.count or 1 for column in table.columns]
        units = [unit_of(column.name) for column in table.columns]
        factors = [FACTORS.get(unit, FACTORS.get(unit.lower(), 1.0)) for _, unit in units]
        self._factors = np.repeat(factors, counts)
        self._kept = np.repeat(numbers, counts)
        names = [name for name, _ in units]
        clock = clock_of(table.columns)
        if clock is not None and not is_time(names[clock]):
            names[clock] = table.columns[clock].name  # its unit says that it is the time
        fields = [
            [name, column.count]
            for name, column, number in zip(names, table.columns, numbers, strict=True)
            if number
        ]
        counted = Counter(name for name, _ in fields)
        several = [name for name, count in counted.items() if count > 1 and name]
        if several:
            self.problems.append(
                f"several columns are called {listed(several)}: of these only the last is read"
            )
        self.connections = [Connection(table.name, TYPE, ENCODING, json.dumps(fields), "")]

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """See `LogFile`.

        Raises:
            LogError: The table has no column of times.
        """
        (connection,) = self.connections
        if topics is not None and connection.topic not in topics:
            return
        place: int | None = None
        factor, untimed = 1.0, 0
        for rows in self._table.rows(self.problems):
            if place is None:
                place, factor = _clock(self.path, self._table.columns, rows)
            with np.errstate(all="ignore"):  # numbers of a damaged file
                times = rows[:, place] * factor
                timed = np.isfinite(times) & (np.abs(times) < 2.0**63)
                content = np.ascontiguousarray((rows[timed] * self._factors)[:, self._kept])
            untimed += int((~timed).sum())
            stamps = np.round(times[timed]).astype(np.int64) + self._start_ns
            size = content.itemsize * content.shape[1]
            starts = size * np.arange(len(content), dtype=np.int64)
            lengths = np.full(len(content), size, dtype=np.int64)
            yield Batch(connection, stamps, stamps, content.view(np.uint8).ravel(), starts, lengths)
        if untimed:
            rows_are = "1 row without a time is" if untimed == 1 else f"{untimed} rows without a time are"
            self.problems.append(f"{rows_are} dropped")


def unit_of(name: str) -> tuple[str, str]:
    """Name and unit of a column from its header: 'q1 [deg]' is ('q1', 'deg'); '' where none is named."""
    if match := _BRACKETS.match(name):
        return match.group(1), match.group(2)
    if match := _SUFFIX.match(name):
        return name, match.group(2)
    return name, ""


def _clock(path: Path, columns: Sequence[Column], rows: FloatArray) -> tuple[int, float]:
    """Which number of a row is its time, and the nanoseconds of one unit of it."""
    number = clock_of(columns)
    if number is None:
        raise LogError(
            f"{path}: none of the columns {listed([unit_of(column.name)[0] for column in columns])} is a "
            "time: call the one that is `time`, or `time [ms]` if it is not in seconds. Dates as numbers, "
            "with pandas: table['time [ns]'] = pandas.to_datetime(table['date']).astype('int64')"
        )
    place = sum(c.count or 1 for c in columns[:number])
    if columns[number].kind == "date":
        return place, 1.0
    name, unit = map(str.lower, unit_of(columns[number].name))
    return place, _NANOSECONDS.get(unit) or _NANOSECONDS.get(name) or _guessed_unit(rows[:, place])


def clock_of(columns: Sequence[Column]) -> int | None:
    """Which column of a table is its time, by the names; None where none is."""
    rank = {name: i for i, name in enumerate(_TIMES)}
    best: tuple[int, int] | None = None
    for i, column in enumerate(columns):
        name, unit = map(str.lower, unit_of(column.name))
        plain = re.sub(r"[^a-z]", " ", name.removesuffix(f"_{unit}")).split()
        found = [rank[word] for word in plain if word in rank]
        score = min(found) + 20 * (len(plain) > 1) if found else 50 if unit in _NANOSECONDS else None
        score = 100 if column.kind == "date" else score
        single = column.kind != "text" and column.count is None
        if single and score is not None and (best is None or score < best[0]):
            best = score, i
    return None if best is None else best[1]


def clock_among(fields: Mapping[str, int | None]) -> str | None:
    """Which column is a table's time.

    Args:
        fields: Name of each column -> how many numbers a cell holds, None for a single one.
    """
    columns = [Column(name, "number", count) for name, count in fields.items()]
    number = clock_of(columns)
    return None if number is None else columns[number].name


def _guessed_unit(times: FloatArray) -> float:
    """Nanoseconds of the unit in which a robot's log would have a rate of 2 Hz to 20 kHz."""
    finite = times[np.isfinite(times)]
    steps = np.abs(np.diff(np.sort(finite)))
    steps = steps[steps > 0.0]
    step = float(np.median(steps)) if steps.size else 0.0
    return next((unit for least, unit in ((5e5, 1.0), (5e2, 1e3), (0.5, 1e6)) if step > least), 1e9)


def is_time(name: str) -> bool:
    """Whether a column is a time, by its name."""
    return any(word in _TIMES for word in re.sub(r"[^a-z]", " ", name.lower()).split())


def _metadata(comments: Sequence[str]) -> dict[str, str]:
    """Metadata of a log, from comments of the form `amhe: {...}`."""
    for comment in comments:
        if comment.startswith("amhe:"):
            try:
                return {str(k): str(v) for k, v in json.loads(comment.removeprefix("amhe:")).items()}
            except (ValueError, AttributeError):
                continue
    return {}


def listed(names: Sequence[str]) -> str:
    """The first of some names, in quotes."""
    shown = ", ".join(repr(name) for name in names[:8])
    return f"{shown}, ..." if len(names) > 8 else shown
