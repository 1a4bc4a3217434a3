"""Message definitions: from the log, from a folder of .msg files, those that come with rosbags, or Unitree's.

Only definitions are parsed. No code is generated from them, so a log cannot execute anything. Protobuf's
are its descriptors, by which google.protobuf parses messages: a number that a message leaves out is 0, as
proto3 has it; one in a message that is left out itself, or one whose presence is told, is unknown.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Mapping
from dataclasses import replace
from functools import cache, lru_cache
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.limits import beyond, limits
from amhe_cli.logs.containers.raw import Connection, normal_type
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.layout import MalformedMessageError, Types

#: MCAP's name of the encoding.
PROTOBUF = "protobuf"
#: A longer list is an image or a cloud of points, and not read.
_LONGEST = 10_000


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
        self._fields: dict[str, list[tuple[str, bool, bool]]] = {}
        self._growth = _largest_growth(root)

    def content(self, data: bytes) -> dict[str, Any]:
        """Parse one message; see `fields`.

        Raises:
            MalformedMessageError: The bytes are none, or would take too much room.
        """
        if len(data) * self._growth > limits().piece:
            raise MalformedMessageError(beyond("piece_mib", f"what its {len(data)} bytes may unfold to is"))
        try:
            return self.fields(self._make.FromString(data))
        except (DecodeError, RecursionError) as error:
            raise MalformedMessageError(str(error)) from None

    def fields(self, message: Message) -> dict[str, Any]:
        """Known fields of a message: numbers, texts, messages, lists of them; no bytes, maps or images."""
        kind = message.DESCRIPTOR.full_name
        if kind not in self._fields:
            self._fields[kind] = [
                (field.name, field.is_repeated, not field.has_presence or field.has_default_value)
                for field in sorted(message.DESCRIPTOR.fields, key=lambda field: field.number)
                if field.type != FieldDescriptor.TYPE_BYTES
                and not (field.message_type and field.message_type.GetOptions().map_entry)
            ]
        found: dict[str, Any] = {}
        for name, repeated, always in self._fields[kind]:
            if not repeated and (always or message.HasField(name)):
                found[name] = getattr(message, name)
            elif repeated and len(values := getattr(message, name)) <= _LONGEST:
                found[name] = list(values)
        return found


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


class Definitions:
    """Definitions of message types; those in the log take precedence.

    Args:
        msg_path: Folder of .msg files for types that the log does not define.

    Raises:
        ConfigError: If the folder is missing, holds no .msg file, or one of them does not parse.
    """

    def __init__(self, msg_path: Path | None = None) -> None:
        self._folder = _read_folder(msg_path) if msg_path else {}
        self._cache: dict[Connection, Types | MessageType] = {}

    def of(self, connection: Connection) -> Types | MessageType:
        """All types that decoding `connection` may need; of protobuf, the type of its messages.

        Raises:
            LogError: If the connection is in a foreign encoding, or its type is not defined anywhere.
        """
        if connection not in self._cache:
            self._cache[connection] = self._lookup(connection)
        return self._cache[connection]

    @property
    def types(self) -> Types:
        """All types of ROS 2 that are known without a log."""
        return ChainMap(self._folder, _bundled("cdr"))

    def described(self, name: str) -> tuple[str, str]:
        """Text of a type's definition, with all that it consists of, and its hash.

        Raises:
            LogError: The type, or a part of it, is not defined.
        """
        store = get_typestore(Stores.EMPTY)  # only looked up: registering would generate and run code
        store.fielddefs.update({each: ([], fields) for each, fields in self.types.items()})
        try:
            return store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name)
        except Exception as error:  # rosbags raises many kinds
            raise LogError(
                f"{name} is not defined here ({error}); give the folder of its .msg files with `msg_path`"
            ) from None

    def problem(self, connection: Connection) -> str | None:
        """Why `connection` cannot be decoded, in words; None if it can."""
        try:
            self.of(connection)
        except LogError as error:
            return str(error)
        return None

    def _lookup(self, connection: Connection) -> Types | MessageType:
        topic = f"topic {connection.topic!r}"
        if len(connection.definition) > limits().definition:
            raise LogError(f"{topic}: {beyond('definition_mib', f'the definition of {connection.type} is')}")
        if connection.encoding in (TABLE, "json"):
            return {}
        if connection.encoding == PROTOBUF:
            return _descriptors(connection, topic)
        if connection.encoding not in ("cdr", "ros1"):
            raise LogError(
                f"{topic} is encoded as {connection.encoding!r}; "
                "cdr and ros1 (ROS), json and protobuf are read: let the recorder write one of these"
            )
        try:
            own = _parse(replace(connection, topic=""))
        except Exception as error:  # rosbags' parser raises many kinds on malformed text
            if connection.type not in _bundled(connection.encoding) and connection.type not in self._folder:
                raise LogError(
                    f"{topic}: the definition of {connection.type} in the log is damaged"
                ) from error
            own = {}
        types = ChainMap(own, self._folder, _bundled(connection.encoding))
        if connection.type not in types:
            raise LogError(
                f"{topic}: the log has no definition of {connection.type}; "
                f"give the folder that holds {connection.type.split('/')[-1]}.msg with `msg_path`"
            )
        return types


def _descriptors(connection: Connection, topic: str) -> MessageType:
    """The type of a protobuf connection, by the descriptor set in the log."""
    try:
        return MessageType(connection.definition.encode("latin-1"), connection.type)
    except KeyError:
        raise LogError(
            f"{topic}: the log has no descriptor of {connection.type}, so it cannot be read"
        ) from None
    except (MalformedMessageError, UnicodeEncodeError) as error:
        raise LogError(f"{topic}: the descriptor set of {connection.type} is damaged ({error})") from None


@lru_cache(maxsize=256)
def _parse(connection: Connection) -> dict[str, Any]:
    """The log's own definition; nothing where it has none or a damaged one.

    Raises:
        Exception: The text does not parse; the kind of error varies.
    """
    if not connection.definition.strip():
        return {}
    types = _parsed_text(connection)
    if connection.digest and _digest(connection, types) != connection.digest:
        raise ValueError("its hash is wrong")
    return _fields(types)


def _digest(connection: Connection, types: Mapping[str, Any]) -> str:
    """The hash that the recorder should have written for the definition."""
    store = get_typestore(Stores.EMPTY)
    store.fielddefs.update(types)  # only looked up: registering would generate and run code
    if connection.encoding == "ros1":
        return store.generate_msgdef(connection.type)[1] if connection.digest != "*" else "*"
    return store.hash_rihs01(connection.type)


def _parsed_text(connection: Connection) -> dict[str, Any]:
    if connection.definition_format != "ros2idl":
        return dict(get_types_from_msg(connection.definition, connection.type))
    separator = "=" * 80 + "\n"
    types: dict[str, Any] = {}
    for part in connection.definition.split(separator):
        text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if text.strip():
            types |= get_types_from_idl(text)
    return types


def _fields(types: Mapping[str, Any]) -> dict[str, Any]:
    return {name: fields for name, (_, fields) in types.items()}


@cache
def _bundled(encoding: str) -> dict[str, Any]:
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST)
    types: dict[str, Any] = {name: entry[1] for name, entry in store.fielddefs.items()}
    tf = "tf2_msgs/msg/TFMessage"
    if tf not in types:  # ROS 1's store has only the parts of it
        types |= _fields(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf))
    go2 = Path(__file__).with_name("unitree_go.msg").read_text(encoding="utf-8")
    return types | _fields(get_types_from_msg(go2, "unitree_go/msg/LowState"))


def _read_folder(folder: Path) -> dict[str, Any]:
    files = sorted(folder.rglob("*.msg"))
    if not files:
        raise ConfigError(f"`msg_path` {folder}: no such folder, or no .msg file in it")
    types: dict[str, Any] = {}
    for file in files:
        parents = [part for part in file.relative_to(folder.parent).parts[:-1] if part != "msg"]
        package = parents[-1] if parents else folder.resolve().name
        name = normal_type(f"{package}/{file.stem}")
        try:
            types.update(_fields(get_types_from_msg(file.read_text(encoding="utf-8"), name)))
        except Exception as error:  # rosbags' parser raises many kinds on malformed text
            raise ConfigError(f"`msg_path`: {file} is not a message definition: {error}") from error
    return types
