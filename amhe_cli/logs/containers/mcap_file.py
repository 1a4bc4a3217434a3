"""MCAP containers, whole or damaged.

Each chunk carries a checksum of its messages, which is always verified; a chunk that fails, or that the end
of the file cuts off, is reported and left out. In a file that was written without checksums, a flipped bit in
a payload cannot be detected.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Metadata, Schema, Statistics
from numpy.typing import NDArray

from amhe_cli.core.arrays import IntArray
from amhe_cli.logs.containers.raw import (
    Batch,
    Connection,
    DefinitionFormat,
    LogFile,
    Unfolder,
    messages,
    normal_type,
)

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
    kind, size, crc, content = _head(data, chunk)
    records = unfolder.unfold(kind, data[content], size)
    if crc and zlib.crc32(records) != crc:
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


def _head(data: mmap | bytes, chunk: Piece) -> tuple[str, int, int, slice]:
    """Compression of a chunk, size and checksum once unfolded, and where its content lies."""
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
    return name, size, crc, slice(at, at + packed)


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


#: A message record up to its payload.
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_ns", "<u8"),
     ("publish_ns", "<u8")]
)  # fmt: skip
_FOOTER = struct.Struct("<QQI")
_BATCH_BYTES = 2**25
_FORMATS: dict[str, DefinitionFormat] = {"ros2msg": "ros2msg", "ros2idl": "ros2idl", "ros1msg": "ros1msg"}


class McapMessages(LogFile):
    """Reads messages from records, and remembers the channels that these declare."""

    def __init__(self) -> None:
        super().__init__()
        #: Number of a schema -> its name, encoding and text, which all of its channels share.
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._by_id: dict[int, Connection] = {}
        self._read = 0
        self._latest_ns = 0
        self._first_ns: int | None = None

    def records(
        self, data: bytes | mmap, start: int, stop: int, topics: Collection[str] | None
    ) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all) in some bytes that are records and no chunks."""
        buffer = np.frombuffer(data, np.uint8)
        places: list[int] = []
        position, flush_at = start, start + _BATCH_BYTES
        unpack, message = RECORD.unpack_from, int(Opcode.MESSAGE)
        try:
            while position < stop:  # a loop over all messages: only what each needs is in it
                opcode, size = unpack(data, position)
                after = position + 9 + size
                if after > stop:
                    raise ValueError(f"the record at byte {position} is cut off")
                if opcode == message:
                    places.append(position)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._declare(opcode, bytes(data[position + 9 : after]))
                else:
                    raise ValueError(f"the record at byte {position} has no place there")
                position = after
                if position > flush_at:
                    yield from self._flush(buffer, np.array(places, dtype=np.int64), topics)
                    places, flush_at = [], position + _BATCH_BYTES
        except PARSE_ERRORS as error:
            self.problems.append(f"records are damaged: {error}")
        yield from self._flush(buffer, np.array(places, dtype=np.int64), topics)

    def _flush(
        self, buffer: NDArray[np.uint8], starts: IntArray, topics: Collection[str] | None
    ) -> Iterator[Batch]:
        starts = starts[starts + _MESSAGE.itemsize <= buffer.size]
        if not starts.size:  # perhaps fewer bytes than a message has
            return
        rows = np.lib.stride_tricks.sliding_window_view(buffer, _MESSAGE.itemsize)[starts]
        heads = rows.view(_MESSAGE)[:, 0]
        sound = heads["size"] >= _MESSAGE.itemsize - 9
        starts, heads = starts[sound], heads[sound]
        self._count(heads["log_ns"])
        order = np.argsort(heads["channel"], kind="stable")
        numbers, first = np.unique(heads["channel"][order], return_index=True)
        for number, mine in zip(numbers.tolist(), np.split(order, first[1:]), strict=False):
            channel = self._by_id.get(number)
            if channel is None:
                self.problems.append(f"{messages(mine.size)} of a channel whose declaration is lost")
            elif topics is None or channel.topic in topics:
                yield Batch(
                    channel,
                    heads["log_ns"][mine].astype(np.int64),
                    heads["publish_ns"][mine].astype(np.int64),
                    buffer,
                    starts[mine] + _MESSAGE.itemsize,
                    heads["size"][mine].astype(np.int64) - (_MESSAGE.itemsize - 9),
                )

    def _count(self, log_ns: NDArray[np.uint64]) -> None:
        if not log_ns.size:
            return
        self._read += log_ns.size
        first, last = int(log_ns.min()), int(log_ns.max())
        self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
        self._latest_ns = max(self._latest_ns, last)

    def _declare(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream(body))
            text = schema.data.decode("latin-1" if schema.encoding == "protobuf" else "utf-8", "replace")
            self._schemas[schema.id] = schema.name, schema.encoding, text
            return
        record = ChannelRecord.read(stream(body))
        if record.id in self._by_id:
            return
        name, encoding, text = self._schemas.get(record.schema_id, ("", "", ""))
        channel = Connection(
            record.topic, normal_type(name), record.message_encoding, text, _FORMATS.get(encoding, "")
        )
        self._by_id[record.id] = channel
        self.connections.append(channel)


