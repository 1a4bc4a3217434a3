"""Records and chunks of an MCAP file, and whether they are intact."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from mmap import mmap
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from numpy.typing import NDArray

from amhe_cli.logs.containers.compression import Unfolder

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
#: Bytes of a message before its payload, and of an index before its stamps and places.
_STAMPED, _INDEXED = 22, 6
#: What parsing a damaged record raises.
PARSE_ERRORS = (ValueError, struct.error, EndOfFile)


class Piece(NamedTuple):
    """A chunk's body, or a run of records outside of chunks."""

    start: int
    stop: int
    is_chunk: bool


def unfolded(data: mmap | bytes, chunk: Piece, unfolder: Unfolder) -> bytes:
    """Records of a chunk, decompressed, checksum verified.

    Raises:
        ValueError: If the chunk is damaged, or beyond the limit `piece_mib`.
    """
    if chunk.stop > len(data):
        raise ValueError("the file ends within it")
    head = _head(data, chunk)
    records = unfolder.unfold(head.kind, data[head.at : head.stop], head.size)
    if head.crc and zlib.crc32(records) != head.crc:
        raise ValueError("its checksum is wrong")
    return records


def indexed(data: mmap, chunk: Piece, size: int) -> NDArray[np.uint64]:
    """Where the messages of a chunk begin in its records, in their order, as the index behind it says.

    Nothing of it is certain: see `is_chain`. An index with more entries than there can be messages in
    `size` bytes is not read on.
    """
    found, left = [np.empty(0, dtype=np.uint64)], size // (RECORD.size + _STAMPED)
    try:
        for opcode, start, stop in split(data, chunk.stop, len(data)):
            left -= max(1, (stop - start) // 16)
            if opcode != Opcode.MESSAGE_INDEX or left < 0:
                break
            numbers = np.frombuffer(data, "<u8", max(stop - start - _INDEXED, 0) // 8, start + _INDEXED)
            found.append(numbers[1::2])  # each stands behind the message's stamp
    except PARSE_ERRORS:
        pass  # the walk over the file has noted it
    return np.sort(np.concatenate(found))


def is_chain(records: NDArray[np.uint8], starts: NDArray[np.uint64]) -> bool:
    """Whether records are messages at these places (n,), one behind the other, and nothing else."""
    if not starts.size or starts[0] != 0 or starts[-1] > records.size - RECORD.size:
        return False
    heads = np.lib.stride_tricks.sliding_window_view(records, RECORD.size)[starts.astype(np.int64)]
    sizes = heads[:, 1:].copy().view("<u8")[:, 0]
    next_ones = np.append(starts[1:], np.uint64(records.size))
    sound = (heads[:, 0] == Opcode.MESSAGE) & (sizes < records.size) & (starts + sizes + 9 == next_ones)
    return bool(sound.all())


class _Head(NamedTuple):
    """Header of a chunk: compression, uncompressed size, checksum, first and last stamp."""

    kind: str
    size: int
    crc: int
    at: int
    stop: int


def _head(data: mmap | bytes, chunk: Piece) -> _Head:
    start, stop = chunk.start, chunk.stop
    opcode, length = RECORD.unpack_from(data, start - 9)
    if opcode != Opcode.CHUNK or length != stop - start or length < _CHUNK.size + 12:
        raise ValueError("its header is damaged")
    _, _, size, crc = _CHUNK.unpack_from(data, start)
    at = start + _CHUNK.size
    (name_length,) = struct.unpack_from("<I", data, at)
    if name_length > 16 or at + 12 + name_length > stop:
        raise ValueError("its header is damaged")
    name = data[at + 4 : at + 4 + name_length].decode("utf-8")
    at += 12 + name_length
    (packed,) = struct.unpack_from("<Q", data, at - 8)
    if at + packed > stop:
        raise ValueError("its header is damaged")
    return _Head(name, size, crc, at, at + packed)


def span_ns(data: mmap, chunk: Piece) -> tuple[int, int] | None:
    """First and last stamp [ns] in a chunk's header; None where they make no sense."""
    if chunk.start + 16 > len(data):
        return None
    first, last = struct.unpack_from("<QQ", data, chunk.start)
    return (first, last) if first <= last < first + 10**15 else None


def stream(body: bytes) -> ReadDataStream:
    """A record's body as the stream that the records of `mcap` are read from."""
    return ReadDataStream(BytesIO(body))


def split(data: mmap, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record's body.

    Raises:
        ValueError: A record does not end within the bytes that there are.
    """
    position = start
    while position < stop:
        if position + 9 > stop:
            raise ValueError(f"the record at byte {position} is cut off")
        opcode, size = RECORD.unpack_from(data, position)
        first = position + 9
        position = first + size
        if position > stop or opcode == 0:
            raise ValueError(f"the record at byte {first - 9} is cut off")
        yield opcode, first, position
