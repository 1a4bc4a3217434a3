"""Parquet and feather files by pyarrow; what they unfold to is measured before it is unfolded."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.logs.containers.compression import check_growth

#: Rows of a parquet file that are unfolded at once.
_ROWS = 2**12
#: The column of a LeRobot dataset that says which episode a row is of.
_EPISODE = "episode_index"
#: An Arrow file begins with 'ARROW1' and two zeros; what follows is Arrow's stream format.
_MAGIC = 8
#: Number of the field of a Message that refers to its batch, in Arrow's Message.fbs.
_BATCH = 2
#: Number of the field of a DictionaryBatch that refers to its data.
_DATA = 1
#: Numbers of the fields of a RecordBatch that refer to its buffers and its compression.
_BUFFERS, _COMPRESSION = 2, 3


def parquet_arrays(
    path: Path, columns: Sequence[str] | None = None, episode: int | None = None
) -> dict[str, np.ndarray]:
    """Columns of numbers of a parquet file.

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
        wanted = [name for name in number_columns(schema) if columns is None or name in columns]
        there = episode is not None and _EPISODE in schema.names
        for batch in file.iter_batches(_ROWS, columns=list({*wanted, _EPISODE} if there else wanted)):
            size += batch.nbytes
            check_growth(path, size)
            batch = (
                batch.filter(pa.array(batch[_EPISODE].to_numpy(zero_copy_only=False) == episode))
                if there
                else batch
            )
            if there and batches and not batch.num_rows:
                break  # the rows of an episode are together
            batches += [batch.select(wanted)] if batch.num_rows else []
    return arrow_arrays(pa.Table.from_batches(batches, pa.schema([schema.field(name) for name in wanted])))


def feather_arrays(path: Path) -> dict[str, np.ndarray]:
    """Columns of numbers of a feather (Arrow) file.

    Raises:
        LogError: It is beyond the limits `piece_mib` and `growth`.
    """
    import pyarrow as pa

    with pa.memory_map(str(path)) as file:
        size = 0
        file.seek(_MAGIC)
        for message in pa.ipc.MessageReader.open_stream(file):
            size += unfolded_size(message) if message.type in ("record batch", "dictionary") else 0
            check_growth(path, size)
        reader = pa.ipc.open_file(file)
        batches = [reader.get_batch(i) for i in range(reader.num_record_batches)]
        for batch in batches:
            batch.validate()  # one longer than its buffers would be read beyond their end
    return arrow_arrays(pa.Table.from_batches(batches, reader.schema))


def unfolded_size(message: Any) -> int:
    """Bytes of an Arrow message's buffers once unfolded; each compressed one begins with that number.

    pyarrow does not tell it: it is read from the flatbuffer that describes the batch.

    Raises:
        ValueError: The description is damaged.
    """
    flat, body = memoryview(message.metadata), memoryview(message.body)
    try:
        batch = _referred(flat, struct.unpack_from("<I", flat)[0], _BATCH)
        batch = _referred(flat, batch, _DATA) if message.type == "dictionary" else batch
        compressed, buffers, total = _place(flat, batch, _COMPRESSION), _referred(flat, batch, _BUFFERS), 0
        for number in range(struct.unpack_from("<I", flat, buffers)[0]):
            offset, length = struct.unpack_from("<qq", flat, buffers + 4 + 16 * number)
            # -1: a buffer that is not compressed in spite of it all
            size = struct.unpack_from("<q", body, offset)[0] if compressed and length >= 8 else -1
            total += length if size < 0 else size
    except struct.error as error:
        raise ValueError(f"a batch whose description is damaged ({error})") from None
    return total


def _place(flat: memoryview, table: int, number: int) -> int:
    """Place of a field of the flatbuffer table at a place; 0 where it is left out."""
    layout = table - struct.unpack_from("<i", flat, table)[0]
    entry = 4 + 2 * number
    if entry >= struct.unpack_from("<H", flat, layout)[0]:
        return 0
    offset = struct.unpack_from("<H", flat, layout + entry)[0]
    return table + offset if offset else 0


def _referred(flat: memoryview, table: int, number: int) -> int:
    """Place of the table or vector that a field of a table refers to."""
    place = _place(flat, table, number)
    return place + struct.unpack_from("<I", flat, place)[0]


def number_columns(schema: Any) -> list[str]:
    """Columns of a pyarrow schema that `arrow_arrays` takes; texts, say, need not be unfolded."""
    return [name for name, kind in zip(schema.names, schema.types, strict=True) if _of_numbers(kind)]


def _of_numbers(kind: Any) -> bool:
    import pyarrow as pa

    if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)
    return number or pa.types.is_timestamp(kind)


def arrow_arrays(table: Any) -> dict[str, np.ndarray]:
    """The columns of numbers, times and lists of numbers of one length, of a pyarrow table."""
    import pyarrow as pa

    arrays: dict[str, np.ndarray] = {}
    for name in number_columns(table.schema):
        column = table[name].combine_chunks()
        kind = column.type
        if pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            flat = column.flatten().to_numpy(zero_copy_only=False)
            if len(column) and flat.size % len(column) == 0:
                arrays[name] = flat.reshape(len(column), -1)
        elif pa.types.is_timestamp(kind):
            arrays[name] = column.cast(pa.timestamp("ns")).to_numpy(zero_copy_only=False)
        else:
            arrays[name] = column.to_numpy(zero_copy_only=False)
    return arrays
