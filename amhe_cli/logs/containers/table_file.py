"""Tables as logs: a table is a topic, its rows are messages, its columns their fields.

A text table (CSV, TSV ...), an .npz or .npy file, and with the extra [tables] parquet, feather and HDF5. The
rows become messages in the encoding 'table': float64 numbers side by side, as the definition lists them. So
clocks, signals and inspection treat a table like any other log.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.logs.containers import text_table
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.text_dialect import Column, dialect_of, looks_like_text

#: Type and encoding of a table's connection.
TYPE, ENCODING = "table/msg/Row", "table"
#: First bytes of the binary tables -> name of the format.
MAGIC: Mapping[bytes, str] = {
    b"PK\x03\x04": "npz",
    b"\x93NUMPY": "npy",
    b"PAR1": "parquet",
    b"ARROW1": "feather",
    b"\x89HDF\r\n\x1a\n": "HDF5",
}

#: Names of a time column, the best first; a unit may follow.
_TIMES = ("time", "t", "timestamp", "stamp", "datetime", "date", "ts", "clock", "sec", "secs", "seconds")
#: Unit of a time column -> nanoseconds.
_NANOSECONDS = {"s": 1e9, "sec": 1e9, "seconds": 1e9, "ms": 1e6, "us": 1e3, "µs": 1e3, "ns": 1.0}
#: Unit of any other column -> factor to SI; units that are not listed are taken as SI.
_FACTORS: Mapping[str, float] = {
    "deg": np.pi / 180.0, "degrees": np.pi / 180.0, "°": np.pi / 180.0, "deg/s": np.pi / 180.0,
    "°/s": np.pi / 180.0, "rpm": np.pi / 30.0, "mrad": 1e-3, "mm": 1e-3, "cm": 1e-2, "mm/s": 1e-3,
    "mNm": 1e-3, "Ncm": 1e-2, "mA": 1e-3,
}  # fmt: skip
_BRACKETS = re.compile(r"^(.*?)\s*[\[({<]\s*([^\d\])}>][^\])}>]*?)\s*[\])}>]$")
_SUFFIX = re.compile(r"^(.+)_(deg|ms|us|ns|rpm|mm)$")
#: Rows of one batch of a table that is in memory.
_ROWS = 2**16


@dataclass(frozen=True, slots=True, eq=False)
class NumberTable:
    """One table, whatever file it is in.

    Args:
        name: Of the table; its topic.
        columns: Its columns, in order.
        rows: Yields its rows in order, shape (n, numbers in a row); takes the list of problems to add to.
        comments: What the file says of itself.
    """

    name: str
    columns: tuple[Column, ...]
    rows: Callable[[list[str]], Iterator[FloatArray]]
    comments: tuple[str, ...] = ()


class TableFile:
    """A table as a log file; see `LogFile`."""

    def __init__(self, path: Path, format: str, table: NumberTable) -> None:
        self.format = format
        self.problems: list[str] = []
        self.metadata = _metadata(table.comments)
        self._path, self._table = path, table
        numbers = [column.kind in ("number", "array") for column in table.columns]
        counts = [column.count for column in table.columns]
        units = [unit_of(column.name) for column in table.columns]
        self._factors = np.repeat([_FACTORS.get(unit, 1.0) for _, unit in units], counts)
        self._kept = np.repeat(numbers, counts)
        fields = [
            [name, column.count if column.kind == "array" else None]
            for (name, _), column, number in zip(units, table.columns, numbers, strict=True)
            if number
        ]
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
                place, factor = _clock(self._path, self._table.columns, rows)
            with np.errstate(all="ignore"):  # numbers of a damaged file
                times = rows[:, place] * factor
            timed = np.isfinite(times) & (np.abs(times) < 2.0**63)
            untimed += int((~timed).sum())
            stamps = np.round(times[timed]).astype(np.int64)
            content = np.ascontiguousarray((rows[timed] * self._factors)[:, self._kept])
            size = content.itemsize * content.shape[1]
            starts = size * np.arange(len(content), dtype=np.int64)
            lengths = np.full(len(content), size, dtype=np.int64)
            yield Batch(connection, stamps, stamps, content.view(np.uint8).ravel(), starts, lengths)
        if untimed:
            rows_are = "1 row without a time is" if untimed == 1 else f"{untimed} rows without a time are"
            self.problems.append(f"{rows_are} dropped")

    def read_metadata(self) -> dict[str, str]:
        """See `LogFile`."""
        return self.metadata


def open_tables(path: Path) -> list[TableFile]:
    """The tables of a file; an empty list where it holds no table.

    Raises:
        LogError: It is a table that cannot be read, or one that needs an extra.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    format = next((name for magic, name in MAGIC.items() if head.startswith(magic)), None)
    if format is None:
        if not looks_like_text(head):
            return []
        dialect = dialect_of(path)
        table = NumberTable(
            _stem(path), dialect.columns, lambda problems: text_table.blocks(path, dialect, problems),
            dialect.comments,
        )  # fmt: skip
        return [TableFile(path, "TSV" if dialect.delimiter == b"\t" else "CSV", table)]
    tables = {"npz": _npz, "npy": _npy, "parquet": _parquet, "feather": _feather, "HDF5": _hdf5}[format](path)
    return [TableFile(path, format, table) for table in tables]


