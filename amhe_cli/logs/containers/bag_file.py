"""ROS 1 bags (format 2.0), read in file order so that unindexed and cut-off ones can be read too.

The format has no checksum of its own: bz2 and lz4 chunks carry one, plain chunks do not. Every message is
compared with the index that follows its chunk; a flipped bit inside a plain payload cannot be detected.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from amhe_cli.logs.containers.raw import Batch, Connection, LogFile, Unfolder, messages, normal_type, stamps

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
_NS = 10**9


class _Record(NamedTuple):
    op: int
    fields: dict[bytes, bytes]
    start: int
    stop: int


class _Row(NamedTuple):
    """A message: position of its record, connection, time and payload."""

    offset: int
    connection: int
    time_ns: int
    start: int
    length: int


class BagFile(LogFile):
    """A ROS 1 bag; see LogFile."""

    format = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        super().__init__()
        with path.open("rb") as file:
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._by_id: dict[int, Connection] = {}
        self._times: list[int] = []
        self._expected = 0
        self._read = 0

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), chunk by chunk."""
        chunks = self._index()
        unfolder = Unfolder(len(self._data))
        loose: list[_Row] = []
        position = len(MAGIC)
        while position < len(self._data):
            try:
                record = _record(self._data, position)
            except ValueError as error:
                later = [chunk for chunk in chunks if chunk > position]
                self.problems.append(f"the record at byte {position} is lost: {error}")
                position = min(later, default=len(self._data))
                continue
            position = record.stop
            if record.op == _CHUNK:
                position, index = self._index_after(position)
                yield from self._emit(*self._chunk(record, index, unfolder), topics)
            elif record.op == _MESSAGE:
                loose += _message(record, record.start, 0)
            elif record.op == _CONNECTION:
                self._declare(self._data, record)
        yield from self._emit(self._data, loose, topics)
        self._conclude(bool(chunks))

    def _conclude(self, closed: bool) -> None:
        if not closed:
            seconds = (max(self._times) - min(self._times)) / _NS if self._times else 0.0
            self.problems.append(
                f"recovered {messages(self._read)} up to t = {seconds:.1f} s; the bag has no index "
                "(recorder crashed or copy incomplete; `rosbag reindex` restores it)"
            )
        elif self._read < self._expected:
            self.problems.append(
                f"{self._expected - self._read} of {messages(self._expected)} lost to damage"
            )

    def _index(self) -> list[int]:
        """Declare the connections listed at the end of the bag.

        Returns:
            Places of the chunks; none if there is no usable index.
        """
        chunks: list[int] = []
        try:
            header = _record(self._data, len(MAGIC))
            (position,) = struct.unpack("<Q", header.fields[b"index_pos"])
            while 0 < position < len(self._data):
                record = _record(self._data, position)
                position = record.stop
                if record.op == _CONNECTION:
                    self._declare(self._data, record)
                elif record.op == _CHUNK_INFO:
                    chunks.append(struct.unpack("<Q", record.fields[b"chunk_pos"])[0])
                    counts = np.frombuffer(self._data[record.start : record.stop], "<u4")
                    self._expected += int(counts[1::2].sum())
        except (ValueError, KeyError, struct.error):
            return []
        return chunks

    def _declare(self, data: bytes | mmap.mmap, record: _Record) -> None:
        try:
            number = _U32.unpack(record.fields[b"conn"])[0]
            if number in self._by_id:
                return
            inner = _fields(bytes(data[record.start : record.stop]))
            connection = Connection(
                re.sub("/+", "/", record.fields[b"topic"].decode()).rstrip("/"),
                normal_type(inner[b"type"].decode()),
                "ros1",
                inner[b"message_definition"].decode("utf-8", "replace"),
                "ros1msg",
                inner[b"md5sum"].decode(),
            )
        except (KeyError, ValueError, struct.error):
            self.problems.append("the declaration of a topic is damaged")
            return
        self._by_id[number] = connection
        self.connections.append(connection)

    def _chunk(
        self, record: _Record, index: dict[int, dict[int, int]] | None, unfolder: Unfolder
    ) -> tuple[bytes, list[_Row]]:
        try:
            kind, size = record.fields[b"compression"].decode(), _U32.unpack(record.fields[b"size"])[0]
            if record.start == record.stop:
                return b"", []  # still being written when the recorder stopped: its messages follow
            data = unfolder.unfold(kind, self._data[record.start : record.stop], size)
        except (ValueError, KeyError, struct.error) as error:
            self.problems.append(f"a chunk at byte {record.start} is lost: {error}")
            return b"", []
        rows = self._messages(data)
        if index is not None:  # what contradicts it is damaged
            rows = [row for row in rows if index.get(row.connection, {}).get(row.offset) == row.time_ns]
        return data, rows

    def _messages(self, data: bytes) -> list[_Row]:
        rows: list[_Row] = []
        position = 0
        try:
            while position < len(data):
                record = _record(data, position)
                if record.op == _MESSAGE:
                    rows += _message(record, record.start, position)
                elif record.op == _CONNECTION:
                    self._declare(data, record)
                position = record.stop
        except ValueError as error:
            self.problems.append(f"the end of a chunk is lost: {error}")
        return rows

    def _index_after(self, position: int) -> tuple[int, dict[int, dict[int, int]] | None]:
        """The index records that follow a chunk: connection -> {place in the chunk: time}."""
        index: dict[int, dict[int, int]] = {}
        while position < len(self._data):
            try:
                record = _record(self._data, position)
                if record.op != _INDEX:
                    break
                entries = np.frombuffer(self._data[record.start : record.stop], "<u4").reshape(-1, 3)
                times = entries[:, 0].astype(np.int64) * _NS + entries[:, 1]
                number = _U32.unpack(record.fields[b"conn"])[0]
            except (ValueError, KeyError, struct.error):
                return position, None
            index.setdefault(number, {}).update(zip(entries[:, 2].tolist(), times.tolist(), strict=True))
            position = record.stop
        return position, index or None

    def _emit(
        self, data: bytes | mmap.mmap, rows: list[_Row], topics: Collection[str] | None
    ) -> Iterator[Batch]:
        self._read += len(rows)
        by_connection: dict[int, list[_Row]] = {}
        for row in rows:
            by_connection.setdefault(row.connection, []).append(row)
        for number, group in by_connection.items():
            connection = self._by_id.get(number)
            times = [row.time_ns for row in group]
            self._times += (times[0], times[-1])
            if connection is None:
                self.problems.append(f"{messages(len(group))} of a topic whose declaration is lost")
            elif topics is None or connection.topic in topics:
                starts, lengths = np.array([(row.start, row.length) for row in group]).T
                buffer = np.frombuffer(data, np.uint8)
                yield Batch(connection, stamps(times), stamps(times), buffer, starts, lengths)


