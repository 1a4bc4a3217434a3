"""Reading a log, against rosbags: 100 k JointState (12 joints) and 100 k Odometry in a zstd MCAP.

A JointState in protobuf is read against google.protobuf.

    python benchmarks/read_log.py [--messages N] [--repetitions R]

Prints one table of ratios: each repetition runs both readers one after the other, so that a busy machine
slows both; the median of the ratios counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from google.protobuf import timestamp_pb2
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter, read_signals, survey

DT = 0.002
QUANTITIES = ("position", "velocity", "effort")
Task: TypeAlias = Callable[[Path], object]
SIGNALS = (
    Signal("joints", "/joint_states", QUANTITIES),
    Signal("base", "/odom", ("position", "orientation", "linear_velocity", "angular_velocity")),
)


def write(path: Path, count: int) -> None:
    """A log of `count` messages on each of two topics."""
    rng = np.random.default_rng(0)
    names = [f"joint_{i}" for i in range(12)]
    joints = rng.normal(size=(64, 3, 12))
    with LogWriter(path, {}) as log:
        for i in range(count):
            stamp = 10**18 + round(i * DT * 1e9)
            turn = i * DT
            log.joint_state("/joint_states", stamp, names, *joints[i % 64])
            quaternion = (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
            position, velocity = joints[i % 64, 0, :3], joints[i % 64, 1, :3]
            log.odometry("/odom", stamp, position, quaternion, velocity)


def with_rosbags(path: Path) -> None:
    """Deserialise every message, keep nothing: less work than a trajectory."""
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            reader.deserialize(raw, connection.msgtype)


def foxglove() -> FileDescriptorSet:
    """foxglove.JointState."""
    file = FileDescriptorProto(name="joints.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name="JointState")
    text, message_type, numbers = 9, 11, 1
    fields = {"timestamp": message_type, "name": text} | dict.fromkeys(QUANTITIES, numbers)
    for number, (name, kind) in enumerate(fields.items(), start=1):
        added = message.field.add(name=name, number=number, type=kind, label=1 if number == 1 else 3)
        if number == 1:
            added.type_name = ".google.protobuf.Timestamp"
    stamp = FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    return FileDescriptorSet(file=[stamp, file])


def joint_state(descriptors: FileDescriptorSet) -> Any:
    """Class of its messages."""
    pool = DescriptorPool()
    for file in descriptors.file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("foxglove.JointState"))


def write_protobuf(path: Path, count: int) -> None:
    """A log of `count` messages of 12 joints."""
    numbers, descriptors = np.random.default_rng(0).normal(size=(64, 3, 12)), foxglove()
    make, names = joint_state(descriptors), [f"joint_{i}" for i in range(12)]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.JointState", "protobuf", descriptors.SerializeToString())
        channel = writer.register_channel("/joint_states", "protobuf", schema)
        for i in range(count):
            stamp = 10**18 + round(i * DT * 1e9)
            message = make(name=names, **dict(zip(QUANTITIES, numbers[i % 64], strict=True)))
            message.timestamp.FromNanoseconds(stamp)
            writer.add_message(channel, stamp, message.SerializeToString(), stamp)
        writer.finish()


def with_google(path: Path) -> None:
    """Parse every message and take its numbers, keep nothing."""
    with path.open("rb") as file:
        reader = make_reader(file)
        message: Any = None
        for schema, _, raw in reader.iter_messages():
            if message is None and schema is not None:
                message = joint_state(FileDescriptorSet.FromString(schema.data))
            state = message.FromString(raw.data)
            list(state.position), list(state.velocity), list(state.effort), state.timestamp.ToNanoseconds()


def seconds(work: Callable[[Path], object], path: Path) -> float:
    start = time.perf_counter()
    work(path)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--messages", type=int, default=100_000, help="messages on each topic")
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    cases: dict[str, tuple[Task, Task, str]] = {
        "read_signals": (lambda path: read_signals(path, SIGNALS, DT, LogSettings()), with_rosbags, "log"),
        "survey": (survey, with_rosbags, "log"),
        "protobuf": (
            lambda path: read_signals(path, SIGNALS[:1], DT, LogSettings()), with_google, "protobuf"
        ),
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        write(path, options.messages)
        write_protobuf(Path(folder) / "protobuf.mcap", options.messages)
        print(f"{2 * options.messages} messages, {path.stat().st_size / 1e6:.1f} MB, zstd")
        print(f"{'':16} {'ours [s]':>9} {'theirs [s]':>12} {'times faster':>13} {'lowest':>7} {'highest':>8}")
        for name, (task, reference, stem) in cases.items():
            log = Path(folder) / f"{stem}.mcap"
            pairs = [(seconds(task, log), seconds(reference, log)) for _ in range(options.repetitions)]
            ours, theirs = np.median(pairs, axis=0)
            ratios = [b / a for a, b in pairs]
            print(
                f"{name:16} {ours:9.2f} {theirs:12.2f} {np.median(ratios):13.1f}"
                f" {min(ratios):7.1f} {max(ratios):8.1f}"
            )


if __name__ == "__main__":
    main()
