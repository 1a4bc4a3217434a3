"""Messages in JSON and Protobuf."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from google.protobuf import descriptor_pb2, timestamp_pb2
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.folder import init_system
from amhe_cli.logs import read_signals, survey
from amhe_cli.logs.containers.raw import Connection, batch_of
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.split import Splitter

DT = 0.01
T = DT * np.arange(100)
START_NS = 1_700_000_000_000_000_000
Q = np.stack((np.sin(3.0 * T), np.cos(2.0 * T)), axis=1)
TURN = np.stack((np.cos(0.5 * T), np.sin(0.5 * T)), axis=1)  # half angle about z: w, z


#: Names of the seconds and of their rest in a stamp, by encoding.
STAMPS = {"json": ("sec", "nsec"), "protobuf": ("seconds", "nanos"), "ros": ("sec", "nanosec")}


def stamp(i: int, encoding: str = "json") -> dict[str, int]:
    return dict(zip(STAMPS[encoding], divmod(START_NS + round(1e9 * T[i]), 10**9), strict=True))


def pose(i: int, height: float = 0.0) -> dict[str, Any]:
    """Height 0, and x = sin(0) at first: numbers that proto3 leaves out."""
    turn = {"x": 0.0, "y": 0.0, "z": TURN[i, 1], "w": TURN[i, 0]}
    return {"position": {"x": Q[i, 0], "y": Q[i, 1], "z": height}, "orientation": turn}


def write(path: Path, schema: str, message: Callable[[int], Any], encoding: str = "json") -> Path:
    """An MCAP whose recorder was 50 ms late: only the messages' own stamps are right."""
    proto = encoding == "protobuf"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        about = (encoding, SET.SerializeToString()) if proto else ("jsonschema", b"{}")
        channel = writer.register_channel("/data", encoding, writer.register_schema(schema, *about))
        for i in range(T.size):
            late = START_NS + round(1e9 * T[i]) + 50_000_000
            data = message(i)
            if not isinstance(data, bytes):
                plain = schema.removeprefix("foxglove.")
                data = CLASS(plain)(**data).SerializeToString() if proto else json.dumps(data).encode()
            writer.add_message(channel, late, data, late)
        writer.finish()
    return path


def read(path: Path, *quantities: str, **more: Any) -> Log:
    return read_signals(path, [Signal("s", "/data", quantities, **more)], DT, LogSettings())


def joint_states(i: int, encoding: str) -> dict[str, Any]:
    joints = [{"name": "b", "position": Q[i, 1]}, {"name": "a", "position": Q[i, 0]}]
    return {"timestamp": stamp(i, encoding), "joints": joints}


def ros_joints(i: int, encoding: str = "ros") -> dict[str, Any]:
    header = {"stamp": stamp(i, encoding), "frame_id": ""}
    return {"header": header, "name": ["b", "a"], "position": list(Q[i, ::-1]), "velocity": [], "effort": []}


def joint_state(i: int, encoding: str) -> dict[str, Any]:
    return {"timestamp": stamp(i, encoding), "name": ["b", "a"], "position": list(Q[i, ::-1])}