def unit_of(name: str) -> tuple[str, str]:
    """Name and unit of a column from its header: 'q1 [deg]' is ('q1', 'deg'); '' where none is named."""
    if match := _BRACKETS.match(name):
        return match.group(1), match.group(2)
    if match := _SUFFIX.match(name):
        return name, match.group(2)
    return name, ""


def _clock(path: Path, columns: Sequence[Column], rows: FloatArray) -> tuple[int, float]:
    """Which number of a row is its time, and the nanoseconds of one unit of it."""
    named = [(unit_of(column.name), column) for column in columns]
    rank = {name: i for i, name in enumerate(_TIMES)}
    best: tuple[int, int] | None = None
    for i, ((name, unit), column) in enumerate(named):
        plain = re.sub(r"[^a-z]", " ", name.lower().removesuffix(f"_{unit}")).split()
        found = [rank[word] for word in plain if word in rank]
        score = 100 if column.kind == "date" else min(found) + 20 * (len(plain) > 1) if found else None
        if column.kind != "array" and score is not None and (best is None or score < best[0]):
            best = score, i
    if best is None:
        raise LogError(
            f"{path}: none of the columns {_listed([name for (name, _), _ in named])} is a time: "
            f"call the one that is `time`, or `time [ms]` if it is not in seconds"
        )
    (_, unit), column = named[best[1]]
    place = sum(c.count for c in columns[: best[1]])
    if column.kind == "date":
        return place, 1.0
    return place, _NANOSECONDS.get(unit) or _guessed_unit(rows[:, place])


def _guessed_unit(times: FloatArray) -> float:
    """Nanoseconds of the unit in which a robot's log would have a rate of 2 Hz to 20 kHz."""
    finite = times[np.isfinite(times)]
    steps = np.abs(np.diff(np.sort(finite)))
    steps = steps[steps > 0.0]
    step = float(np.median(steps)) if steps.size else 0.0
    return next((unit for least, unit in ((5e5, 1.0), (5e2, 1e3), (0.5, 1e6)) if step > least), 1e9)


# -- files that are no text ----------------------------------------------------------------------------


def _npy(path: Path) -> list[NumberTable]:
    array = np.load(path, allow_pickle=False, mmap_mode="r")
    if array.dtype.names is None:
        raise LogError(f"{path}: an array without names; save it with np.savez(file, time=t, position=q)")
    return [_in_memory(path, _stem(path), {name: array[name] for name in array.dtype.names})]


def _npz(path: Path) -> list[NumberTable]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return [_in_memory(path, _stem(path), {name: file[name] for name in file.files})]
    except (ValueError, OSError, KeyError, BadZipFile) as error:
        raise LogError(f"{path}: a .zip file that is no .npz of numbers ({error})") from None


