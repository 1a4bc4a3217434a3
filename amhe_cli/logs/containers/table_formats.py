"""The files that hold tables: text (CSV, TSV ...), .npz, ULog, parquet and HDF5.

The last two need the extra [tables], ULog the extra [ulog].
"""

from __future__ import annotations

import io
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import BadZipFile, ZipFile

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError, printable
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers import text_table
from amhe_cli.logs.containers.raw import check_growth
from amhe_cli.logs.containers.table_file import Column, NumberTable, TableFile, is_time, listed

#: First bytes of the binary tables -> name of the format.
MAGIC: Mapping[bytes, str] = {
    b"PK\x03\x04": "npz",
    b"PAR1": "parquet",
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"ULog\x01\x125": "ULog",
}

#: Rows of one batch of a table that is in memory.
_ROWS = 2**16
#: Bytes that pyulog leaves out of a name.
_NOT_ASCII = bytes(range(128, 256))
#: Bytes that are zero, in a row, from which they are no part of a ULog.
_ZEROS = 2**20
#: Groups of an HDF5 file within each other.
_DEEPEST = 50


def open_tables(path: Path) -> list[TableFile]:
    """The tables of a file; an empty list where it holds no table.

    Raises:
        LogError: It is a table that cannot be read, or one that needs an extra.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    format = next((name for magic, name in MAGIC.items() if head.startswith(magic)), None)
    if format is None:
        if not text_table.looks_like_text(head):
            return []
        dialect = text_table.dialect_of(path)
        table = NumberTable(
            _stem(path), dialect.columns, lambda problems: text_table.blocks(path, dialect, problems),
            dialect.comments,
        )  # fmt: skip
        return [TableFile(path, "TSV" if dialect.delimiter == b"\t" else "CSV", table)]
    read = {"npz": _npz, "parquet": _parquet, "HDF5": _hdf5, "ULog": _ulog}[format]
    return [TableFile(path, format, table) for table in read(path)]


def _npz(path: Path) -> list[NumberTable]:
    try:
        with ZipFile(path) as packed:
            if len(packed.infolist()) > limits().columns:
                raise LogError(f"{path}: {beyond('columns', 'its arrays are')}")
            check_growth(path, sum(part.file_size for part in packed.infolist()))
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        metadata = arrays.pop("amhe", None)
        table = in_memory(path, _stem(path), arrays)
        return [table if metadata is None else replace(table, comments=(f"amhe: {metadata}",))]
    except (ValueError, OSError, KeyError, BadZipFile) as error:
        raise LogError(f"{path}: a .zip file that is no .npz of numbers ({error})") from None


def _parquet(path: Path) -> list[NumberTable]:
    needed(path, "pyarrow", "a parquet file")
    return [in_memory(path, _stem(path), parquet_arrays(path))]


def _hdf5(path: Path) -> list[NumberTable]:
    needed(path, "h5py", "an HDF5 file")
    import h5py

    groups: dict[str, dict[str, np.ndarray]] = {}
    size = 0
    met = Counter[bool]()

    def visit(name: str, item: object) -> None:
        nonlocal size
        met[isinstance(item, h5py.Group)] += 1
        if name.count("/") > _DEEPEST:
            raise LogError(f"{path}: its groups are nested deeper than {_DEEPEST} levels")
        if met[True] > limits().topics:
            raise LogError(f"{path}: {beyond('topics', 'its groups are')}")
        if met[False] > limits().columns:
            raise LogError(f"{path}: {beyond('columns', 'its arrays are')}")
        if not isinstance(item, h5py.Dataset) or item.ndim not in (1, 2) or item.dtype.kind not in "fiub":
            return
        if item.external or item.is_virtual:
            raise LogError(f"{path}: its {name!r} lies in another file; save it with its numbers in it")
        size += item.size * item.dtype.itemsize
        check_growth(path, size)
        group, _, own = name.rpartition("/")
        groups.setdefault(group, {})[own] = item[()]

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    if not groups:
        raise LogError(f"{path}: an HDF5 file without a table of numbers")
    timed = {group: arrays for group, arrays in groups.items() if any(map(is_time, arrays))}
    return [in_memory(path, group or _stem(path), arrays) for group, arrays in (timed or groups).items()]


def _ulog(path: Path) -> list[NumberTable]:
    """Each instance of each topic is a table: `name`, and `name_1`, `name_2` where there are several."""
    needed(path, "pyulog", "a ULog of PX4", "ulog")
    import pyulog

    printed = io.StringIO()  # pyulog prints what it finds damaged
    content = _without_zeros(path)

    def source() -> str | BinaryIO:  # pyulog closes what it has read
        return str(path) if content is None else io.BytesIO(content)

    with redirect_stdout(printed):
        _check_formats(path, pyulog.ULog(source(), parse_header_only=True).message_formats)
        log = pyulog.ULog(source())
    problems = ["parts of it are damaged and skipped"] if log.file_corruption or printed.getvalue() else []
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts) / 1e3
        problems.append(f"the recorder dropped messages {len(log.dropouts)} times, {lost:.2f} s in all")
    names = [data.name + (f"_{data.multi_id}" if data.multi_id else "") for data in log.data_list]
    arrays = [_with_arrays(data.data) for data in log.data_list]
    found = [in_memory(path, *named) for named in zip(names, arrays, strict=True)]
    if not found:
        raise LogError(f"{path}: a ULog without data")
    return [replace(found[0], notes=tuple(problems)), *found[1:]]


def _without_zeros(path: Path) -> bytes | None:
    """A ULog without the zeros at its end, which a recorder leaves that lost its power; None: it has none.

    pyulog looks for a message at each byte of them, a second for a megabyte.

    Raises:
        LogError: It is zeros elsewhere.
    """
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        end = len(content)
        while end and not content[max(0, end - _ZEROS) : end].strip(b"\0"):
            end -= min(_ZEROS, end)
        if content.find(bytes(_ZEROS), 0, end) >= 0:
            raise LogError(
                f"{path}: a megabyte of zeros between its messages: the recorder lost what was there"
            )
        return None if end == len(content) else content[:end]


def _check_formats(path: Path, formats: Mapping[str, Any]) -> None:
    """Refuse a ULog whose topics have too many fields: formats within formats multiply, and so do topics.

    Args:
        path: The file.
        formats: Name of each format -> what has its fields, of type, count and name.
    """
    most, sizes = limits().columns, dict[str, int]()

    def size(name: str) -> int:
        if name not in sizes:
            sizes[name] = most + 1  # should it hold itself
            fields = formats[name].fields if name in formats else ()
            sizes[name] = min(most + 1, sum(max(n, 1) * size(kind) for kind, n, _ in fields)) or 1
        return sizes[name]

    if not all(name and name.isascii() for name in formats):
        raise LogError(f"{path}: a ULog with a format whose name is not plain text")
    if not formats:
        return
    names, total = [name.encode() for name in formats], 0
    longest, first = max(map(len, names)), re.escape(bytes({name[0] for name in names}))
    begins = re.compile(b"A(?=[\\s\\S]{3}[\\x80-\\xff]*[" + first + b"])")
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        # Every 'A' that may begin a subscription counts. pyulog skips bytes that are not ASCII in its name.
        for begin in begins.finditer(content):
            text = content[begin.end() + 3 : begin.end() + 259].translate(None, _NOT_ASCII)
            if len(text) < longest:
                text = content[begin.end() + 3 : begin.end() + 2**16].translate(None, _NOT_ASCII)
            total += max((size(name.decode()) for name in names if text.startswith(name)), default=0)
            if total > most:
                raise LogError(f"{path}: {beyond('columns', 'the fields of its topics are')}")


def _with_arrays(data: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Fields of a ULog topic, 'q[0]', 'q[1]' ... as one array; its times are microseconds since boot."""
    arrays: dict[str, list[np.ndarray]] = {}
    for name, values in data.items():
        stem, _, index = name.rpartition("[") if name.endswith("]") else (name, "", "")
        arrays.setdefault(stem if index[:-1].isdecimal() else name, []).append(values)
    whole = {name: np.stack(p, axis=1) if len(p) > 1 else p[0] for name, p in arrays.items()}
    return {"timestamp [us]" if name == "timestamp" else name: array for name, array in whole.items()}


