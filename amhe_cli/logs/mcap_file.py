"""MCAP containers, whole or damaged.

Each chunk carries a checksum of its messages, which is always verified; a chunk that fails is left out
and said so. Chunks are found in file order and, where the file was closed, through its summary as well,
so that damage between chunks costs one chunk and not the rest of the file.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Metadata, Schema, Statistics
from numpy.typing import NDArray

from amhe_cli.logs.compression import LIMIT, decompress
from amhe_cli.logs.raw import Batch, Channel, DefinitionFormat, messages, normal_type

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
#: A message record up to its payload.
_MESSAGE = np.dtype(
    [("opcode", "u1"), ("size", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log_ns", "<u8"),
     ("publish_ns", "<u8")]
)  # fmt: skip
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<QQI")
_BATCH_BYTES = 2**25
_FORMATS: dict[str, DefinitionFormat] = {"ros2msg": "ros2msg", "ros2idl": "ros2idl", "ros1msg": "ros1msg"}


@dataclass(slots=True)
class _Summary:
    """What a closed file says of itself at its end."""

    start: int
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    records: list[tuple[int, bytes]] = field(default_factory=list)
    messages: int | None = None


class McapFile:
    """An MCAP file; see LogFile."""

    format = "MCAP"

    def __init__(self, path: Path) -> None:
        with path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self.channels: list[Channel] = []
        self.problems: list[str] = []
        self.metadata: dict[str, str] = {}
        self._schemas: dict[int, Schema] = {}
        self._by_id: dict[int, Channel] = {}
        self._closed = self._data[-len(MAGIC) :] == MAGIC
        self._notes: list[bytes] = []
        self._intact = True
        self._broken_chunks = 0
        self._read = 0
        self._latest_ns = 0
        self._first_ns: int | None = None

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), chunk by chunk."""
        summary = self._summary()
        for opcode, body in summary.records if summary else ():
            self._declare(opcode, body)
        pieces, whole = self._pieces(summary)
        for start, stop, opcode in pieces:
            if opcode != Opcode.CHUNK:
                yield from self._records(self._data, start, stop, topics)
            elif (data := self._unfold(start, stop)) is not None:
                yield from self._records(data, 0, len(data), topics)
        self._conclude(summary, whole)

    def read_metadata(self) -> dict[str, str]:
        """The record named 'amhe', without decoding any message."""
        pieces, _ = self._pieces(self._summary())
        if not self._intact:  # find out whether a chunk is to blame
            for start, stop, opcode in pieces:
                if opcode == Opcode.CHUNK and self._unfold(start, stop) is None:
                    break
        self._note_metadata()
        return self.metadata

    def _conclude(self, summary: _Summary | None, whole: bool) -> None:
        self._note_metadata()
        expected = summary.messages if summary else None
        if not whole and summary is None:
            seconds = (self._latest_ns - (self._first_ns or 0)) / 1e9
            self.problems.append(
                f"recovered {messages(self._read)} up to t = {seconds:.1f} s; the file was not closed "
                "(recorder crashed or copy incomplete)"
            )
        elif not self._closed:
            self.problems.append(
                f"the end of the file is missing, but its {messages(self._read)} are all there"
            )
        elif expected is not None and expected > self._read:
            self.problems.append(f"{expected - self._read} of {messages(expected)} lost to damage")

    # -- where the pieces are -------------------------------------------------------------------------

    def _summary(self) -> _Summary | None:
        """The summary section; None where there is none or its checksum is wrong."""
        tail = 9 + _FOOTER.size + len(MAGIC)
        if len(self._data) < tail + len(MAGIC) or not self._closed:
            return None
        at = len(self._data) - tail
        opcode, size = _RECORD.unpack_from(self._data, at)
        start, _, crc = _FOOTER.unpack_from(self._data, at + 9)
        if opcode != Opcode.FOOTER or size != _FOOTER.size or not 0 < start <= at:
            return None
        if crc and zlib.crc32(self._data[start : at + 9 + 16]) != crc:
            self.problems.append("the summary at the end of the file is damaged and not used")
            return None
        summary = _Summary(start)
        try:
            for opcode, first, stop in _split(self._data, start, at):
                self._summarise(summary, opcode, self._data[first:stop])
        except (ValueError, struct.error, EndOfFile):
            return None
        return summary

    def _summarise(self, summary: _Summary, opcode: int, body: bytes) -> None:
        if opcode == Opcode.CHUNK_INDEX:
            index = ChunkIndex.read(_stream(body))
            summary.chunks[index.chunk_start_offset] = index
        elif opcode == Opcode.STATISTICS:
            summary.messages = Statistics.read(_stream(body)).message_count
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            summary.records.append((opcode, body))

    def _pieces(self, summary: _Summary | None) -> tuple[list[tuple[int, int, int]], bool]:
        """Find the chunks and the runs of loose records.

        Returns:
            (start, stop, opcode) of each in file order; whether the data section was walked to its end.
        """
        end = summary.start if summary else len(self._data)
        chunks: dict[int, tuple[int, int, int]] = {}
        loose: list[tuple[int, int, int]] = []
        whole, crc, crc_end = False, 0, 0
        try:
            for opcode, start, stop in _split(self._data, len(MAGIC), end):
                if opcode == Opcode.DATA_END:
                    whole = True
                    (crc,) = struct.unpack_from("<I", self._data, start)
                    crc_end = start - 9
                    break
                if opcode == Opcode.CHUNK:
                    chunks[start - 9] = (start, stop, opcode)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    _extend(loose, start - 9, stop)
                elif opcode == Opcode.METADATA:
                    self._notes.append(self._data[start:stop])
        except ValueError as error:
            self.problems.append(f"the file is damaged or cut off: {error}")
        self._intact = not (whole and crc) or zlib.crc32(memoryview(self._data)[:crc_end]) == crc
        if loose and not self._intact:
            raise ValueError("its checksum is wrong and it has no chunks: no message in it can be trusted")
        for offset, index in (summary.chunks if summary else {}).items():
            chunks.setdefault(offset, (offset + 9, offset + index.chunk_length, Opcode.CHUNK))
        return sorted([*chunks.values(), *loose]), whole

    def _note_metadata(self) -> None:
        """Take the metadata, unless the checksum over the file is wrong and no chunk is to blame."""
        if self._notes and not self._intact and not self._broken_chunks:
            self.problems.append("the file's checksum is wrong: its metadata record is not used")
            return
        for body in self._notes:
            try:
                record = Metadata.read(_stream(body))
            except (ValueError, struct.error, EndOfFile):
                self.problems.append("a metadata record is damaged and not used")
                continue
            if record.name == "amhe":
                self.metadata |= record.metadata

    # -- what is in a piece ---------------------------------------------------------------------------

    def _unfold(self, start: int, stop: int) -> bytes | None:
        """Records of a chunk; None, with a note, if it is damaged."""
        try:
            return self._checked(start, stop)
        except (ValueError, struct.error) as error:
            self._broken_chunks += 1
            self.problems.append(f"a chunk at byte {start - 9}{self._span(start)} is lost: {error}")
            return None

    def _span(self, start: int) -> str:
        first, last = (
            struct.unpack_from("<QQ", self._data, start) if start + 16 <= len(self._data) else (0, 0)
        )
        origin = self._first_ns if self._first_ns is not None else first
        seconds = (first - origin) / 1e9, (last - origin) / 1e9
        return (
            f" (t = {seconds[0]:.2f} to {seconds[1]:.2f} s)" if -1e6 < seconds[0] <= seconds[1] < 1e6 else ""
        )

    def _checked(self, start: int, stop: int) -> bytes:
        """Records of a chunk, decompressed, checksum verified."""
        if stop > len(self._data):
            raise ValueError("the file ends within it")
        opcode, length = _RECORD.unpack_from(self._data, start - 9)
        if opcode != Opcode.CHUNK or length != stop - start:
            raise ValueError("its header is damaged")
        _, _, size, crc = _CHUNK.unpack_from(self._data, start)
        at = start + _CHUNK.size
        (name_length,) = struct.unpack_from("<I", self._data, at)
        if name_length > 16:
            raise ValueError("its header is damaged")
        name = self._data[at + 4 : at + 4 + name_length].decode("utf-8")
        at += 4 + name_length
        (packed,) = struct.unpack_from("<Q", self._data, at)
        if at + 8 + packed > stop:
            raise ValueError("its header is damaged")
        data = decompress(name, self._data[at + 8 : at + 8 + packed], size)
        if crc and zlib.crc32(data) != crc:
            raise ValueError("its checksum is wrong")
        return data

    def _records(
        self, data: bytes | mmap.mmap, start: int, stop: int, topics: Collection[str] | None
    ) -> Iterator[Batch]:
        buffer = np.frombuffer(data, np.uint8)
        places: list[int] = []
        position, flush_at = start, start + _BATCH_BYTES
        unpack, message = _RECORD.unpack_from, int(Opcode.MESSAGE)
        try:
            while position < stop:  # the one loop over all messages: only what each needs is in it
                opcode, size = unpack(data, position)
                after = position + 9 + size
                if after > stop:
                    raise ValueError(f"the record at byte {position} is cut off")
                if opcode == message:
                    places.append(position)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._declare(opcode, bytes(data[position + 9 : after]))
                position = after
                if position > flush_at:
                    yield from self._flush(buffer, places, topics)
                    places, flush_at = [], position + _BATCH_BYTES
        except (ValueError, struct.error, EndOfFile) as error:
            self.problems.append(f"records are damaged: {error}")
        yield from self._flush(buffer, places, topics)

    def _flush(
        self, buffer: NDArray[np.uint8], places: list[int], topics: Collection[str] | None
    ) -> Iterator[Batch]:
        starts = np.array(places, dtype=np.int64)
        starts = starts[starts + _MESSAGE.itemsize <= buffer.size]
        if not starts.size:
            return
        rows = np.lib.stride_tricks.sliding_window_view(buffer, _MESSAGE.itemsize)[starts]
        heads = rows.view(_MESSAGE)[:, 0]
        self._count(heads["log_ns"])
        for number in np.unique(heads["channel"]).tolist():
            mine = np.flatnonzero(heads["channel"] == number)
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
        self._read += log_ns.size
        first, last = int(log_ns.min()), int(log_ns.max())
        self._first_ns = first if self._first_ns is None else min(self._first_ns, first)
        self._latest_ns = max(self._latest_ns, last)

    def _declare(self, opcode: int, body: bytes) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(_stream(body))
            self._schemas[schema.id] = schema
            return
        record = ChannelRecord.read(_stream(body))
        if record.id in self._by_id:
            return
        schema = self._schemas.get(record.schema_id)
        text = schema.data.decode("utf-8", "replace") if schema else ""
        channel = Channel(
            record.topic,
            normal_type(schema.name) if schema else "",
            record.message_encoding,
            text,
            _FORMATS.get(schema.encoding, "") if schema else "",
        )
        self._by_id[record.id] = channel
        self.channels.append(channel)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _extend(runs: list[tuple[int, int, int]], start: int, stop: int) -> None:
    """Join neighbouring loose records into one run."""
    if runs and runs[-1][1] == start:
        start = runs.pop()[0]
    runs.append((start, stop, 0))


def _split(data: bytes | mmap.mmap, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of each record's body.

    Raises:
        ValueError: Where a record does not end within the bytes that there are.
    """
    unpack, position = _RECORD.unpack_from, start
    while position < stop:
        if position + 9 > stop:
            raise ValueError(f"the record at byte {position} is cut off")
        opcode, size = unpack(data, position)
        first = position + 9
        position = first + size
        if size > LIMIT or position > stop or not opcode > 0:
            raise ValueError(f"the record at byte {first - 9} is cut off")
        yield opcode, first, position