def _record(data: bytes | mmap.mmap, position: int) -> _Record:
    """Parse the record at `position`.

    Raises:
        ValueError: If it is damaged, or does not end within the data.
    """
    if position + 8 > len(data):
        raise ValueError("it is cut off")
    header_end = position + 4 + _U32.unpack_from(data, position)[0]
    if header_end + 4 > len(data) or header_end - position > 2**20:
        raise ValueError("it is cut off")
    fields = _fields(bytes(data[position + 4 : header_end]))
    start = header_end + 4
    stop = start + _U32.unpack_from(data, header_end)[0]
    if stop > len(data):
        raise ValueError("it is cut off")
    op = fields.get(b"op", b"")
    if len(op) != 1 or not _MESSAGE <= op[0] <= _CONNECTION:
        raise ValueError("it is damaged")
    return _Record(op[0], fields, start, stop)


def _fields(header: bytes) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        if position + 4 > len(header):
            raise ValueError("its header is damaged")
        end = position + 4 + _U32.unpack_from(header, position)[0]
        name, equals, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not equals:
            raise ValueError("its header is damaged")
        fields[name] = value
        position = end
    return fields


def _message(record: _Record, start: int, offset: int) -> list[_Row]:
    try:
        seconds, nanoseconds = _TIME.unpack(record.fields[b"time"])
        connection = _U32.unpack(record.fields[b"conn"])[0]
    except (KeyError, struct.error):
        return []
    return [_Row(offset, connection, seconds * _NS + nanoseconds, start, record.stop - start)]
