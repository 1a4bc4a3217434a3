"""Text tables: cells between commas, semicolons or tabs, a header, a row on each line.

They are read block by block, so that memory stays bounded. What is written in another way is refused, with
the line of pandas that rewrites it.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.errors import LogError
from amhe_cli.logs.containers.table_file import Column

#: The first bytes of a file, by which it is judged.
_HEAD = 2**16
#: Bytes that are read at once.
_BLOCK = 2**20
#: Blocks of numbers that are kept for the next reading.
_KEPT = 16
#: A line that is longer than this does not belong to a table.
_LONGEST_LINE = 2**20
#: What may stand between two cells.
_DELIMITERS = (b",", b";", b"\t")
#: Mark of a comment.
_COMMENT = b"#"
#: Words that stand for a missing number.
_MISSING = {b"", b"na", b"n/a", b"nan", b"null", b"none", b"-", b"nil"}
#: A cell that holds several numbers.
_ARRAY = re.compile(rb"^\s*[\[(](.*)[\])]\s*$")


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a text table is written.

    Args:
        delimiter: Text between two cells.
        decimal_comma: Numbers are written 1,5 instead of 1.5.
        columns: All columns, in the order of the file.
        start: Byte at which the first row begins.
        comments: Comment lines before the first row, without their marks.
    """

    delimiter: bytes
    decimal_comma: bool
    columns: tuple[Column, ...]
    start: int
    comments: tuple[str, ...]

    @property
    def width(self) -> int:
        """Numbers in one row, shape of `blocks`: words count one, and are NaN."""
        return sum(column.count or 1 for column in self.columns)


def looks_like_text(head: bytes) -> bool:
    """Whether the first bytes of a file can be a text table: they hold no control characters."""
    control = sum(byte < 9 or 13 < byte < 32 or byte == 127 for byte in head)
    return bool(head) and not control


def dialect_of(path: Path) -> Dialect:
    """Find out how a text table is written.

    Raises:
        LogError: The file holds no table of numbers, or is written in another way.
    """
    lines = _first_lines(path)
    comments = [line.lstrip(b"# ") for _, line in lines if line.startswith(_COMMENT)]
    rows = [(start, line) for start, line in lines if not line.startswith(_COMMENT)]
    if not rows:
        raise LogError(f"{path}: a text file without a line of numbers")
    delimiter = max(_DELIMITERS, key=rows[0][1].count)
    cells = [_cells(line, delimiter) for _, line in rows]
    comma = delimiter != b"," and _has_decimal_commas(cells[1:])
    header = cells[0]
    if all(_kind(cell, comma) != "text" for cell in header):
        header = _cells(comments.pop(), delimiter) if comments else []  # as np.savetxt writes it
        if len(header) != len(cells[0]):
            raise LogError(f"{path}: its first line has no names; {_rewritten('names=[...]')}")
    else:
        rows, cells = rows[1:], cells[1:]
    if len(header) < 2:
        raise LogError(f"{path}: no comma, semicolon or tab in its header; {_rewritten('sep=...')}")
    if not cells:
        raise LogError(f"{path}: a table with a header and no rows")
    full = [row for row in cells if len(row) == len(header)]
    if 2 * len(full) < len(cells) or header[0].startswith(b"sep="):  # as Excel writes it
        raise LogError(
            f"{path}: a text file whose lines have different numbers of cells: no table, or one that begins "
            f"further down: {_rewritten('skiprows=...')}"
        )
    columns = tuple(_column(_text(name), [row[i] for row in full], comma) for i, name in enumerate(header))
    if not any(column.kind == "number" for column in columns):
        raise LogError(f"{path}: a text file without a column of numbers")
    if all(_kind(cell, comma) in ("text", "missing") for cell in cells[0]):
        raise LogError(
            f"{path}: the line under its header has no number; write units as `q1 [deg]` into the header; "
            f"{_rewritten('skiprows=[1]')}"
        )
    return Dialect(delimiter, comma, columns, rows[0][0], tuple(map(_text, comments)))


def blocks(path: Path, dialect: Dialect, problems: list[str]) -> Iterator[FloatArray]:
    """Yield the rows in order, shape (n, `dialect.width`); words are NaN.

    Args:
        path: The file.
        dialect: Form of the table, as `dialect_of` found it.
        problems: Takes a line for each kind of damage, once the last block has been read.
    """
    dropped = 0
    with path.open("rb") as file:
        file.seek(dialect.start)
        for text in _text_blocks(file, path):
            rows, wrong = _parsed(text, dialect)
            dropped += wrong
            if len(rows):
                yield rows
    if dropped:
        lines = "1 line has" if dropped == 1 else f"{dropped} lines have"
        are = "is" if dropped == 1 else "are"
        problems.append(f"{lines} another number of cells than the header and {are} dropped")


# -- the form -----------------------------------------------------------------------------------------


