"""How a text table is written: its delimiter, its header, and what each column holds."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amhe_cli.core.errors import LogError

#: The first bytes of a file, by which it is judged.
_HEAD = 2**16
_DELIMITERS = (b",", b";", b"\t", b"|", b" ")
#: Marks of comments; Excel writes its delimiter into a first line 'sep=;'.
COMMENTS = (b"#", b"%", b"//", b"sep=")
#: Words that stand for a missing number.
MISSING = {b"", b"na", b"n/a", b"nan", b"null", b"none", b"-", b"nil"}
_ARRAY = re.compile(rb"^\s*[\[(](.*)[\])]\s*$")
_DATE = re.compile(rb"^\d{4}-\d\d-\d\d([ T]\d\d:\d\d(:\d\d([.,]\d+)?)?)?(Z|[+-]\d\d:?\d\d)?$")


@dataclass(frozen=True, slots=True)
class Column:
    """One column of the file.

    Args:
        name: The text in the header; the column's number as text where there is no header.
        kind: 'number', 'array' of numbers in one cell, 'date', or 'text', which is not read.
        count: Numbers in one cell; 1 but for arrays.
    """

    name: str
    kind: str
    count: int = 1


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
        return sum(column.count for column in self.columns)


def looks_like_text(head: bytes) -> bool:
    """Whether the first bytes of a file can be a text table: they hold no control characters."""
    control = sum(byte < 9 or 13 < byte < 32 or byte == 127 for byte in head)
    return bool(head) and not control


def dialect_of(path: Path) -> Dialect:
    """Find out how a text table is written.

    Raises:
        LogError: The file holds no table of numbers.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
        whole = len(head) < _HEAD
    mark = 3 if head.startswith(b"\xef\xbb\xbf") else 0
    lines = _lines(head[mark:], whole)
    first = next((i for i, (_, line) in enumerate(lines) if not is_comment(line)), None)
    if first is None:
        raise LogError(f"{path}: a text file without a line of numbers")
    rows = [line for _, line in lines[first:] if line.strip() and not is_comment(line)]
    delimiter = _delimiter(rows)
    cells = [cells_of(row, delimiter) for row in rows]
    comma = delimiter != b"," and _has_decimal_commas(cells[1:])
    has_header = not all(_kind(cell, comma) in ("number", "array", "date", "missing") for cell in cells[0])
    names, comments = [_text(cell) for cell in cells[0]], lines[:first]
    body, start = cells, lines[first][0]
    if has_header:
        count = 1
        if _is_row_of_units(cells, comma):
            units = [_text(cell).strip("[]() ") for cell in cells[1]]
            names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
            count = 2
        body = cells[count:]
        start = lines[first + count][0] if first + count < len(lines) else mark + len(head)
    else:
        commented = cells_of(comments[-1][1].lstrip(b"#% /"), delimiter) if comments else []
        if len(commented) == len(names) and len(names) > 1:
            names, comments = [_text(cell) for cell in commented], comments[:-1]
        else:
            names = [str(i) for i in range(len(names))]
    if not body:
        raise LogError(f"{path}: a table with a header and no rows")
    full = [row for row in body if len(row) == len(names)]
    if 2 * len(full) < len(body):
        raise LogError(f"{path}: a text file whose lines have different numbers of cells: no table")
    columns = tuple(_column(name, [row[i] for row in full], comma) for i, name in enumerate(names))
    if not any(column.kind in ("number", "array") for column in columns):
        raise LogError(f"{path}: a text file without a column of numbers")
    remarks = tuple(_text(line.lstrip(b"#% /")) for _, line in comments)
    return Dialect(delimiter, comma, columns, mark + start, remarks)


def _text(line: bytes) -> str:
    """A name or comment, in UTF-8, else as Windows writes it."""
    try:
        return line.decode("utf-8").strip()
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace").strip()