@pytest.mark.parametrize(
    ("schema", "message", "encoding"),
    [
        ("sensor_msgs/msg/JointState", lambda i, _: ros_joints(i), "json"),
        ("foxglove.JointStates", joint_states, "json"),
        ("foxglove.JointStates", joint_states, "protobuf"),
        ("foxglove.JointState", joint_state, "protobuf"),
    ],
)
def test_joint_states(schema: str, message: Callable[..., Any], encoding: str, tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", schema, lambda i: message(i, encoding), encoding)
    log = read(path, "position", "velocity", names=("a", "b"))
    assert (log.steps, log.start_ns) == (T.size, START_NS)
    np.testing.assert_array_equal(log["s.position"].values, Q)
    assert np.abs(log["s.velocity"].values[5:-5, 0] - 3.0 * np.cos(3.0 * T[5:-5])).max() < 0.01
    (topic,) = survey(path).topics
    assert (topic.problem, topic.header, topic.entries) == (None, "good", ("b", "a"))
    assert topic.quantities == ("position",)


def moved(i: int, encoding: str, name: str = "box", height: float = 0.0) -> dict[str, Any]:
    place = pose(i, height)
    frames = {"parent_frame_id": "world", "child_frame_id": name}
    about = {"timestamp": stamp(i, encoding)} | frames
    return about | {"translation": place["position"], "rotation": place["orientation"]}


def transforms(i: int, encoding: str) -> dict[str, Any]:
    return {"transforms": [moved(i, encoding, "other", 9.0), moved(i, encoding)]}


SECOND_POSE = {
    "position": tuple(f"poses[1].position.{part}" for part in "xyz"),
    "orientation": tuple(f"poses[1].orientation.{part}" for part in "wxyz"),
}
#: Schema -> its message, by row and encoding, and how the signal is said to be read.
POSES: Mapping[str, tuple[Callable[[int, str], Any], dict[str, Any]]] = {
    "PoseInFrame": (lambda i, encoding: {"timestamp": stamp(i, encoding), "pose": pose(i)}, {}),
    "FrameTransform": (moved, {}),
    "FrameTransforms": (transforms, {"child_frame": "box"}),
    "PosesInFrame": (
        lambda i, encoding: {
            "timestamp": stamp(i, encoding), "poses": [{} if encoding == "protobuf" else pose(0), pose(i)]
        },
        {"fields": SECOND_POSE},
    ),
}  # fmt: skip


@pytest.mark.parametrize("encoding", ["json", "protobuf"])
@pytest.mark.parametrize("name", sorted(POSES))
def test_poses(name: str, encoding: str, tmp_path: Path) -> None:
    message, more = POSES[name]
    path = write(tmp_path / "log.mcap", f"foxglove.{name}", lambda i: message(i, encoding), encoding)
    log = read(path, "position", "orientation", **more)
    assert log.start_ns == START_NS
    np.testing.assert_array_equal(log["s.position"].values, np.column_stack((Q, np.zeros(T.size))))
    np.testing.assert_allclose(log["s.orientation"].values[:, [0, 3]], TURN, atol=1e-12)


@pytest.mark.parametrize(
    "time",
    ["2023-11-14T22:13:20.000000Z", "2023-11-14T22:13:20.000000", 1_700_000_000.0, 1_700_000_000_000_000_000],
)
def test_any_schema_by_its_paths_and_any_form_of_a_time(time: Any, tmp_path: Path) -> None:
    def message(i: int) -> dict[str, Any]:
        if isinstance(time, str):
            now: Any = time.replace("20.000000", f"20.{round(1e6 * T[i]):06d}")
        else:
            now = time + T[i] if isinstance(time, float) else time + round(1e9 * T[i])
        return {"timestamp": now, "motors": [{"q": Q[i, 0], "on": True}, {"q": Q[i, 1], "on": False}]}

    path = write(tmp_path / "log.mcap", "my.Robot", message)
    fields = {"position": ("motors[0].q", "motors[1].q"), "value": ("motors[1].on",)}
    log = read(path, "position", "value", fields=fields)
    assert abs(log.start_ns - START_NS) < 1_000
    np.testing.assert_allclose(log["s.position"].values, Q, atol=1e-5)
    assert not log["s.value"].values.any()


DAMAGED = {
    "json": {
        10: b"{", 20: b"[1]", 30: b"[" * 5000, 40: b'{"a": ' * 200 + b"1" + b"}" * 200,
        50: b'{"stamp": NaN}', 60: b'{"stamp": ' + b"9" * 400 + b"}", 70: b'{"a": ' + b"9" * 400 + b"}",
    },
    "protobuf": {
        10: b"\x0a", 20: b"\x0a\xff\xff\xff\xff\x0f", 30: b"\xff" * 20, 40: b"\x0b\x08", 50: b"\x00\x01"
    },
}  # fmt: skip


@pytest.mark.parametrize("encoding", sorted(DAMAGED))
def test_damaged_messages_are_counted(
    encoding: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bad = DAMAGED[encoding]
    good = (lambda i: joint_state(i, encoding)) if encoding == "protobuf" else ros_joints
    schema = "foxglove.JointState" if encoding == "protobuf" else "sensor_msgs/msg/JointState"
    path = write(tmp_path / "log.mcap", schema, lambda i: bad.get(i) or good(i), encoding)
    log = read(path, "position", names=("a", "b"))
    assert f"{len(bad)} messages damaged and dropped" in caplog.text
    np.testing.assert_allclose(log["s.position"].values, Q, atol=1e-3)
    (topic,) = survey(path).topics
    assert (topic.quantities, topic.entries) == (("position",), ("b", "a"))


def test_null_is_a_number_that_was_not_measured(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", "own", lambda i: {"stamp": stamp(i), "q": None if i % 2 else Q[i, 0]})
    log = read(path, "value", fields={"value": ("q",)})
    assert log["s.value"].sampled.tolist() == [i % 2 == 0 for i in range(log.steps)]


KIND = descriptor_pb2.FieldDescriptorProto

#: Message -> its fields: name -> type, in order; '*' makes it a list, '?' optional.
FOXGLOVE = {
    "Vector3": {"x": "double", "y": "double", "z": "double"},
    "Quaternion": {"x": "double", "y": "double", "z": "double", "w": "double"},
    "Pose": {"position": "Vector3", "orientation": "Quaternion"},
    "PoseInFrame": {"timestamp": "Timestamp", "frame_id": "string", "pose": "Pose"},
    "FrameTransform": {
        "timestamp": "Timestamp", "parent_frame_id": "string", "child_frame_id": "string",
        "translation": "Vector3", "rotation": "Quaternion",
    },
    "FrameTransforms": {"transforms": "FrameTransform*"},
    "PosesInFrame": {"timestamp": "Timestamp", "frame_id": "string", "poses": "Pose*"},
    "JointEntry": {"name": "string", "position": "double?", "velocity": "double?", "effort": "double?"},
    "JointStates": {"timestamp": "Timestamp", "joints": "JointEntry*"},
    "JointState": {
        "timestamp": "Timestamp", "name": "string*", "position": "double*", "velocity": "double*",
        "effort": "double*",
    },
    "Motor": {"q": "float", "ticks": "sint32", "on": "bool"},
    "Robot": {"timestamp": "int64", "motors": "Motor*", "raw": "int32*", "mode": "uint32", "extra": "Motor"},
}  # fmt: skip


def described(messages: Mapping[str, Mapping[str, str]]) -> descriptor_pb2.FileDescriptorSet:
    file = descriptor_pb2.FileDescriptorProto(name="t.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for name, fields in messages.items():
        message = file.message_type.add(name=name)
        for number, (field, kind) in enumerate(fields.items(), start=1):
            plain = kind.rstrip("*?")
            added = message.field.add(name=field, number=number, label=KIND.LABEL_OPTIONAL)
            if kind.endswith("*"):
                added.label = KIND.LABEL_REPEATED
            if kind.endswith("?"):
                added.proto3_optional, added.oneof_index = True, len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field}")
            if plain[0].isupper():
                package = "google.protobuf" if plain == "Timestamp" else "foxglove"
                added.type, added.type_name = KIND.TYPE_MESSAGE, f".{package}.{plain}"
            else:
                added.type = getattr(KIND, f"TYPE_{plain.upper()}")
    times = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(times)
    return descriptor_pb2.FileDescriptorSet(file=[times, file])


def classes(descriptors: descriptor_pb2.FileDescriptorSet) -> Callable[[str], Any]:
    pool = DescriptorPool()
    for file in descriptors.file:
        pool.Add(file)
    return lambda name: GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{name}"))


SET = described(FOXGLOVE)
CLASS = classes(SET)


def test_any_type_by_its_paths(tmp_path: Path) -> None:
    def robot(i: int) -> dict[str, Any]:
        motors = [{"q": Q[i, 0], "ticks": -i, "on": True}, {"q": Q[i, 1], "ticks": i * i}]
        return {"timestamp": START_NS + round(1e9 * T[i]), "motors": motors, "raw": [i, -i], "mode": i}

    path = write(tmp_path / "log.mcap", "foxglove.Robot", robot, "protobuf")
    fields = {
        "position": ("motors[0].q", "motors[1].q"),
        "value": ("motors[0].ticks", "motors[1].ticks", "motors[0].on", "raw[1]", "mode"),
    }
    log = read(path, "position", "value", fields=fields)
    assert log.start_ns == START_NS
    np.testing.assert_array_equal(log["s.position"].values, Q.astype(np.float32))
    i = np.arange(T.size)
    np.testing.assert_array_equal(log["s.value"].values, np.stack((-i, i**2, i * 0 + 1, -i, i), axis=1))
    with pytest.raises(LogError, match=r"no number field 'motors\[2\]\.q'.*motors\[0\]\.q"):
        read(path, "position", fields={"position": ("motors[2].q",)})


NUMBERS = {
    "double": st.floats(), "float": st.floats(width=32), "bool": st.booleans(),
    **{kind: st.integers(-(2**31), 2**31 - 1) for kind in ("int32", "sint32", "sfixed32")},
    **{kind: st.integers(-(2**63), 2**63 - 1) for kind in ("int64", "sint64", "sfixed64")},
    **{kind: st.integers(0, 2**32 - 1) for kind in ("uint32", "fixed32")},
    **{kind: st.integers(0, 2**64 - 1) for kind in ("uint64", "fixed64")},
}  # fmt: skip
ANY = {
    "Part": {kind: kind for kind in NUMBERS} | {"note": "string"},
    "Whole": {
        **{f"one_{kind}": kind for kind in NUMBERS},
        **{f"many_{kind}": f"{kind}*" for kind in NUMBERS},
        "part": "Part", "parts": "Part*", "again": "Whole", "blob": "bytes", "words": "string*",
    },
}  # fmt: skip
ANY_SET = described(ANY)
WHOLE = classes(ANY_SET)("Whole")
CONNECTION = Connection("/x", "foxglove.Whole", "protobuf", ANY_SET.SerializeToString().decode("latin-1"), "")

PART = st.fixed_dictionaries({}, optional={**NUMBERS, "note": st.text(max_size=3)})
_SHALLOW = {
    **{f"one_{kind}": values for kind, values in NUMBERS.items()},
    **{f"many_{kind}": st.lists(values, max_size=3) for kind, values in NUMBERS.items()},
    "part": PART, "parts": st.lists(PART, max_size=3), "blob": st.binary(max_size=9),
    "words": st.lists(st.text(max_size=3), max_size=2),
}  # fmt: skip
MESSAGE = st.fixed_dictionaries(
    {}, optional={**_SHALLOW, "again": st.fixed_dictionaries({}, optional=_SHALLOW)}
)


def numbers(message: Any, prefix: str = "") -> dict[str, float]:
    """Path -> number, by google.protobuf; what is in no message is left out."""
    found: dict[str, float] = {}
    for field in message.DESCRIPTOR.fields:
        value, path = getattr(message, field.name), prefix + field.name
        each = {f"{path}[{i}]": v for i, v in enumerate(value)} if field.is_repeated else {path: value}
        for name, one in each.items():
            if field.type == field.TYPE_MESSAGE:
                if field.is_repeated or message.HasField(field.name):
                    found |= numbers(one, f"{name}.")
            elif field.type not in (field.TYPE_STRING, field.TYPE_BYTES):
                found[name] = float(one)
    return found


@pytest.mark.medium
@settings(max_examples=60, deadline=None)
@given(st.lists(MESSAGE, min_size=1, max_size=4))
def test_every_number_is_that_of_google_protobuf(contents: list[dict[str, Any]]) -> None:
    messages = [WHOLE(**content) for content in contents]
    batch = batch_of(CONNECTION, [0] * len(messages), [0] * len(messages),
                     [message.SerializeToString() for message in messages])  # fmt: skip
    splitter = Splitter(CONNECTION, Definitions())
    seen: set[int] = set()
    for group in splitter.split(batch):
        leaves = {
            f"{path}[{i}]" if leaf.count is not None else path: one.read(group.rows)
            for path, leaf in group.layout.leaves.items()
            for i, one in enumerate(group.layout.columns(path))
        }
        for row, member in enumerate(group.members.tolist()):
            wanted = numbers(messages[member])
            seen.add(member)
            assert {path: float(leaves[path][row]) for path in wanted} == pytest.approx(
                wanted, rel=0, abs=0, nan_ok=True
            )
            rest = [float(leaves[path][row]) for path in leaves if path not in wanted]
            assert np.isnan(rest).all()  # of messages that are not there
    assert seen == set(range(len(messages)))
    assert splitter.damaged == 0


def test_a_damaged_descriptor_set_is_named(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    for content, words in ((b"\xff" * 9, "is damaged"), (b"", "no descriptor of foxglove.JointState")):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start()
            about = writer.register_schema("foxglove.JointState", "protobuf", content)
            writer.add_message(writer.register_channel("/data", "protobuf", about), 1, b"\x01", 1)
            writer.finish()
        with pytest.raises(LogError, match=words):
            read(path, "position", names=("a", "b"))
        assert words in (survey(path).topics[0].problem or "")


MODEL = """<mujoco><worldbody>
  <body name="box"><freejoint name="box"/><geom size=".1" mass="1"/></body>
  <body pos="1 0 0"><joint name="a" axis="0 0 1"/><geom size=".1" mass="1"/>
    <body pos="0 0 .3"><joint name="b" axis="0 1 0"/><geom size=".1" mass="1"/></body></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize(
    ("name", "message", "entry"),
    [
        ("JointStates", joint_states, {"joints": ["a", "b"]}),
        ("FrameTransforms", transforms, {"body": "box", "child_frame": "box"}),
    ],
)
def test_init_guesses_from_foxglove_types(
    name: str, message: Callable[[int, str], Any], entry: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "robot.xml").write_text(MODEL)
    log = write(tmp_path / "log.mcap", f"foxglove.{name}", lambda i: message(i, "protobuf"), "protobuf")
    init_system(tmp_path / "robot.xml", [log], tmp_path / "out")
    signals = yaml.safe_load((tmp_path / "out" / "system.yaml").read_text())["signals"]
    (signal,) = signals.values()
    assert signal["type"] == f"foxglove.{name}"
    assert {key: signal[key] for key in entry} == entry
