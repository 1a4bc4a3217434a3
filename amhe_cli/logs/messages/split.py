"""Sort the messages of a connection by their layout, so that each group can be read at once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import (
    Layout,
    MalformedMessageError,
    Types,
    most_fields,
    table_layout,
    walk,
)
from amhe_cli.logs.messages.protobuf import MessageType
from amhe_cli.logs.messages.rows import Rows, json_content

_Bytes = NDArray[np.uint8]
#: Layouts remembered for each message length, the latest ones.
_CACHED_LAYOUTS = 64
#: Fields of all remembered layouts together.
_CACHED_FIELDS = 1_000_000
#: Layouts that the messages of one batch and length are matched with; further ones stand for one message.
_NEW_LAYOUTS = 64
#: Said of a topic whose messages differ in layout beyond the limit `fields`.
_MANY = "the fields of its many layouts are"


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
        types = definitions.of(connection)
        self._rows: Rows | None = None
        self._types: Types = {}
        if isinstance(types, MessageType):
            self._rows = Rows(types.content)
        elif connection.encoding == "json":
            self._rows = Rows(json_content)
        else:
            self._types = types
        self._layouts: dict[int, list[Layout]] = {}
        if connection.encoding == TABLE:
            layout, size = table_layout(connection.definition)
            self._layouts[size] = [layout]
        self._fields = self._cached = 0
        self.damaged = 0
        self.reason = ""

    def split(self, batch: Batch) -> Iterator[MessageGroup]:
        """Yield groups that together hold every intact message of the batch."""
        if self._rows is not None:
            yield from self._parsed(self._rows, batch)
            return
        for length in np.unique(batch.lengths).tolist():
            members = np.flatnonzero(batch.lengths == length)
            if length == 0:
                self._damage("it is empty", members.size)
                continue
            windows = np.lib.stride_tricks.sliding_window_view(batch.buffer, length)
            yield from self._same_length(windows[batch.starts[members]], members)

    def _parsed(self, rows: Rows, batch: Batch) -> Iterator[MessageGroup]:
        """Messages that must be parsed one by one."""
        found: dict[int, tuple[Layout, list[int], list[FloatArray]]] = {}
        for i, message in enumerate(batch.payloads()):
            if rows.fields > limits().fields:
                self._damage(beyond("fields", _MANY), batch.starts.size - i)
                break
            try:
                layout, numbers = rows.row(message)
            except MalformedMessageError as error:
                self._damage(str(error), 1)
                continue
            _, members, values = found.setdefault(id(layout), (layout, [], []))
            members.append(i)
            values.append(numbers)
        for layout, members, values in found.values():
            yield MessageGroup(layout, np.stack(values).view(np.uint8), np.array(members, dtype=np.int64))

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
            if self._fields > limits().fields:
                self._damage(beyond("fields", _MANY), members.size)
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
