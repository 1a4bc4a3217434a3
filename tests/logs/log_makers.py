"""Writers of logs for the tests."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal

T0 = 1_700_000_000_000_000_000
DT = 0.01
JOINTS = ("hip", "knee", "ankle")
ROS2 = get_typestore(Stores.LATEST)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
JS, ODOM, ARRAY = "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry", "std_msgs/msg/Float64MultiArray"

SIGNALS = (
    Signal("joints", "/joint_states", ("position", "velocity"), names=JOINTS),
    Signal("body", "/odom", ("position", "orientation", "linear_velocity", "angular_velocity")),
)
SETTINGS = LogSettings()


@dataclass(frozen=True)
class Message:
    """A message of either ROS, before it is serialised."""

    topic: str
    type: str
    stamp_ns: int
    content: Any


def make(store: Any, name: str, given: Any = (), /, **fields: Any) -> Any:
    """A message of its fields by name, or all of them in order; nested, and zero or empty where left out."""
    forms = store.fielddefs[name][1]
    given = {field: one for (field, _), one in zip(forms, given, strict=False)} | fields
    return store.types[name](**{field: _value(store, form, given.get(field)) for field, form in forms})


def _value(store: Any, form: Any, given: Any) -> Any:
    kind, detail = form
    if kind == Nodetype.NAME:
        return make(store, detail, **given) if isinstance(given, dict) else make(store, detail, given or ())
    if kind == Nodetype.BASE:
        zero = "" if detail[0] == "string" else 0.0 if detail[0].startswith("float") else 0
        return zero if given is None else type(zero)(given)
    (inner, what), size = detail
    if inner == Nodetype.NAME or what[0] == "string":
        return [_value(store, (inner, what), one) for one in given or ()]
    return np.array(np.zeros(size) if given is None else given, {"byte": "u1"}.get(what[0], what[0]))


def header(store: Any, stamp_ns: int, frame: str = "world") -> dict[str, Any]:
    return {"stamp": divmod(stamp_ns, 10**9), "frame_id": frame}


def posed(xyz: Sequence[float], wxyz: Sequence[float]) -> tuple[Any, ...]:
    """A pose, or a transform: place, and rotation x, y, z, w."""
    w, *xyzw = wxyz
    return tuple(xyz), (*xyzw, w)


def joint_state(
    store: Any,
    stamp_ns: int,
    names: Sequence[str],
    position: Sequence[float],
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
) -> Any:
    return make(store, JS, (header(store, stamp_ns), names, position, velocity, effort))


def odometry(store: Any, stamp_ns: int, p: Any, q: Any, v: Any, w: Any) -> Any:
    """v in the child frame, as ROS has it."""
    pose, twist = {"pose": posed(p, q)}, {"twist": (tuple(v), tuple(w))}
    return make(store, ODOM, (header(store, stamp_ns), "body", pose, twist))


def truth(t: np.ndarray) -> dict[str, np.ndarray]:
    """The motion in every made log: series of SIGNALS at times t [s] since T0."""
    t = np.asarray(t, dtype=float)
    zero, rate = np.zeros_like(t), 0.7
    joints = np.stack([np.sin((k + 1) * t) for k in range(3)], axis=-1)
    speeds = np.stack([(k + 1) * np.cos((k + 1) * t) for k in range(3)], axis=-1)
    return {
        "joints.position": joints,
        "joints.velocity": speeds,
        "body.position": np.stack([np.cos(t), np.sin(t), 0.1 * t], axis=-1),
        "body.orientation": np.stack([np.cos(rate * t / 2), zero, zero, np.sin(rate * t / 2)], axis=-1),
        "body.linear_velocity": np.stack([-np.sin(t), np.cos(t), 0.1 + zero], axis=-1),
        "body.angular_velocity": np.stack([zero, zero, rate + zero], axis=-1),
    }


def motion(store: Any, steps: int = 200, dt: float = DT) -> list[Message]:
    """Joint states and odometry of `truth`, both at multiples of dt."""
    t = np.arange(steps) * dt
    values = truth(t)
    messages = []
    for i in range(steps):
        stamp = T0 + round(i * dt * 1e9)
        row = {key: value[i] for key, value in values.items()}
        turn = 0.7 * t[i]
        c, s = np.cos(turn), np.sin(turn)
        vx, vy, vz = row["body.linear_velocity"]
        child = (c * vx + s * vy, -s * vx + c * vy, vz)
        joints = joint_state(store, stamp, JOINTS, row["joints.position"], row["joints.velocity"])
        body = odometry(
            store, stamp, row["body.position"], row["body.orientation"], child, row["body.angular_velocity"]
        )
        messages += [Message("/joint_states", JS, stamp, joints), Message("/odom", ODOM, stamp, body)]
    return messages


def write_mcap(
    path: Path,
    messages: Sequence[Message],
    *,
    chunk_size: int = 16_384,
    compression: CompressionType = CompressionType.ZSTD,
    definitions: bool = True,
    finish: bool = True,
    log_delay_ns: int = 0,
    **options: Any,
) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=compression, **options)
        writer.start(profile="ros2")
        writer.add_metadata("amhe", {"system": "made", "seed": "7"})
        channels: dict[tuple[str, str], int] = {}
        for message in messages:
            key = message.topic, message.type
            if key not in channels:
                text = ROS2.generate_msgdef(message.type, ros_version=2)[0] if definitions else ""
                schema = writer.register_schema(message.type, "ros2msg" if definitions else "", text.encode())
                channels[key] = writer.register_channel(message.topic, "cdr", schema)
            data = bytes(ROS2.serialize_cdr(message.content, message.type))
            log_ns = message.stamp_ns + log_delay_ns
            writer.add_message(channels[key], log_ns, data, log_ns)
        if finish:
            writer.finish()
    return path


def write_rosbag2(
    path: Path, messages: Sequence[Message], storage: str = "sqlite3", mode: str = "none"
) -> Path:
    plugin = {"sqlite3": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}[storage]
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if mode != "none":
        writer.set_compression(rosbag2.CompressionMode[mode.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.type, typestore=ROS2
                )
            data = ROS2.serialize_cdr(message.content, message.type)
            writer.write(connections[message.topic], message.stamp_ns, bytes(data))
    return path


def write_bag(
    path: Path, messages: Sequence[Message], compression: str = "", chunk_size: int = 16_384
) -> Path:
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk_size
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.type, typestore=ROS1
                )
            data = ROS1.serialize_ros1(message.content, message.type)
            writer.write(connections[message.topic], message.stamp_ns, bytes(data))
    return path


def wrong_samples(trajectory: Log, tolerance: float = 1e-9) -> dict[str, int]:
    """How many steps of each series claim a measurement that the true motion does not have."""
    t = (trajectory.start_ns - T0) / 1e9 + np.arange(trajectory.steps) * trajectory.dt
    true = truth(t)
    if (trajectory.start_ns - T0) % round(DT * 1e9):  # a damaged first stamp: every step is interpolated
        tolerance = 1e-3
    wrong = {}
    for key, series in trajectory.series.items():
        error = np.abs(series.values - true[key]).max(axis=1)
        wrong[key] = int(np.sum(error[series.sampled] > tolerance))
        interpolated = series.valid & ~series.sampled
        wrong[key] += int(np.sum(error[interpolated] > 0.15))
    return wrong


def write_ulog(path: Path, topics: Mapping[tuple[str, int], Mapping[str, NDArray]], dropout: int = 0) -> Path:
    """Write topics, (name, instance) -> field -> (n,) or (n, k); 'timestamp' [us] is one of the fields."""
    parts = [b"ULog\x01\x125\x01" + struct.pack("<Q", 1000)]

    def message(kind: bytes, body: bytes) -> None:
        parts.append(struct.pack("<H", len(body)) + kind + body)

    for (name, _), fields in {topic[0]: (topic, fields) for topic, fields in topics.items()}.values():
        text = "".join(
            f"{_type(array)}{f'[{array.shape[1]}]' if array.ndim == 2 else ''} {key};"
            for key, array in fields.items()
        )
        message(b"F", f"{name}:{text}".encode())
    for number, (name, instance) in enumerate(topics):
        message(b"A", struct.pack("<BH", instance, number) + name.encode())
    if dropout:
        message(b"O", struct.pack("<H", dropout))
    for number, fields in enumerate(topics.values()):
        for row in zip(*fields.values(), strict=True):
            values = b"".join(np.ascontiguousarray(value).tobytes() for value in row)
            message(b"D", struct.pack("<H", number) + values)
    path.write_bytes(b"".join(parts))
    return path


def _type(array: NDArray) -> str:
    return {"f4": "float", "f8": "double", "u8": "uint64_t", "i4": "int32_t"}[array.dtype.str[1:]]
