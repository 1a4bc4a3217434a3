"""Tables as CSV and npz, in the form that `table_formats` reads without a word: names, seconds, metadata."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.files import whole
from amhe_cli.logs.containers.table_file import START, unit_of

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