class McapFile(McapMessages):
    """An MCAP file; see LogFile.

    Chunks are found in file order and, where the file was closed, through its summary as well, so that damage
    between chunks costs one chunk and not the rest of the file.

    Raises:
        ValueError: Its messages are outside of chunks and the checksum over them is wrong.
    """

    format = "MCAP"

    def __init__(self, path: Path) -> None:
        super().__init__()
        with path.open("rb") as file:
            self._data = mmap(file.fileno(), 0, access=ACCESS_READ)
        self._bodies: list[bytes] = []  # of metadata records
        self._broken_chunks = 0
        self._expected: int | None = None
        self._whole, self._summarised, self._intact = False, False, True
        self._closed = self._data[-len(MAGIC) :] == MAGIC
        self._pieces = self._walk()

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), chunk by chunk."""
        unfolder = Unfolder(len(self._data))
        for piece in self._pieces:
            if not piece.is_chunk:
                yield from self.records(self._data, piece.start, piece.stop, topics)
            elif (data := self._unfold(piece, unfolder)) is not None:
                index, buffer = indexed(self._data, piece, len(data)), np.frombuffer(data, np.uint8)
                if buffer.size <= _BATCH_BYTES and is_chain(buffer, index):  # as it mostly is
                    yield from self._flush(buffer, index.astype(np.int64), topics)
                else:
                    yield from self.records(data, 0, len(data), topics)
        self._note_metadata()
        if not self._whole and not self._summarised:
            seconds = (self._latest_ns - (self._first_ns or 0)) / 1e9
            self.problems.append(
                f"recovered {messages(self._read)} up to t = {seconds:.1f} s; the file was not closed "
                "(recorder crashed or copy incomplete)"
            )
        elif not self._closed:
            self.problems.append(
                f"the end of the file is missing, but its {messages(self._read)} are all there"
            )
        elif self._expected is not None and self._expected > self._read:
            self.problems.append(
                f"{self._expected - self._read} of {messages(self._expected)} lost to damage"
            )

    def read_metadata(self) -> dict[str, str]:
        """The record named 'amhe', without decoding any message."""
        unfolder = Unfolder(len(self._data))
        for piece in self._pieces if not self._intact else ():  # is a chunk to blame?
            if piece.is_chunk and self._unfold(piece, unfolder) is None:
                break
        self._note_metadata()
        return self.metadata

    def _walk(self) -> list[Piece]:
        """Chunks and runs of other records, in file order, without unfolding them."""
        data = self._data
        chunks = {offset: Piece(offset + 9, stop, True) for offset, stop in self._summary().items()}
        loose: list[Piece] = []
        try:
            for opcode, start, stop in split(data, len(MAGIC), len(data)):
                if opcode == Opcode.CHUNK:
                    chunks[start - 9] = Piece(start, stop, True)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    begin = loose.pop().start if loose and loose[-1].stop == start - 9 else start - 9
                    loose.append(Piece(begin, stop, False))
                elif opcode == Opcode.METADATA:
                    self._bodies.append(data[start:stop])
                elif opcode == Opcode.DATA_END:
                    self._whole = True
                    (crc,) = struct.unpack_from("<I", data, start)
                    self._intact = not crc or zlib.crc32(memoryview(data)[: start - 9]) == crc
                    break
        except PARSE_ERRORS as error:
            self.problems.append(f"the file is damaged or cut off: {error}")
        if chunks and not self._whole:
            loose = []  # the walk went astray: these records may be anything
        if loose and not self._intact:
            raise ValueError("its checksum is wrong and it has no chunks: no message in it can be trusted")
        return sorted([*chunks.values(), *loose])

    def _summary(self) -> dict[int, int]:
        """Take over the content of the summary at the end; returns start and end of each chunk record."""
        data, declared = self._data, list[tuple[int, bytes]]()
        at = len(data) - len(MAGIC) - _FOOTER.size - 9
        if not self._closed or at < len(MAGIC):
            return {}
        opcode, size = RECORD.unpack_from(data, at)
        start, _, crc = _FOOTER.unpack_from(data, at + 9)
        if opcode == Opcode.FOOTER and size == _FOOTER.size and start == 0:
            return {}
        chunks: dict[int, int] = {}
        try:
            if opcode != Opcode.FOOTER or size != _FOOTER.size or start > at:
                raise ValueError
            if crc and zlib.crc32(data[start : at + 9 + _FOOTER.size - 4]) != crc:
                raise ValueError
            for opcode, first, stop in split(data, start, at):
                if opcode == Opcode.CHUNK_INDEX:
                    index = ChunkIndex.read(stream(data[first:stop]))
                    chunks[index.chunk_start_offset] = index.chunk_start_offset + index.chunk_length
                elif opcode == Opcode.STATISTICS:
                    self._expected = Statistics.read(stream(data[first:stop])).message_count
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    declared.append((opcode, data[first:stop]))
            self._summarised = True
        except PARSE_ERRORS:
            self.problems.append("the summary at the end of the file is damaged and not used")
            chunks = {}
        for opcode, body in declared:
            self._declare(opcode, body)
        return chunks

    def _note_metadata(self) -> None:
        """Take the metadata, unless the checksum over the file is wrong and no chunk is to blame."""
        if self._bodies and not self._intact and not self._broken_chunks:
            self.problems.append("the file's checksum is wrong: its metadata record is not used")
            return
        for body in self._bodies:
            try:
                record = Metadata.read(stream(body))
            except PARSE_ERRORS:
                self.problems.append("a metadata record is damaged and not used")
                continue
            if record.name == "amhe":
                self.metadata |= record.metadata

    def _unfold(self, chunk: Piece, unfolder: Unfolder) -> bytes | None:
        """Records of a chunk; None, with a note, if it is damaged."""
        try:
            return unfolded(self._data, chunk, unfolder)
        except PARSE_ERRORS as error:
            self._broken_chunks += 1
            span = span_ns(self._data, chunk)
            origin = self._first_ns if self._first_ns is not None or span is None else span[0]
            when = (
                ""
                if span is None
                else " (t = {:.2f} to {:.2f} s)".format(*((t - (origin or 0)) / 1e9 for t in span))
            )
            self.problems.append(f"a chunk at byte {chunk.start - 9}{when} is lost: {error}")
            return None
