"""Sort the messages of a connection by their layout, so that each group can be read at once.

Messages that a library parses, JSON and protobuf, become rows of numbers, which are read like all others:
float64 side by side. Messages with the same fields, array lengths and names share a layout. Times are
brought to the names of ROS: stamp.sec and stamp.nanosec.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import count
from math import nan
from typing import Any

import numpy as np
from google.protobuf.message import Message
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.definitions import Definitions, MessageType
from amhe_cli.logs.messages.layout import (
    DEEPEST,
    KEPT,
    LONGEST_NAME,
    MOST_VALUES,
    Layout,
    Leaf,
    MalformedMessageError,
    Types,
    most_fields,
    table_layout,
    walk,
)

#: Names of the parts of a time -> those of ROS 2.
_TIMES = {"nsec": "nanosec", "nsecs": "nanosec", "nanos": "nanosec", "secs": "sec", "seconds": "sec"}
#: An object of these alone is a time.
_TIME_PARTS = {*_TIMES, "sec", "nanosec"}
#: A larger number is a time in parts of a second since 1970, so many of them in one.
_UNITS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3))
#: Fields of all remembered layouts together.
_CACHED_FIELDS = 1_000_000
#: Every number of a row.
_F8 = np.dtype("<f8")


def json_content(message: bytes) -> dict[str, Any]:
    """Parse one JSON message.

    Raises:
        MalformedMessageError: The message is not a JSON object.
    """
    try:
        content = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise MalformedMessageError(f"it is no JSON message ({error})") from None
    if not isinstance(content, dict):
        raise MalformedMessageError("it is no JSON object")
    return content


class Rows:
    """Turns messages of one connection into rows; keeps the layouts that it has seen.

    Args:
        read: Parses the bytes of one message; raises MalformedMessageError where they are none.
        fields: Fields of a message of protobuf within another.
    """

    def __init__(
        self,
        read: Callable[[bytes], dict[str, Any]],
        fields: Callable[[Message], dict[str, Any]] | None = None,
    ) -> None:
        self._read, self._fields = read, fields
        self._layouts: dict[tuple, Layout] = {}
        self._held = 0
        #: Fields of all layouts that were met, and those of messages that have more of them than bytes.
        self.fields = 0

    def row(self, message: bytes) -> tuple[Layout, FloatArray]:
        """Layout and numbers, shape (n,), of one message.

        Raises:
            MalformedMessageError: The bytes are no such message, or it is too deep or too large.
        """
        row = _Row(self._fields)
        try:
            row.mapping("", row.as_joint_state(self._read(message)), 0)
        except (ValueError, TypeError, OverflowError) as error:
            raise MalformedMessageError(str(error)) from None
        self.fields += len(row.numbers) if len(row.numbers) > len(message) else 0
        key = tuple(row.shape), tuple(row.counts.items()), tuple(row.strings.items())
        if key not in self._layouts:
            if self._held > _CACHED_FIELDS:
                self._layouts, self._held = {}, 0
            self._layouts[key] = layout = row.layout()
            self._held += layout.fields
            self.fields += layout.fields
        return self._layouts[key], np.array(row.numbers, dtype=np.float64)


class _Row:
    """What one message holds, in the order of its content.

    Attributes:
        numbers: Its numbers, those of arrays one after the other.
        shape: Path of each number, and None; of each array, and its length.
        counts: Path of an array of structures or strings -> number of its elements.
        strings: Path -> content; only names and frames.
    """

    def __init__(self, fields: Callable[[Message], dict[str, Any]] | None) -> None:
        self._fields, self._met = fields, 0
        self.numbers: list[float] = []
        self.shape: list[tuple[str, int | None]] = []
        self.counts: dict[str, int] = {}
        self.strings: dict[str, str] = {}

    def as_joint_state(self, content: dict[str, Any]) -> dict[str, Any]:
        """A list of joints (foxglove.JointStates) as a JointState, too; anything else as it is."""
        listed = content.get("joints")
        joints = [self._opened(one) for one in listed] if isinstance(listed, list) else []
        if not joints or not all(isinstance(one, dict) for one in joints):
            return content
        arrays = {key: [one.get(key) for one in joints] for key in ("name", "position", "velocity", "effort")}
        return content | {key: each for key, each in arrays.items() if any(one is not None for one in each)}

    def _opened(self, value: Any) -> Any:
        return self._fields(value) if self._fields and isinstance(value, Message) else value

    def mapping(self, prefix: str, content: dict[str, Any], depth: int) -> None:
        """Note all values of an object."""
        self._met += len(content)
        if depth > DEEPEST or max(self._met, len(self.numbers)) > MOST_VALUES:
            raise MalformedMessageError("it nests too deep, or holds too many numbers")
        names = _TIMES if _TIME_PARTS.issuperset(content) else {"timestamp": "stamp"}
        for key, value in content.items():
            self._value(prefix + names.get(key, key), value, depth + 1)

    def _value(self, path: str, value: Any, depth: int) -> None:
        if isinstance(value := self._opened(value), dict):
            self.mapping(f"{path}.", value, depth)
        elif isinstance(value, list):
            self._list(path, value, depth)
        elif isinstance(value, str):
            self._text(path, value)
        elif path.split(".")[-1] != "stamp":
            self._number(path, nan if value is None else float(value))
        elif value is not None:
            self._time(path, value)

    def _list(self, path: str, values: list[Any], depth: int) -> None:
        if all(value is None or isinstance(value, (int, float)) for value in values):
            self.shape.append((path, len(values)))
            self.numbers += [nan if value is None else float(value) for value in values]
            return
        self.counts[path] = len(values)
        for i, value in enumerate(values):
            self._value(f"{path}[{i}]", value, depth + 1)

    def _number(self, path: str, value: float) -> None:
        self.shape.append((path, None))
        self.numbers.append(value)

    def _text(self, path: str, text: str) -> None:
        """Note a name, or a time that is written out."""
        last = path.split(".")[-1].split("[")[0]
        if last in KEPT:
            self.strings[path] = text
        if last not in ("stamp", "time"):
            return
        try:
            moment = datetime.fromisoformat(text)
            moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        except ValueError:
            return
        self._number(f"{path}.sec", int(moment.timestamp()))
        self._number(f"{path}.nanosec", 1000 * moment.microsecond)

    def _time(self, path: str, value: float) -> None:
        """Note a time that is one number: s, or by its size ms, us or ns since 1970."""
        unit = next((unit for least, unit in _UNITS if abs(value) > least), 1)
        seconds, rest = divmod(value, unit)
        self._number(f"{path}.sec", float(int(seconds)))
        self._number(f"{path}.nanosec", round(rest * (10**9 // unit)))

    def layout(self) -> Layout:
        """Where each number lies in the row.

        Raises:
            MalformedMessageError: A name is too long.
        """
        for path, name in self.strings.items():
            if len(name) > LONGEST_NAME:
                raise MalformedMessageError(f"{path} has {len(name)} characters")
        leaves, offset = {}, 0
        for path, size in self.shape:
            leaves[path] = Leaf(offset, _F8, size)
            offset += 8 * (1 if size is None else size)
        nothing = np.empty(0, dtype=np.int64)
        fields = len(leaves) + 1
        return Layout(leaves, self.counts, self.strings, nothing, nothing.astype(np.uint8), fields)


_Bytes = NDArray[np.uint8]
#: Layouts remembered for each message length, the latest ones.
_CACHED_LAYOUTS = 64
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
            self._rows = Rows(types.content, types.fields)
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