def _is_row_of_units(cells: Sequence[Sequence[bytes]], comma: bool) -> bool:
    """Whether the line under the header holds no number, and the one after it does."""
    if len(cells) < 3 or len(cells[1]) != len(cells[0]):
        return False
    first, second = ({_kind(cell, comma) for cell in row} for row in cells[1:3])
    return first <= {"text", "missing"} and "text" in first and "number" in second


def number_of(cell: bytes) -> float:
    """The number in a cell; 1 and 0 for true and false, NaN for anything else."""
    try:
        return float(cell)
    except ValueError:
        word = cell.strip().lower()
        return {b"true": 1.0, b"false": 0.0}.get(word, np.nan)


def _lines(head: bytes, whole: bool) -> list[tuple[int, bytes]]:
    """Lines with the byte at which each begins; the last one is left out where it may go on."""
    lines, place = [], 0
    for line in head.split(b"\n"):
        lines.append((place, line.rstrip(b"\r")))
        place += len(line) + 1
    if not whole:
        lines.pop()
    return [(start, line) for start, line in lines if line.strip()]


def is_comment(line: bytes) -> bool:
    """Whether a line begins with the mark of a comment."""
    return line.lstrip().startswith(COMMENTS)


def _delimiter(rows: Sequence[bytes]) -> bytes:
    """The delimiter that cuts most lines into the same number of cells, more than one."""
    best, most = b",", 0.0
    for delimiter in _DELIMITERS:
        counts = [len(cells_of(row, delimiter)) for row in rows[:50]]
        usual = max(set(counts), key=counts.count)
        score = (usual > 1) * (counts.count(usual) / len(counts))
        # 1,5;2,5 is cut evenly by the comma too: an earlier delimiter must not win by chance
        if (
            delimiter == b";" and score >= most > 0.0 and all(b";" in row for row in rows[:50])
        ) or score > most + 1e-9:
            best, most = delimiter, score
    return best


def cells_of(line: bytes, delimiter: bytes) -> list[bytes]:
    """The cells of a line, without quotes and spaces about them."""
    if delimiter == b" ":
        return line.split()
    if b'"' not in line:
        return [cell.strip() for cell in line.split(delimiter)]
    text = line.decode("latin-1")
    cells = next(csv.reader([text], delimiter=delimiter.decode(), skipinitialspace=True), [])
    return [cell.strip().encode("latin-1") for cell in cells]


def elements_of(cell: bytes) -> list[bytes]:
    """The numbers of an array in a cell such as [0.1, 0.2]; any other cell is one element."""
    inner = _ARRAY.match(cell)
    return re.split(rb"[,;\s]+", inner.group(1).strip()) if inner else [cell]


def _has_decimal_commas(rows: Sequence[Sequence[bytes]]) -> bool:
    cells = [cell for row in rows for cell in row]
    return any(re.fullmatch(rb"[+-]?\d+,\d+([eE][+-]?\d+)?", cell) for cell in cells) and not any(
        re.fullmatch(rb"[+-]?\d+\.\d+([eE][+-]?\d+)?", cell) for cell in cells
    )


def _kind(cell: bytes, comma: bool) -> str:
    if cell.lower() in MISSING:
        return "missing"
    if not np.isnan(number_of(cell.replace(b",", b".") if comma else cell)):
        return "number"
    if _ARRAY.match(cell):
        inside = [number_of(part) for part in elements_of(cell)]
        return "array" if not np.isnan(inside).all() else "text"
    return "date" if _DATE.match(cell) else "text"


def _column(name: str, cells: Sequence[bytes], comma: bool) -> Column:
    kinds = [kind for cell in cells if (kind := _kind(cell, comma)) != "missing"]
    if not kinds:
        return Column(name, "number")
    kind = max(set(kinds), key=kinds.count)
    if kind != "array":
        return Column(name, kind)
    sizes = [len(elements_of(cell)) for cell in cells if _ARRAY.match(cell)]
    return Column(name, "array", max(set(sizes), key=sizes.count))