def needed(path: Path, library: str, what: str, extra: str = "tables") -> None:
    """Refuse a file whose library is not installed, and say how to get it."""
    from importlib.util import find_spec

    if find_spec(library) is None:
        raise LogError(f"{path}: {what}; reading it needs the extra: pip install 'amhe[{extra}]'")


def in_memory(path: Path, name: str, arrays: Mapping[str, np.ndarray]) -> NumberTable:
    """A table of arrays (n,) and (n, k); arrays of another length are left out and named."""
    usable = {key: a for key, a in arrays.items() if a.ndim in (1, 2) and a.dtype.kind in "fiubM"}
    clock = next((key for key in usable if is_time(key)), next(iter(usable), None))
    if clock is None:
        raise LogError(f"{path}: no array of numbers in it")
    length = len(usable[clock])
    rest = [key for key in arrays if key not in usable or len(usable[key]) != length]
    kept = {key: array for key, array in usable.items() if key not in rest}
    columns = tuple(
        Column(key, "date" if a.dtype.kind == "M" else "number", a.shape[1] if a.ndim == 2 else None)
        for key, a in kept.items()
    )

    def rows(problems: list[str]) -> Iterator[FloatArray]:
        for start in range(0, length, _ROWS):
            parts = (array[start : start + _ROWS] for array in kept.values())
            numbers = [
                p.astype("datetime64[ns]").astype(np.int64) if p.dtype.kind == "M" else p for p in parts
            ]
            yield np.concatenate([p.astype(np.float64).reshape(len(p), -1) for p in numbers], axis=1)
        if rest:
            problems.append(f"{listed(rest)} another length than {clock!r}, or no numbers: left out")

    return NumberTable(name, columns, rows)


