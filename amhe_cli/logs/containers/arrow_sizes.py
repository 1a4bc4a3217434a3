"""How large the buffers of a feather (Arrow) file are once unfolded, read before any is unfolded.

Each message of such a file is a flatbuffer of the table Message of Arrow's Message.fbs, and a body. A record
batch lists its buffers in the body; a compressed buffer begins with its unfolded size.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

#: A file begins with 'ARROW1' and two zeros; what follows is Arrow's stream format.
_MAGIC = 8
#: Fields of the tables, by their numbers in Message.fbs.
_HEADER, _DICTIONARY_DATA, _BUFFERS, _COMPRESSION = 2, 1, 2, 3


def unfolded_sizes(path: Path) -> Iterator[int]:
    """Bytes of each batch of a feather file once unfolded, in its order.

    Raises:
        ValueError: The file is damaged.
    """
    import pyarrow as pa

    with pa.memory_map(str(path)) as file:
        file.seek(_MAGIC)
        for message in pa.ipc.MessageReader.open_stream(file):
            if message.type in ("record batch", "dictionary"):
                try:
                    yield _unfolded(message)
                except struct.error as error:
                    raise ValueError(f"a batch whose description is damaged ({error})") from None


def _unfolded(message: Any) -> int:
    flat, body = memoryview(message.metadata), memoryview(message.body)
    batch = _table(flat, struct.unpack_from("<I", flat)[0], _HEADER)
    if message.type == "dictionary":
        batch = _table(flat, batch, _DICTIONARY_DATA)
    compressed, buffers = _field(flat, batch, _COMPRESSION), _table(flat, batch, _BUFFERS)
    total = 0
    for number in range(struct.unpack_from("<I", flat, buffers)[0]):
        offset, length = struct.unpack_from("<qq", flat, buffers + 4 + 16 * number)
        # -1: a buffer that is not compressed in spite of it all
        size = struct.unpack_from("<q", body, offset)[0] if compressed and length >= 8 else -1
        total += length if size < 0 else size
    return total


def _field(flat: memoryview, table: int, number: int) -> int:
    """Place of a field of the flatbuffer table at a place; 0 where it is left out."""
    layout = table - struct.unpack_from("<i", flat, table)[0]
    entry = 4 + 2 * number
    if entry >= struct.unpack_from("<H", flat, layout)[0]:
        return 0
    offset = struct.unpack_from("<H", flat, layout + entry)[0]
    return table + offset if offset else 0


def _table(flat: memoryview, table: int, number: int) -> int:
    """Place of the table or vector that a field of a table refers to."""
    place = _field(flat, table, number)
    return place + struct.unpack_from("<I", flat, place)[0]