def _parquet(path: Path) -> list[NumberTable]:
    _needed(path, "pyarrow")
    import pyarrow.parquet

    return [_from_arrow(path, pyarrow.parquet.read_table(path))]


def _feather(path: Path) -> list[NumberTable]:
    _needed(path, "pyarrow")
    import pyarrow.feather

    return [_from_arrow(path, pyarrow.feather.read_table(path))]


def _from_arrow(path: Path, table: Any) -> NumberTable:
    import pyarrow as pa

    arrays: dict[str, np.ndarray] = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            flat = column.flatten().to_numpy(zero_copy_only=False)
            if len(column) and flat.size % len(column) == 0:
                arrays[name] = flat.reshape(len(column), -1)
        elif pa.types.is_timestamp(kind):
            arrays[name] = column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False)
        elif pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind):
            arrays[name] = column.to_numpy(zero_copy_only=False)
    return _in_memory(path, _stem(path), arrays)


def _hdf5(path: Path) -> list[NumberTable]:
    _needed(path, "h5py")
    import h5py

    groups: dict[str, dict[str, np.ndarray]] = {}

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim in (1, 2) and item.dtype.kind in "fiub":
            group, _, own = name.rpartition("/")
            groups.setdefault(group, {})[own] = item[()]

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    if not groups:
        raise LogError(f"{path}: an HDF5 file without a table of numbers")
    timed = {group: arrays for group, arrays in groups.items() if any(map(_is_time, arrays))}
    return [_in_memory(path, group or _stem(path), arrays) for group, arrays in (timed or groups).items()]


def _needed(path: Path, library: str) -> None:
    from importlib.util import find_spec

    if find_spec(library) is None:
        raise LogError(f"{path}: reading it needs the extra: pip install 'amhe[tables]'")


def _in_memory(path: Path, name: str, arrays: Mapping[str, np.ndarray]) -> NumberTable:
    """A table of arrays (n,) and (n, k); arrays of another length are left out and named."""
    usable = {key: a for key, a in arrays.items() if a.ndim in (1, 2) and a.dtype.kind in "fiubM"}
    clock = next((key for key in usable if _is_time(key)), next(iter(usable), None))
    if clock is None:
        raise LogError(f"{path}: no array of numbers in it")
    length = len(usable[clock])
    rest = [key for key in arrays if key not in usable or len(usable[key]) != length]
    kept = {key: array for key, array in usable.items() if key not in rest}
    columns = tuple(_array_column(key, array) for key, array in kept.items())

    def rows(problems: list[str]) -> Iterator[FloatArray]:
        for start in range(0, length, _ROWS):
            parts = [_floats(array[start : start + _ROWS]) for array in kept.values()]
            yield np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
        if rest:
            problems.append(f"{_listed(rest)} another length than {clock!r}, or no numbers: left out")

    return NumberTable(name, columns, rows)


def _array_column(name: str, array: np.ndarray) -> Column:
    if array.dtype.kind == "M":
        return Column(name, "date")
    return Column(name, "array", array.shape[1]) if array.ndim == 2 else Column(name, "number")


def _floats(array: np.ndarray) -> FloatArray:
    if array.dtype.kind == "M":
        return array.astype("datetime64[ns]").astype(np.int64).astype(np.float64)
    return array.astype(np.float64)


def _is_time(name: str) -> bool:
    return any(word in _TIMES for word in re.sub(r"[^a-z]", " ", name.lower()).split())


def _metadata(comments: Sequence[str]) -> dict[str, str]:
    """Comments of the form `amhe: {...}`, as `amhe convert` writes them."""
    for comment in comments:
        if comment.startswith("amhe:"):
            try:
                return {str(k): str(v) for k, v in json.loads(comment.removeprefix("amhe:")).items()}
            except (ValueError, AttributeError):
                continue
    return {}


def _stem(path: Path) -> str:
    return path.name.split(".")[0]


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(repr(name) for name in names[:8])
    return f"{shown}, ..." if len(names) > 8 else shown
