"""Our reading of bytes against rosbags' deserialisation, which it must equal exactly."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype

from amhe_cli.logs.containers.raw import Connection, batch_of
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.layout import MalformedMessageError, walk
from amhe_cli.logs.messages.split import Splitter
from tests.logs.log_makers import ROS1, ROS2

FLOATS, STRINGS = ("float32", "float64"), ("string", "wstring")


def random_value(store: Any, description: Any, rng: np.random.Generator) -> Any:
    kind, detail = description
    if kind == Nodetype.NAME:
        return random_message(store, detail, rng)
    if kind == Nodetype.BASE:
        return random_number(detail[0], rng)
    element, size = detail
    count = size if kind == Nodetype.ARRAY else int(rng.integers(0, min(size or 4, 4) + 1))
    values = [random_value(store, element, rng) for _ in range(count)]
    if element[0] == Nodetype.BASE and element[1][0] not in STRINGS:
        name = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}.get(element[1][0])
        return np.array(values, dtype=name or element[1][0])
    return values


def random_number(base: str, rng: np.random.Generator) -> Any:
    if base in STRINGS:
        return "ab cde"[: rng.integers(0, 6)]
    if base in FLOATS:
        return float(np.dtype(base).type(rng.normal()))
    return bool(rng.integers(2)) if base == "bool" else int(rng.integers(0, 100))


def random_message(store: Any, name: str, rng: np.random.Generator) -> Any:
    fields = store.get_msgdef(name).fields
    return store.types[name](**{field: random_value(store, kind, rng) for field, kind in fields})


def at(message: Any, path: str) -> Any:
    for part in path.split("."):
        field, *indices = part.replace("]", "").split("[")
        message = getattr(message, field)
        for index in indices:
            message = message[int(index)]
    return message


@pytest.mark.medium
@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_every_bundled_type_is_read_as_rosbags_reads_it(encoding: str) -> None:
    store = ROS2 if encoding == "cdr" else ROS1
    rng = np.random.default_rng(1)
    checked = 0
    for name in [*store.types] * 3:
        if name == "std_msgs/msg/Header" and encoding == "ros1":
            continue
        message = random_message(store, name, rng)
        write = store.serialize_cdr if encoding == "cdr" else store.serialize_ros1
        read = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
        data = bytes(write(message, name))
        types = Definitions().of(Connection("/t", name, encoding, "", ""))
        oracle = read(data, name)
        layout = walk(np.frombuffer(data, np.uint8), name, types, encoding)
        for path, leaf in layout.leaves.items():
            found = np.frombuffer(data, leaf.dtype, 1 if leaf.count is None else leaf.count, leaf.offset)
            expected = np.atleast_1d(at(oracle, path))
            np.testing.assert_array_equal(found, expected.astype(found.dtype), err_msg=f"{name} {path}")
            checked += 1
        for path, text in layout.strings.items():
            assert text == at(oracle, path)
    assert checked > 3000


def test_big_endian_cdr() -> None:
    name = "sensor_msgs/msg/JointState"
    message = random_message(ROS2, name, np.random.default_rng(3))
    message.name, message.position = ["a", "bc"], np.array([1.5, -2.0])
    data = bytes(ROS2.serialize_cdr(message, name, little_endian=False))
    layout = walk(
        np.frombuffer(data, np.uint8), name, Definitions().of(Connection("/t", name, "cdr", "", "")), "cdr"
    )
    assert layout.names("name") == ("a", "bc")
    leaf = layout.leaves["position"]
    assert np.frombuffer(data, leaf.dtype, 2, leaf.offset).tolist() == [1.5, -2.0]


@pytest.mark.parametrize(
    "damage", [lambda d: d[:-1], lambda d: d + b"12345678", lambda d: b"\0\7" + d[2:], lambda d: d[:3]]
)
def test_malformed_messages_are_distinguished(damage: Any) -> None:
    name = "sensor_msgs/msg/Imu"
    data = damage(bytes(ROS2.serialize_cdr(random_message(ROS2, name, np.random.default_rng(0)), name)))
    types = Definitions().of(Connection("/t", name, "cdr", "", ""))
    with pytest.raises(MalformedMessageError):
        walk(np.frombuffer(data, np.uint8), name, types, "cdr")


def test_batches_of_mixed_layouts_are_sorted_and_damage_is_counted() -> None:
    name = "sensor_msgs/msg/JointState"
    rng = np.random.default_rng(5)
    payloads = [bytes(ROS2.serialize_cdr(random_message(ROS2, name, rng), name)) for _ in range(200)]
    payloads[50] = payloads[50][:-2]
    payloads[60] = b""
    connection = Connection("/t", name, "cdr", "", "")
    splitter = Splitter(connection, Definitions())
    groups = list(splitter.split(batch_of(connection, range(200), range(200), payloads)))
    members = np.sort(np.concatenate([group.members for group in groups]))
    assert members.tolist() == [i for i in range(200) if i not in (50, 60)]
    assert splitter.damaged == 2
    for group in groups:
        for row, member in zip(group.rows, group.members, strict=True):
            assert row.tobytes() == payloads[member]
            leaf = group.layout.leaves["position"]
            found = np.frombuffer(payloads[member], leaf.dtype, leaf.count or 0, leaf.offset)
            oracle = ROS2.deserialize_cdr(payloads[member], name)
            np.testing.assert_array_equal(found, oracle.position)
