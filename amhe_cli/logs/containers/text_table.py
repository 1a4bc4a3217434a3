"""Text tables: CSV and its relatives, read block by block, so that memory stays bounded."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.logs.containers.text_dialect import (
    COMMENTS,
    MISSING,
    Column,
    Dialect,
    cells_of,
    elements_of,
    is_comment,
    number_of,
)

logger = logging.getLogger(__name__)

_BLOCK = 2**22
_NULLS = sorted(case for word in MISSING for case in (word.decode(), word.decode().upper()))
#: A line that is longer than this does not belong to a table.
_LONGEST_LINE = 2**20


def blocks(path: Path, dialect: Dialect, problems: list[str]) -> Iterator[FloatArray]:
    """Yield the rows in order, as arrays of shape (n, `dialect.width`); dates are nanoseconds of the epoch.

    Args:
        path: The file.
        dialect: Form of the table, as `dialect_of` found it.
        problems: Takes a line for each kind of damage, once the last block has been read.
    """
    done = dropped = passed = 0
    try:
        for rows in _quick_blocks(path, dialect) or ():
            done += len(rows)
            yield rows
        if done:
            return
    except ValueError as error:  # pyarrow's errors are ValueErrors: something that only we read
        logger.debug("%s: row %d on is read by our own parser: %s", path, done, error)
    with path.open("rb") as file:
        file.seek(dialect.start)
        for text in _text_blocks(file, path):
            rows, wrong = _parsed(text, dialect)
            dropped += wrong
            left = rows[max(done - passed, 0) :]
            passed += len(rows)
            if len(left):
                yield left
    if dropped:
        lines = "1 line has" if dropped == 1 else f"{dropped} lines have"
        are = "is" if dropped == 1 else "are"
        problems.append(f"{lines} another number of cells than the header and {are} dropped")


def _quick_blocks(path: Path, dialect: Dialect) -> Iterator[FloatArray] | None:
    """The rows of a plain table by pyarrow, several times as fast; None where it is not plain or no pyarrow.

    The generator raises a ValueError where a row turns out not to be plain; the rows before it are right.
    """
    kinds = {column.kind for column in dialect.columns}
    plain = len(dialect.delimiter) == 1 and dialect.delimiter != b" " and not dialect.decimal_comma
    if not plain or not kinds <= {"number", "text"} or find_spec("pyarrow") is None:
        return None
    return _by_pyarrow(path, dialect)


def _by_pyarrow(path: Path, dialect: Dialect) -> Iterator[FloatArray]:
    import pyarrow as pa
    import pyarrow.csv

    names = [str(i) for i in range(len(dialect.columns))]
    kinds = {n: pa.float64() for n, c in zip(names, dialect.columns, strict=True) if c.kind == "number"}
    with path.open("rb") as file:
        file.seek(dialect.start)
        reader = pyarrow.csv.open_csv(
            file,
            pyarrow.csv.ReadOptions(column_names=names, block_size=_BLOCK, use_threads=False),
            pyarrow.csv.ParseOptions(delimiter=dialect.delimiter.decode()),
            pyarrow.csv.ConvertOptions(
                column_types=kinds, include_columns=list(kinds), null_values=_NULLS, strings_can_be_null=True
            ),
        )
        for batch in reader:
            rows = np.full((batch.num_rows, len(names)), np.nan)
            for name in kinds:
                rows[:, int(name)] = batch.column(name).to_numpy(zero_copy_only=False)
            yield rows


def _text_blocks(file: BinaryIO, path: Path) -> Iterator[bytes]:
    left = b""
    while block := file.read(_BLOCK):
        end = block.rfind(b"\n") + 1
        if not end and len(left) + len(block) > _LONGEST_LINE + _BLOCK:
            raise LogError(f"{path}: a line is longer than {_LONGEST_LINE} bytes: no table")
        if end:
            yield left + block[:end]
            left = block[end:]
        else:
            left += block
    if left.strip():
        yield left + b"\n"


def _parsed(text: bytes, dialect: Dialect) -> tuple[FloatArray, int]:
    """Rows of one block, and how many lines were dropped."""
    delimiter, columns = dialect.delimiter, dialect.columns
    arrays_clash = any(c.kind == "array" for c in columns) and delimiter != b","
    plain = (
        delimiter != b" " and not arrays_clash and b"\n\n" not in text
        and not any(mark in text for mark in COMMENTS)
    )  # fmt: skip
    if plain:
        cells = (
            text.translate(None, b'"[]()\r').removesuffix(b"\n").replace(b"\n", delimiter).split(delimiter)
        )
        count = text.count(b"\n")
        if len(cells) == count * dialect.width:
            rows = np.empty((count, dialect.width))
            place = 0
            for column in columns:
                for _ in range(column.count):
                    rows[:, place] = _numbers(cells[place :: dialect.width], column, dialect.decimal_comma)
                    place += 1
            if not np.isnan(rows).all(axis=1).any():
                return rows, 0
    return _parsed_by_line(text, dialect)


def _parsed_by_line(text: bytes, dialect: Dialect) -> tuple[FloatArray, int]:
    """Like `_parsed`, for blocks with comments, ragged lines, or quoted words."""
    kept: list[list[bytes]] = []
    dropped = 0
    for line in text.splitlines():
        if not line.strip() or is_comment(line):
            continue
        cells = cells_of(line, dialect.delimiter)
        flat: list[bytes] = []
        for cell, column in zip(cells, dialect.columns, strict=False):
            parts = elements_of(cell) if column.kind == "array" else [cell]
            flat += parts if len(parts) == column.count else [b""] * column.count
        if len(cells) == len(dialect.columns):
            kept.append(flat)
        else:
            dropped += 1
    rows = np.empty((len(kept), dialect.width))
    place = 0
    for column in dialect.columns:
        for _ in range(column.count):
            rows[:, place] = _numbers([row[place] for row in kept], column, dialect.decimal_comma)
            place += 1
    return rows, dropped


def _numbers(cells: Sequence[bytes], column: Column, comma: bool) -> FloatArray:
    """Cells of one column as numbers, shape (n,); NaN where a cell holds none."""
    if column.kind == "text":
        return np.full(len(cells), np.nan)
    if column.kind == "date":
        return np.array([_date(cell) for cell in cells])
    if comma:
        cells = [cell.replace(b",", b".") for cell in cells]
    try:
        return np.fromiter(map(float, cells), np.float64, len(cells))
    except ValueError:
        return np.array([number_of(cell) for cell in cells])


def _date(cell: bytes) -> float:
    """A date in nanoseconds of the epoch; one without a zone is taken as UTC."""
    text = cell.strip().decode("ascii", "replace").replace(",", ".")
    zone = re.search(r"(Z|[+-]\d\d:?\d\d)$", text) if len(text) > 10 else None
    try:
        ns = float(np.datetime64(text[: zone.start()] if zone else text, "ns").astype(np.int64))
    except ValueError:
        return np.nan
    if not zone or zone.group() == "Z":
        return ns
    sign = 1.0 if zone.group()[0] == "+" else -1.0
    hours, minutes = int(zone.group()[1:3]), int(zone.group()[-2:])
    return ns - sign * (3600.0 * hours + 60.0 * minutes) * 1e9
