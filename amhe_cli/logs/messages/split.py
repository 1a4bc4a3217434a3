"""Sort the messages of a connection by their layout, so that each group can be read at once."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages import protobuf
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.descriptors import ENCODING as PROTOBUF
from amhe_cli.logs.messages.descriptors import MalformedMessageError
from amhe_cli.logs.messages.json_rows import JsonRows
from amhe_cli.logs.messages.layout import Layout, most_fields, table_layout, walk
from amhe_cli.logs.messages.padding import Padding

_Bytes = NDArray[np.uint8]
#: Layouts remembered for each message length, the latest ones.
_CACHED_LAYOUTS = 64
#: Layouts of a protobuf topic beyond which its messages are brought to varints of one width.
_MANY_LAYOUTS = 32
#: Fields of all remembered layouts together.
_CACHED_FIELDS = 1_000_000
#: Layouts that the messages of one batch and length are matched with; further ones stand for one message.
_NEW_LAYOUTS = 64


def _rows(batch: Batch, members: IntArray, length: int) -> _Bytes:
    """Messages of one length, shape (n, length)."""
    if length == 0:  # of protobuf: every number in it is 0
        return np.empty((members.size, 0), dtype=np.uint8)
    return np.lib.stride_tricks.sliding_window_view(batch.buffer, length)[batch.starts[members]]


@dataclass(frozen=True, slots=True, eq=False)
class MessageGroup:
    """Messages of one batch that share a layout: rows (n, length), and which of the batch they are."""

    layout: Layout
    rows: _Bytes
    members: IntArray


class Splitter:
    """Sorts the messages of one connection by layout, and counts those that are damaged."""

    def __init__(self, connection: Connection, definitions: Definitions) -> None:
        self._connection = connection
        self._types = definitions.of(connection)
        self._layouts: dict[int, list[Layout]] = {}
        self._json = JsonRows() if connection.encoding == "json" else None
        if connection.encoding == TABLE:
            layout, size = table_layout(connection.definition)
            self._layouts[size] = [layout]
        self._left: list[IntArray] = []
        self._paddings: list[tuple[Layout, Padding]] = []
        self._fields = self._cached = 0
        self.damaged = 0
        self.reason = ""

    def split(self, batch: Batch) -> Iterator[MessageGroup]:
        """Yield groups that together hold every intact message of the batch."""
        if self._json is not None:
            yield from self._parsed(self._json, batch)
            return
        for length in np.unique(batch.lengths).tolist():
            members = np.flatnonzero(batch.lengths == length)
            if length == 0 and self._connection.encoding != PROTOBUF:
                self._damage("it is empty", members.size)
                continue
            if self._varies():
                self._left.append(members)
                continue
            rows = _rows(batch, members, length)
            yield from self._same_length(rows, members)
        if self._left:
            left, self._left = np.concatenate(self._left), []
            yield from self._of_one_width(batch, left)

    def _varies(self) -> bool:
        """Whether a protobuf topic has so many layouts that the widths of its varints must be to blame."""
        many = sum(map(len, self._layouts.values())) > _MANY_LAYOUTS
        return many and self._connection.encoding == PROTOBUF

    def _parsed(self, json: JsonRows, batch: Batch) -> Iterator[MessageGroup]:
        """JSON messages, which must be parsed one by one."""
        found: dict[int, tuple[Layout, list[int], list[FloatArray]]] = {}
        text = batch.buffer.tobytes()
        for i, (start, length) in enumerate(zip(batch.starts.tolist(), batch.lengths.tolist(), strict=True)):
            try:
                layout, numbers = json.row(text[start : start + length])
            except MalformedMessageError as error:
                self._damage(str(error), 1)
                continue
            _, members, rows = found.setdefault(id(layout), (layout, [], []))
            members.append(i)
            rows.append(numbers)
        for layout, members, rows in found.values():
            yield MessageGroup(layout, np.stack(rows).view(np.uint8), np.array(members, dtype=np.int64))

    def _of_one_width(self, batch: Batch, left: IntArray) -> Iterator[MessageGroup]:
        """Protobuf messages, whose varints are first brought to one width."""
        buffer = np.concatenate([batch.buffer, np.zeros(16, dtype=np.uint8)])
        for layout, padding in self._paddings:
            left = yield from self._padded(layout, padding, buffer, batch, left)
        while left.size:
            if self._fields > limits().fields:
                self._damage(beyond("fields", "the fields of its many layouts are"), left.size)
                return
            start = int(batch.starts[left[0]])
            message = batch.buffer[start : start + int(batch.lengths[left[0]])]
            try:
                padding = Padding(message.tobytes(), self._connection.type, self._types)
                layout = protobuf.walk(padding.template, self._connection.type, self._types)
            except MalformedMessageError as error:
                self._fields += most_fields(message.size)
                self._damage(str(error), 1)
                left = left[1:]
                continue
            self._fields += layout.fields + left.size  # all that are left are held against it
            self._paddings = [*self._paddings[1 - _CACHED_LAYOUTS :], (layout, padding)]
            left = yield from self._padded(layout, padding, buffer, batch, left)

    def _padded(
        self, layout: Layout, padding: Padding, buffer: _Bytes, batch: Batch, left: IntArray
    ) -> Generator[MessageGroup, None, IntArray]:
        """Yield the messages that a padding rewrites into a layout; return those that are left."""
        rows, alike = padding.rewritten(buffer, batch.starts[left], batch.lengths[left])
        here = left[alike]
        hits = np.ones(here.size, dtype=bool)
        if layout.strings and here.size:  # all else is alike already
            hits = layout.matches(rows)
        if hits.any():
            yield MessageGroup(layout, rows[hits], here[hits])
        taken = np.zeros(left.size, dtype=bool)
        taken[np.flatnonzero(alike)[hits]] = True
        return left[~taken]

    def _same_length(self, rows: _Bytes, members: IntArray) -> Iterator[MessageGroup]:
        known = self._layouts.setdefault(rows.shape[1], [])
        for layout in known:
            hits = layout.matches(rows)
            if hits.all():
                yield MessageGroup(layout, rows, members)
                return
            if hits.any():
                yield MessageGroup(layout, rows[hits], members[hits])
                rows, members = rows[~hits], members[~hits]
        for tries in count():
            if not members.size:
                break
            if self._varies():
                self._left.append(members)
                break
            if self._fields > limits().fields:
                self._damage(beyond("fields", "the fields of its many layouts are"), members.size)
                break
            layout = self._walk(rows[0])
            if layout is None:
                rows, members = rows[1:], members[1:]
                continue
            if tries >= _NEW_LAYOUTS:
                yield MessageGroup(layout, rows[:1], members[:1])
                rows, members = rows[1:], members[1:]
                continue
            if self._cached > _CACHED_FIELDS:
                self._layouts, self._cached = {}, 0
            known.append(layout)
            self._cached += layout.fields
            hits = layout.matches(rows)
            yield MessageGroup(layout, rows[hits], members[hits])
            rows, members = rows[~hits], members[~hits]
        del known[:-_CACHED_LAYOUTS]

    def _walk(self, message: _Bytes) -> Layout | None:
        try:
            if self._connection.encoding == PROTOBUF:
                layout = protobuf.walk(message, self._connection.type, self._types)
            else:
                layout = walk(message, self._connection.type, self._types, self._connection.encoding)
        except MalformedMessageError as error:
            self._fields += most_fields(message.size)
            self._damage(str(error), 1)
            return None
        self._fields += layout.fields
        return layout

    def _damage(self, reason: str, count: int) -> None:
        self.damaged += count
        self.reason = self.reason or reason