def _stem(path: Path) -> str:
    return printable(path.name.split(".")[0])


#: Rows of a parquet file that are unfolded at once.
_UNFOLDED_ROWS = 2**12
#: The column of a LeRobot dataset that says which episode a row is of.
_EPISODE = "episode_index"


def parquet_arrays(
    path: Path, columns: Sequence[str] | None = None, episode: int | None = None
) -> dict[str, np.ndarray]:
    """Columns of numbers, times and lists of numbers of one length, of a parquet file.

    A constant column takes no room, so rows and sizes are held against the limits before anything is
    unfolded, and lists as they are read: pyarrow counts them in the metadata of a column, but it aborts the
    process where the statistics beside that count are damaged.

    Args:
        path: The file.
        columns: Columns to read, where they are there; None: all.
        episode: Keep only rows with this `episode_index`, if there is such a column.

    Raises:
        LogError: It is beyond the limits `piece_mib` and `growth`.
    """
    import pyarrow as pa
    import pyarrow.parquet

    size, batches = 0, []
    with pyarrow.parquet.ParquetFile(path) as file:
        about, schema = file.metadata, file.schema_arrow
        packed = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
        check_growth(path, max(8 * about.num_rows * about.num_columns, packed))
        wanted = [f.name for f in schema if _of_numbers(f.type) and (columns is None or f.name in columns)]
        there = episode is not None and _EPISODE in schema.names
        for batch in file.iter_batches(
            _UNFOLDED_ROWS, columns=list({*wanted, _EPISODE} if there else wanted)
        ):
            size += batch.nbytes
            check_growth(path, size)
            if there:
                batch = batch.filter(pa.array(batch[_EPISODE].to_numpy(zero_copy_only=False) == episode))
                if batches and not batch.num_rows:
                    break  # the rows of an episode are together
            batches += [batch.select(wanted)] if batch.num_rows else []
    table = pa.Table.from_batches(batches, pa.schema([schema.field(name) for name in wanted]))
    return {name: a for name in wanted if (a := _array(table[name].combine_chunks())) is not None}


def _is_list(kind: Any) -> bool:
    import pyarrow as pa

    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _of_numbers(kind: Any) -> bool:
    """Whether `_array` takes a column; texts, say, need not be unfolded."""
    import pyarrow as pa

    kind = kind.value_type if _is_list(kind) else kind
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
    return number or pa.types.is_timestamp(kind)


def _array(column: Any) -> np.ndarray | None:
    """A column as an array; None of lists of several lengths."""
    import pyarrow as pa

    if _is_list(column.type):
        flat = column.flatten().to_numpy(zero_copy_only=False)
        return flat.reshape(len(column), -1) if len(column) and flat.size % len(column) == 0 else None
    if pa.types.is_timestamp(column.type):
        column = column.cast(pa.timestamp("ns"))
    return column.to_numpy(zero_copy_only=False)
