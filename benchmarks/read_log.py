"""Reading a log, against rosbags: 100 k JointState (12 joints) and 100 k Odometry in a zstd MCAP.

A JointState in protobuf is read against google.protobuf, as are 12 integers of 1 to 4 bytes. A JointState in
JSON is read against json.loads, a CSV of 36 columns against pandas, if that is installed.

    python benchmarks/read_log.py [--messages N] [--repetitions R]

Prints one table of ratios: each repetition runs both readers one after the other, so that a busy machine
slows both; the median of the ratios counts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
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


TICKS = Signal(
    "joints", "/joint_states", ("value",), fields={"value": tuple(f"ticks_{i}" for i in range(12))}
)
COLUMNS = Signal(
    "joints", "", QUANTITIES, columns={quantity: (f"{quantity}{{0..11}}",) for quantity in QUANTITIES}
)


def _reads(signal: Signal) -> Task:
    return lambda path: read_signals(path, [signal], DT, LogSettings())


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


def encoders() -> FileDescriptorSet:
    """own.Encoders: twelve sint32."""
    file = FileDescriptorProto(name="encoders.proto", package="own", syntax="proto3")
    message = file.message_type.add(name="Encoders")
    for i in range(12):
        message.field.add(name=f"ticks_{i}", number=i + 1, type=17, label=1)
    return FileDescriptorSet(file=[file])


def message_class(descriptors: FileDescriptorSet, name: str) -> Any:
    """Class of the messages of a type."""
    pool = DescriptorPool()
    for file in descriptors.file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def record(path: Path, count: int, schema: tuple[str, str, bytes], data: Callable[[int, int], bytes]) -> None:
    """A log of `count` messages on /joint_states: `data(i, stamp)` is the bytes of one."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        about = writer.register_schema(*schema)
        channel = writer.register_channel(
            "/joint_states", "json" if "json" in schema[1] else schema[1], about
        )
        for i in range(count):
            stamp = 10**18 + round(i * DT * 1e9)
            writer.add_message(channel, stamp, data(i, stamp), stamp)
        writer.finish()


def write_protobuf(path: Path, count: int) -> None:
    """A log of `count` messages of 12 joints."""
    numbers, descriptors = np.random.default_rng(0).normal(size=(64, 3, 12)), foxglove()
    make, names = message_class(descriptors, "foxglove.JointState"), [f"joint_{i}" for i in range(12)]

    def data(i: int, stamp: int) -> bytes:
        message = make(name=names, **dict(zip(QUANTITIES, numbers[i % 64], strict=True)))
        message.timestamp.FromNanoseconds(stamp)
        return message.SerializeToString()

    record(path, count, ("foxglove.JointState", "protobuf", descriptors.SerializeToString()), data)


def write_varints(path: Path, count: int) -> None:
    """A log of `count` messages of 12 integers, of 7 to 27 bits each."""
    rng, descriptors = np.random.default_rng(0), encoders()
    make = message_class(descriptors, "own.Encoders")
    ticks = (rng.normal(size=(count, 12)) * 2.0 ** rng.integers(6, 27, size=(count, 12))).astype(int).tolist()

    def data(i: int, stamp: int) -> bytes:
        return make(**{f"ticks_{k}": value for k, value in enumerate(ticks[i])}).SerializeToString()

    record(path, count, ("own.Encoders", "protobuf", descriptors.SerializeToString()), data)


def write_json(path: Path, count: int) -> None:
    """The messages of `write_protobuf` in JSON."""
    numbers, names = (
        np.random.default_rng(0).normal(size=(64, 3, 12)).tolist(),
        [f"joint_{i}" for i in range(12)],
    )

    def data(i: int, stamp: int) -> bytes:
        time = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
        arrays = dict(zip(QUANTITIES, numbers[i % 64], strict=True))
        return json.dumps({"timestamp": time, "name": names, **arrays}).encode()

    record(path, count, ("foxglove.JointState", "jsonschema", b"{}"), data)


def write_csv(path: Path, count: int) -> None:
    """A table of `count` rows: a time, and position, velocity and effort of 12 joints."""
    rows = np.column_stack([DT * np.arange(count), np.random.default_rng(0).normal(size=(count, 36))])
    names = [f"{quantity}{i}" for quantity in QUANTITIES for i in range(12)]
    np.savetxt(path, rows, delimiter=",", header=",".join(["time", *names]), comments="", fmt="%.9g")


def with_google(path: Path) -> None:
    """Parse every message and take its numbers, keep nothing."""
    with path.open("rb") as file:
        message: Any = None
        for schema, _, raw in make_reader(file).iter_messages():
            if message is None and schema is not None:
                message = message_class(FileDescriptorSet.FromString(schema.data), schema.name)
            state = message.FromString(raw.data)
            if message.DESCRIPTOR.name == "Encoders":
                [getattr(state, f"ticks_{i}") for i in range(12)]
            else:
                list(state.position), list(state.velocity), list(state.effort)
                state.timestamp.ToNanoseconds()


def with_json(path: Path) -> None:
    """Parse every message, keep nothing."""
    with path.open("rb") as file:
        for _, _, raw in make_reader(file).iter_messages():
            json.loads(raw.data)


def with_pandas(path: Path) -> None:
    """Read the table."""
    import pandas  # type: ignore[import-not-found]

    pandas.read_csv(path)


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
        "read_signals": (
            lambda path: read_signals(path, SIGNALS, DT, LogSettings()),
            with_rosbags,
            "log.mcap",
        ),
        "survey": (survey, with_rosbags, "log.mcap"),
        "protobuf": (_reads(SIGNALS[0]), with_google, "protobuf.mcap"),
        "varints": (_reads(TICKS), with_google, "varints.mcap"),
        "JSON": (_reads(SIGNALS[0]), with_json, "json.mcap"),
        "CSV": (_reads(COLUMNS), with_pandas, "table.csv"),
    }
    if find_spec("pandas") is None:
        del cases["CSV"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        write(path, options.messages)
        for write_one, file in (
            (write_protobuf, "protobuf.mcap"), (write_varints, "varints.mcap"), (write_json, "json.mcap"),
            (write_csv, "table.csv"),
        ):  # fmt: skip
            write_one(Path(folder) / file, options.messages)
        print(f"{2 * options.messages} messages, {path.stat().st_size / 1e6:.1f} MB, zstd")
        print(f"{'':16} {'ours [s]':>9} {'theirs [s]':>12} {'times faster':>13} {'lowest':>7} {'highest':>8}")
        for name, (task, reference, file) in cases.items():
            log = Path(folder) / file
            pairs = [(seconds(task, log), seconds(reference, log)) for _ in range(options.repetitions)]
            ours, theirs = np.median(pairs, axis=0)
            ratios = [b / a for a, b in pairs]
            print(
                f"{name:16} {ours:9.2f} {theirs:12.2f} {np.median(ratios):13.1f}"
                f" {min(ratios):7.1f} {max(ratios):8.1f}"
            )


if __name__ == "__main__":
    main()
