"""Protobuf messages by google.protobuf and the descriptors that the log carries.

The descriptors are data: no code is generated from them. A number that a message leaves out is 0, as proto3
has it; one in a message that is left out itself, or one whose presence is told, is unknown.
"""

from __future__ import annotations

from functools import lru_cache
from graphlib import TopologicalSorter
from typing import Any, NamedTuple

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass

from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.messages.layout import MalformedMessageError
from amhe_cli.logs.messages.rows import DEEPEST, MOST_VALUES

#: MCAP's name of the encoding.
ENCODING = "protobuf"
#: A longer list is an image or a cloud of points, and not read.
_LONGEST = 10_000


class _Field(NamedTuple):
    """One field of a message type that is read.

    Args:
        name: Its name.
        nested: Whether it holds messages.
        repeated: Whether it is a list.
        always: Whether it has a value where a message leaves it out.
    """

    name: str
    nested: bool
    repeated: bool
    always: bool


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
        root: Descriptor = pool.FindMessageTypeByName(name)
        self._make = GetMessageClass(root)
        self._fields: dict[str, list[_Field]] = {}
        self._growth = _largest_growth(root)
        self._left = 0

    def content(self, data: bytes) -> dict[str, Any]:
        """Parse one message: its fields, nested, without those that are not known.

        Raises:
            MalformedMessageError: The bytes are none, or would take too much room.
        """
        if len(data) * self._growth > limits().piece:
            raise MalformedMessageError(beyond("piece_mib", f"what its {len(data)} bytes may unfold to is"))
        try:
            message = self._make.FromString(data)
        except (DecodeError, RecursionError) as error:
            raise MalformedMessageError(str(error)) from None
        self._left = MOST_VALUES
        return self._content(message, 0)

    def _content(self, message: Any, depth: int) -> dict[str, Any]:
        fields = self._fields_of(message.DESCRIPTOR)
        self._left -= len(fields)
        if self._left < 0 or depth > DEEPEST:
            raise MalformedMessageError("it nests too deep, or holds too many numbers")
        found: dict[str, Any] = {}
        for name, nested, repeated, always in fields:
            if not (repeated or always or message.HasField(name)):
                continue
            value = getattr(message, name)
            if repeated and len(value) > _LONGEST:
                continue
            if nested:
                several = [self._content(one, depth + 1) for one in (value if repeated else [value])]
                found[name] = several if repeated else several[0]
            else:
                found[name] = list(value) if repeated else value
        return found

    def _fields_of(self, descriptor: Descriptor) -> list[_Field]:
        """The fields of a type that are read, all but bytes and maps, in the order of their numbers."""
        name = descriptor.full_name
        if name not in self._fields:
            self._fields[name] = [
                _Field(
                    field.name,
                    field.message_type is not None,
                    field.is_repeated,
                    not field.has_presence or field.has_default_value,
                )
                for field in sorted(descriptor.fields, key=lambda field: field.number)
                if field.type != FieldDescriptor.TYPE_BYTES
                and not (field.message_type and field.message_type.GetOptions().map_entry)
            ]
        return self._fields[name]


def _largest_growth(root: Descriptor) -> float:
    """Bytes that one byte of a message can become: google's parser makes room for all fields of a type.

    A list takes two bytes for each empty message in it.
    """
    growth, met, left = 1.0, set[tuple[str, bool]](), [(root, False)]
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


@lru_cache(maxsize=8)
def _pool(descriptor_set: bytes) -> DescriptorPool:
    """A pool of all files of a set, whatever their order."""
    files = {file.name: file for file in FileDescriptorSet.FromString(descriptor_set).file}
    needs = {name: [other for other in file.dependency if other in files] for name, file in files.items()}
    pool = DescriptorPool()
    for name in TopologicalSorter(needs).static_order():  # a circle is a ValueError
        pool.AddSerializedFile(files[name].SerializeToString())
    return pool
