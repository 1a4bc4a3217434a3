"""Protobuf messages by google.protobuf and the descriptors that the log carries.

The descriptors are data: no code is generated from them. A number that a message leaves out is 0, as proto3
has it; one in a message that is left out itself, or one whose presence is told, is unknown, thus NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from graphlib import TopologicalSorter
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.messages.layout import KEPT, Constant, Layout, Leaf, MalformedMessageError
from amhe_cli.logs.messages.rows import DEEPEST, TIMES, Row

#: MCAP's name of the encoding.
ENCODING = "protobuf"
#: A longer list is an image or a cloud of points, and not read.
_LONGEST = 10_000
#: Fields that a message may leave out, those of messages that it leaves out among them.
_MOST_ABSENT = 20_000
#: A message of these alone is a time.
_TIME_PARTS = {*TIMES, "sec", "nanosec"}
#: Names of the field that holds a message's stamp.
_STAMPS = ("stamp", "timestamp")
#: Every number of a row.
_F8 = np.dtype("<f8")


@dataclass(frozen=True, slots=True)
class _Field:
    """One field of a message type.

    Args:
        name: Name of the field; those of times are ROS 2's.
        kind: 'number', 'name', 'text', 'message', or 'other', which is not read: bytes and maps.
        repeated: Whether it is a list.
        absent: Value of the field where a message lacks it; NaN where that means that it is unknown.
        message: Type of the message that it holds, None for anything else.
    """

    name: str
    kind: str
    repeated: bool
    absent: float
    message: Descriptor | None


class MessageType:
    """One type of a descriptor set; reads its messages.

    Args:
        descriptor_set: Bytes of a FileDescriptorSet.
        name: Full name of the type.

    Raises:
        MalformedMessageError: The bytes are not such a set.
        KeyError: It has no such type.
    """

    def __init__(self, descriptor_set: bytes, name: str) -> None:
        try:
            pool = _pool(descriptor_set)
        except (TypeError, ValueError, DecodeError) as error:
            raise MalformedMessageError(f"{error}".split("\n")[0][:200]) from None
        self._root: Descriptor = pool.FindMessageTypeByName(name)
        self._make = GetMessageClass(self._root)
        self._fields: dict[str, Mapping[int, _Field]] = {}
        self._growth = self._largest_growth()

    def read(self, data: bytes) -> Row:
        """Parse one message.

        Raises:
            MalformedMessageError: The bytes are none, or would take too much room.
        """
        if len(data) * self._growth > limits().piece:
            raise MalformedMessageError(beyond("piece_mib", f"what its {len(data)} bytes may unfold to is"))
        try:
            message = self._make.FromString(data)
        except (DecodeError, RecursionError) as error:
            raise MalformedMessageError(str(error)) from None
        row = _MessageRow(self)
        row.message("", self._root, message, 0)
        return row

    def fields(self, descriptor: Descriptor) -> Mapping[int, _Field]:
        """The fields of a type, by their numbers."""
        name = descriptor.full_name
        if name not in self._fields:
            fields = {field.number: _field(field) for field in descriptor.fields}
            if fields and all(field.name in _TIME_PARTS for field in fields.values()):
                # A time that is absent is a stamp that was not set.
                fields = {
                    number: _Field(TIMES.get(f.name, f.name), f.kind, f.repeated, 0.0, f.message)
                    for number, f in fields.items()
                }
            self._fields[name] = fields
        return self._fields[name]

    def _largest_growth(self) -> float:
        """Bytes that one byte of a message can become: google's parser makes room for all fields of a type.

        A list takes two bytes for each empty message in it.
        """
        growth, met, left = 1.0, set[tuple[str, bool]](), [(self._root, False)]
        while left:
            descriptor, listed = left.pop()
            if (descriptor.full_name, listed) in met:
                continue
            met.add((descriptor.full_name, listed))
            if listed:
                growth = max(growth, 20.0 + 8.0 * len(descriptor.fields))
            for field in descriptor.fields:
                if (within := field.message_type) is not None:
                    left.append((within, listed or field.is_repeated))
                elif field.is_repeated:
                    growth = max(growth, 16.0)
        return growth


class _MessageRow(Row):
    """A row of a protobuf message: its layout knows the numbers that it leaves out."""

    def __init__(self, types: MessageType) -> None:
        super().__init__()
        self._types = types
        #: Path of each message that is there, with a dot behind it -> its type.
        self._present: dict[str, Descriptor] = {}

    def message(self, prefix: str, descriptor: Descriptor, message: Any, depth: int) -> None:
        """Note the fields of a message."""
        self.check(depth)
        if len(self._present) > _MOST_ABSENT:
            raise MalformedMessageError("it holds too many messages")
        self._present[prefix] = descriptor
        fields = self._types.fields(descriptor)
        for described, value in message.ListFields():
            if (field := fields.get(described.number)) is None:
                continue  # an extension
            path = prefix + field.name
            if field.kind == "number":
                self._numbers(prefix, field, value)
            elif field.kind == "message" and field.message is not None:
                if not field.repeated:
                    self.message(_within(prefix, field), field.message, value, depth + 1)
                    continue
                self.counts[path] = len(value)
                for i, element in enumerate(value):
                    self.message(f"{path}[{i}].", field.message, element, depth + 1)
            elif field.kind in ("name", "text"):
                self._texts(path, field, value)

    def key(self) -> tuple:
        """See `Row`."""
        return *super().key(), tuple(self._present)

    def finished(self, leaves: dict[str, Leaf]) -> Layout:
        """See `Row`; with the fields that are absent."""
        self._left = _MOST_ABSENT
        for prefix, descriptor in self._present.items():
            for field in self._types.fields(descriptor).values():
                self._absent(leaves, prefix, field, field.absent, (descriptor.full_name,))
        return super().finished(leaves)

    def _numbers(self, prefix: str, field: _Field, value: Any) -> None:
        path = prefix + field.name
        if not field.repeated:
            self.number(path, value)
            if field.name in _STAMPS:
                self.time(f"{prefix}stamp", value if abs(value) < 2**62 else 0)
        elif len(value) > _LONGEST:
            self.counts[path] = len(value)
        else:
            self.array(path, value)

    def _texts(self, path: str, field: _Field, value: Any) -> None:
        if not field.repeated:
            if field.kind == "name":
                self.strings[path] = value
        elif field.kind == "text":
            self.counts[path] = len(value)
        elif len(value) > _LONGEST:
            raise MalformedMessageError(f"it holds {len(value)} names")
        else:
            self.names[path] = tuple(value)

    def _absent(
        self, leaves: dict[str, Leaf], prefix: str, field: _Field, value: float, within: tuple[str, ...]
    ) -> None:
        """Note a field that the message leaves out, and all that it would hold."""
        self._left -= 1
        if self._left < 0:
            raise MalformedMessageError("its type has too many fields")
        path = prefix + field.name
        if path in leaves or path in self.counts or path in self.strings:
            return
        if field.repeated:
            if field.kind == "number":
                leaves[path] = Leaf(0, _F8, 0)
            else:
                self.counts[path] = 0
        elif field.kind == "number":
            leaves[path] = Constant(0, _F8, None, value)
            if field.name in _STAMPS:
                for part in ("sec", "nanosec"):
                    leaves.setdefault(f"{prefix}stamp.{part}", Constant(0, _F8, None, 0.0))
        elif field.kind == "name":
            self.strings[path] = ""
        elif field.message is not None and (inner := _within(prefix, field)) not in self._present:
            name = field.message.full_name
            if name not in within and len(within) < DEEPEST:
                for part in self._types.fields(field.message).values():
                    unset = 0.0 if part.name in ("sec", "nanosec") else float("nan")
                    self._absent(leaves, inner, part, unset, (*within, name))


def _within(prefix: str, field: _Field) -> str:
    """Prefix of the paths in a message that a field holds."""
    return f"{prefix}{'stamp' if field.name == 'timestamp' else field.name}."


def _field(field: FieldDescriptor) -> _Field:
    message = field.message_type
    if message is not None:
        kind = "other" if message.GetOptions().map_entry else "message"
    elif field.type == FieldDescriptor.TYPE_BYTES:
        kind = "other"
    else:
        text = "name" if field.name in KEPT else "text"
        kind = text if field.type == FieldDescriptor.TYPE_STRING else "number"
    absent = float("nan") if field.has_presence and not field.has_default_value else 0.0
    if kind == "number" and field.has_default_value:
        absent = float(field.default_value)
    return _Field(field.name, kind, field.is_repeated, absent, message)


@lru_cache(maxsize=8)
def _pool(descriptor_set: bytes) -> DescriptorPool:
    """A pool of all files of a set, whatever their order."""
    files = {file.name: file for file in FileDescriptorSet.FromString(descriptor_set).file}
    needs = {name: [other for other in file.dependency if other in files] for name, file in files.items()}
    pool = DescriptorPool()
    for name in TopologicalSorter(needs).static_order():  # a circle is a ValueError
        pool.AddSerializedFile(files[name].SerializeToString())
    return pool