def _first_lines(path: Path) -> list[tuple[int, bytes]]:
    """Lines that are not blank, with the byte at which each begins; not the last where it may go on."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    mark = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    pieces = head[mark:].split(b"\n")
    lines, place = [], mark
    for line in pieces if len(head) < _HEAD else pieces[:-1]:
        if line.strip():
            lines.append((place, line.strip(b"\r ")))
        place += len(line) + 1
    return lines


def _rewritten(how: str) -> str:
    return f"with pandas: pandas.read_csv(PATH, {how}).to_csv('run.csv', index=False)"


def _text(line: bytes) -> str:
    """A name or comment, in UTF-8, else as Windows writes it."""
    try:
        return line.decode("utf-8").strip()
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace").strip()


def _has_decimal_commas(rows: Sequence[Sequence[bytes]]) -> bool:
    cells = [cell for row in rows for cell in row]
    return any(re.fullmatch(rb"[+-]?\d+,\d+([eE][+-]?\d+)?", cell) for cell in cells) and not any(
        re.fullmatch(rb"[+-]?\d+\.\d+([eE][+-]?\d+)?", cell) for cell in cells
    )


def _column(name: str, cells: Sequence[bytes], comma: bool) -> Column:
    kinds = [kind for cell in cells if (kind := _kind(cell, comma)) != "missing"]
    kind = max(set(kinds), key=kinds.count) if kinds else "number"
    if kind != "array":
        return Column(name, kind)
    sizes = [len(_elements(cell)) for cell in cells if _ARRAY.match(cell)]
    return Column(name, "number", max(set(sizes), key=sizes.count))


def _kind(cell: bytes, comma: bool) -> str:
    """What a cell holds: 'number', 'array', 'text', or 'missing'."""
    if cell.lower() in _MISSING:
        return "missing"
    if not np.isnan(_number(cell.replace(b",", b".") if comma else cell)):
        return "number"
    inside = [_number(part) for part in _elements(cell)] if _ARRAY.match(cell) else [np.nan]
    return "text" if np.isnan(inside).all() else "array"


# -- the rows -----------------------------------------------------------------------------------------


def _text_blocks(file: BinaryIO, path: Path) -> Iterator[bytes]:
    """Whole lines, as many as are read at once."""
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
        yield left


@lru_cache(_KEPT)  # a log is looked at before it is read
def _parsed(text: bytes, dialect: Dialect) -> tuple[FloatArray, int]:
    """Rows of some lines, and how many lines were dropped."""
    if (plain := _plain(text, dialect)) is not None:
        return sealed(plain), 0
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith(_COMMENT)]
    kept = [cells for line in lines if len(cells := _cells(line, dialect.delimiter)) == len(dialect.columns)]
    rows, place = np.full((len(kept), dialect.width), np.nan), 0
    for column, cells in zip(dialect.columns, zip(*kept, strict=True), strict=bool(kept)):
        width = column.count or 1
        if column.kind != "text":
            block = _numbers(cells, column, dialect.decimal_comma)
            rows[:, place : place + width] = block.reshape(len(kept), width)
        place += width
    return sealed(rows), len(lines) - len(kept)


def _plain(text: bytes, dialect: Dialect) -> FloatArray | None:
    """Rows of lines that hold nothing but numbers, three times as fast; None where there is anything else."""
    numbers = all(column.kind == "number" and column.count is None for column in dialect.columns)
    if dialect.decimal_comma or not numbers or _COMMENT in text or b'"' in text:
        return None
    try:
        delimiter = dialect.delimiter.decode()
        rows = np.loadtxt(io.BytesIO(text), delimiter=delimiter, comments=None, ndmin=2, encoding="latin-1")
    except ValueError:
        return None
    return rows if rows.shape[1] == len(dialect.columns) else None


def _cells(line: bytes, delimiter: bytes) -> list[bytes]:
    """The cells of a line, without quotes and spaces about them."""
    if b'"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    text = line.decode("latin-1")
    cells = next(csv.reader([text], delimiter=delimiter.decode(), skipinitialspace=True), [])
    return [cell.strip().encode("latin-1") for cell in cells]


def _elements(cell: bytes) -> list[bytes]:
    """The numbers of an array in a cell such as [0.1, 0.2]; any other cell is one element."""
    inner = _ARRAY.match(cell)
    return re.split(rb"[,;\s]+", inner.group(1).strip()) if inner else [cell]


def _numbers(cells: Sequence[bytes], column: Column, comma: bool) -> FloatArray:
    """Cells of one column as numbers, shape (n * column.count,); NaN where a cell holds none."""
    if column.count is not None:
        arrays, blank = map(_elements, cells), [b""] * column.count
        cells = [part for array in arrays for part in (array if len(array) == column.count else blank)]
    if comma:
        cells = [cell.replace(b",", b".") for cell in cells]
    try:
        return np.fromiter(map(float, cells), np.float64, len(cells))
    except ValueError:
        return np.array([_number(cell) for cell in cells])


def _number(cell: bytes) -> float:
    """The number in a cell; 1 and 0 for true and false, NaN for anything else."""
    try:
        return float(cell)
    except ValueError:
        return {b"true": 1.0, b"false": 0.0}.get(cell.strip().lower(), np.nan)
