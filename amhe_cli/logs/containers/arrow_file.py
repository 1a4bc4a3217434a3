"""Parquet files by pyarrow; what they unfold to is measured before it is unfolded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.logs.containers.compression import check_growth

#: Rows of a parquet file that are unfolded at once.
_ROWS = 2**12
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
        for batch in file.iter_batches(_ROWS, columns=list({*wanted, _EPISODE} if there else wanted)):
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
