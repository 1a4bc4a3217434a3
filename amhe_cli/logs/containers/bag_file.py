"""ROS 1 bags (format 2.0), read in file order so that unindexed and cut-off ones can be read too.

The format has no checksum of its own: bz2 and lz4 chunks carry one, plain chunks do not. A flipped bit inside
a plain chunk cannot be detected.
"""

from __future__ import annotations

import mmap
import re
import struct
from array import array
from collections.abc import Collection, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from amhe_cli.logs.containers.raw import Batch, Connection, LogFile, Unfolder, messages, normal_type

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_TIME = struct.Struct("<II")
_NS = 10**9
#: What parsing a damaged record raises.
_PARSE_ERRORS = (ValueError, KeyError, struct.error, StopIteration)


class _Record(NamedTuple):
    at: int
    op: int
    fields: dict[bytes, bytes]
    start: int
    stop: int


class _Row(NamedTuple):
    """A message: connection, time and place of its payload."""

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
        self._read = 0

    def batches(self, topics: Collection[str] | None) -> Iterator[Batch]:
        """Yield the messages of the named topics (None: all), chunk by chunk."""
        chunks = array("Q")  # places: a hostile bag has millions
        loose: list[_Row] = []
        index, expected, spans, begins = 0, 0, list[int](), [len(MAGIC)]
        for begin in begins:
            expected = 0
            try:
                for record in _records(self._data, begin):
                    if record.op == _HEADER:
                        (index,) = _U64.unpack(record.fields[b"index_pos"])
                    elif record.op == _CHUNK:
                        chunks.append(record.at)
                    elif record.op == _CHUNK_INFO:
                        expected += int(
                            np.frombuffer(self._data[record.start : record.stop], "<u4")[1::2].sum()
                        )
                        (at,) = _U64.unpack(record.fields[b"chunk_pos"])
                        if max(chunks[-1:], default=0) < at < index:
                            chunks.append(at)
                    else:
                        self._take(self._data, record, loose)
            except _PARSE_ERRORS as error:
                if begin < index < len(self._data):  # it lists the chunks behind the damage
                    begins.append(index)
                else:
                    self.problems.append(f"the rest of the bag is lost: {error}")
        unfolder = Unfolder(len(self._data))
        for data, rows in chain((self._chunk(at, unfolder) for at in chunks), [(self._data, loose)]):
            spans += [row.time_ns for row in rows[:1] + rows[-1:]]
            yield from self._emit(data, rows, topics)
        if not 0 < index < len(self._data):
            seconds = (max(spans) - min(spans)) / _NS if spans else 0.0
            self.problems.append(
                f"recovered {messages(self._read)} up to t = {seconds:.1f} s; the bag has no index "
                "(recorder crashed or copy incomplete; `rosbag reindex` restores it)"
            )
        elif self._read < expected:
            self.problems.append(f"{expected - self._read} of {messages(expected)} lost to damage")

    def _chunk(self, at: int, unfolder: Unfolder) -> tuple[bytes, list[_Row]]:
        """The content of the chunk at a place, and the messages in it."""
        rows: list[_Row] = []
        try:
            record = next(_records(self._data, at))
            if record.start == record.stop:
                return b"", rows  # still being written when the recorder stopped: its messages follow
            kind, size = record.fields[b"compression"].decode(), _U32.unpack(record.fields[b"size"])[0]
            data = unfolder.unfold(kind, self._data[record.start : record.stop], size)
        except _PARSE_ERRORS as error:
            self.problems.append(f"the chunk at byte {at} is lost: {error}")
            return b"", rows
        try:
            for inner in _records(data, 0):
                self._take(data, inner, rows)
        except _PARSE_ERRORS as error:
            self.problems.append(f"the end of a chunk is lost: {error}")
        return data, rows

    def _take(self, data: bytes | mmap.mmap, record: _Record, rows: list[_Row]) -> None:
        """Note a message in `rows`, or declare a connection; one that is damaged is left out."""
        if record.op not in (_MESSAGE, _CONNECTION):
            return
        try:
            (number,) = _U32.unpack(record.fields[b"conn"])
            if record.op == _MESSAGE:
                seconds, ns = _TIME.unpack(record.fields[b"time"])
                rows.append(_Row(number, seconds * _NS + ns, record.start, record.stop - record.start))
            elif number not in self._by_id:
                inner = _fields(bytes(data[record.start : record.stop]))
                self._by_id[number] = Connection(
                    re.sub("/+", "/", record.fields[b"topic"].decode()).rstrip("/"),
                    normal_type(inner[b"type"].decode()),
                    "ros1",
                    inner[b"message_definition"].decode("utf-8", "replace"),
                    "ros1msg",
                    inner[b"md5sum"].decode(),
                )
                self.connections.append(self._by_id[number])
        except _PARSE_ERRORS:
            if record.op == _CONNECTION:
                self.problems.append("the declaration of a topic is damaged")

    def _emit(
        self, data: bytes | mmap.mmap, rows: list[_Row], topics: Collection[str] | None
    ) -> Iterator[Batch]:
        self._read += len(rows)
        by_connection: dict[int, list[_Row]] = {}
        for row in rows:
            by_connection.setdefault(row.connection, []).append(row)
        for number, group in by_connection.items():
            connection = self._by_id.get(number)
            if connection is None:
                self.problems.append(f"{messages(len(group))} of a topic whose declaration is lost")
            elif topics is None or connection.topic in topics:
                _, times, starts, lengths = np.array(group).T
                yield Batch(connection, times, times, np.frombuffer(data, np.uint8), starts, lengths)


def _records(data: bytes | mmap.mmap, position: int) -> Iterator[_Record]:
    """All records from a position on but those of indexes.

    Raises:
        ValueError: One is damaged, or does not end within the data.
    """
    while position < len(data):
        start = position + 8 + int.from_bytes(data[position : position + 4], "little")
        stop = start + int.from_bytes(data[start - 4 : start], "little")
        if stop > len(data) or start - position > 2**20:
            raise ValueError(f"the record at byte {position} is cut off")
        fields = _fields(bytes(data[position + 4 : start - 4]))
        op = fields.get(b"op", b"")
        if len(op) != 1 or not _MESSAGE <= op[0] <= _CONNECTION:
            raise ValueError(f"the record at byte {position} is damaged")
        if op[0] != _INDEX:
            yield _Record(position, op[0], fields, start, stop)
        position = stop


def _fields(header: bytes) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        end = position + 4 + int.from_bytes(header[position : position + 4], "little")
        name, equals, value = header[position + 4 : end].partition(b"=")
        if end > len(header) or not equals:
            raise ValueError("a header is damaged")
        fields[name] = value
        position = end
    return fields
