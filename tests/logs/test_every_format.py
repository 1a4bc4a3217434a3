"""One and the same log of a pendulum in every format: the same samples, and so the same estimate."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from mcap.writer import Writer

import amhe_cli as amhe
from amhe_cli.core.log import Log, sampled
from amhe_cli.logs import read_log
from tests.logs.log_makers import (
    JS,
    ROS1,
    ROS2,
    Message,
    joint_state,
    write_bag,
    write_mcap,
    write_rosbag2,
    write_ulog,
)
from tests.logs.test_messages import CLASS, SET

EXAMPLE = Path(__file__).parents[2] / "examples" / "logs" / "pendulum.mcap"
T0 = 1_700_000_000_000_000_000
SIGNALS = {
    "joints": {
        "topic": "/joint_states",
        "type": None,
        "joints": ["hinge"],
        "noise": {"position": 0.002, "velocity": 0.05},
    },
    "command": {
        "topic": "/joint_commands",
        "type": None,
        "actuators": {"servo": "hinge"},
        "quantity": "position",
    },
}
SMALL = {
    "clips": {"count": 4, "length": [0.5, 0.6]},
    "identify": {"iterations": 2, "polish": 1, "samples": 8},
}
SYSTEM = amhe.System.load("pendulum", {"signals": SIGNALS, **SMALL})
SAMPLES = sampled(amhe.read_log(EXAMPLE, SYSTEM, end=3.0))
TIMES = {"joint_states": SAMPLES["joints.position"][0], "joint_commands": SAMPLES["command.position"][0]}
VALUES = {
    "joint_states": {q: SAMPLES[f"joints.{q}"][1] for q in ("position", "velocity")},
    "joint_commands": {"position": SAMPLES["command.position"][1]},
}
#: Columns of one table of both signals; a blank cell where one has no sample.
MERGED = {
    f"{signal}.{quantity}.hinge": np.full(TIMES["joint_states"].size, np.nan)
    for signal, quantity in (("joints", "position"), ("joints", "velocity"), ("command", "position"))
}
for name, column in MERGED.items():
    times, values = SAMPLES[name.removesuffix(".hinge")]
    column[np.rint(times / 0.01).astype(int)] = values[:, 0]
TABLE = {"time [s]": TIMES["joint_states"], **MERGED}


def messages(store: object) -> list[Message]:
    found = []
    for topic, times in TIMES.items():
        rows = VALUES[topic]
        for i, time in enumerate(times):
            stamp = T0 + round(1e9 * time)
            numbers = {quantity: values[i] for quantity, values in rows.items()}
            found.append(Message(f"/{topic}", JS, stamp, joint_state(store, stamp, ["hinge"], **numbers)))
    return sorted(found, key=lambda message: message.stamp_ns)


def recorded(path: Path, schema: tuple[str, str, bytes], encoding: str, message: Callable) -> Path:
    """An MCAP of messages of one type: `message(stamp_ns, numbers)` is the bytes of one."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        about = writer.register_schema(*schema)
        for topic, times in TIMES.items():
            channel = writer.register_channel(f"/{topic}", encoding, about)
            for i, time in enumerate(times):
                stamp = T0 + round(1e9 * time)
                data = message(stamp, {q: float(v[i, 0]) for q, v in VALUES[topic].items()})
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def as_json(stamp: int, numbers: dict[str, float]) -> bytes:
    time = {"sec": stamp // 10**9, "nsec": stamp % 10**9}
    return json.dumps({"timestamp": time, "joints": [{"name": "hinge", **numbers}]}).encode()


def as_protobuf(stamp: int, numbers: dict[str, float]) -> bytes:
    message = CLASS("JointStates")(joints=[{"name": "hinge", **numbers}])
    message.timestamp.FromNanoseconds(stamp)
    return message.SerializeToString()


def text(path: Path, delimiter: str) -> Path:
    rows = [delimiter.join("" if v != v else repr(float(v)) for v in row) for row in zip(*TABLE.values())]  # noqa: B905
    path.write_text("\n".join([delimiter.join(TABLE), *rows]) + "\n")
    return path


def hdf5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        for topic, times in TIMES.items():
            file[f"{topic}/time [s]"] = times
            for quantity, values in VALUES[topic].items():
                file[f"{topic}/{quantity}"] = values
    return path


def ulog(path: Path) -> Path:
    topics = {
        (topic, 0): {
            "timestamp": np.round(1e6 * times).astype(np.uint64),
            **{q: v[:, 0] for q, v in VALUES[topic].items()},
        }
        for topic, times in TIMES.items()
    }
    return write_ulog(path, topics)


def arrow(write: Callable, path: Path) -> Path:
    write(pa.table(TABLE), path)
    return path


def npz(path: Path) -> Path:
    np.savez(path, allow_pickle=False, **TABLE)
    return path


FORMATS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda folder: write_mcap(folder / "log.mcap", messages(ROS2)),
    "db3": lambda folder: write_rosbag2(folder / "bag", messages(ROS2)),
    "bag": lambda folder: write_bag(folder / "log.bag", messages(ROS1)),
    "json": lambda folder: recorded(
        folder / "json.mcap", ("foxglove.JointStates", "jsonschema", b"{}"), "json", as_json
    ),
    "protobuf": lambda folder: recorded(
        folder / "proto.mcap",
        ("foxglove.JointStates", "protobuf", SET.SerializeToString()), "protobuf", as_protobuf,
    ),
    "csv": lambda folder: text(folder / "log.csv", ","),
    "tsv": lambda folder: text(folder / "log.tsv", "\t"),
    "npz": lambda folder: npz(folder / "log.npz"),
    "parquet": lambda folder: arrow(pyarrow.parquet.write_table, folder / "log.parquet"),
    "hdf5": lambda folder: hdf5(folder / "log.h5"),
    "ulog": lambda folder: ulog(folder / "log.ulg"),
}  # fmt: skip


def same(log: Log, other: Log) -> None:
    assert log.steps == other.steps > 1000
    for key, one in log.series.items():
        np.testing.assert_array_equal(one.values, other[key].values, err_msg=key)
        np.testing.assert_array_equal(one.sampled, other[key].sampled, err_msg=key)
        np.testing.assert_array_equal(one.valid, other[key].valid, err_msg=key)


@pytest.fixture(scope="module")
def in_mcap(tmp_path_factory: pytest.TempPathFactory) -> Log:
    return read_log(FORMATS["mcap"](tmp_path_factory.mktemp("log")), SYSTEM)


def test_the_samples_are_the_examples(in_mcap: Log) -> None:
    for key, (times, values) in sampled(in_mcap).items():
        np.testing.assert_allclose(times, SAMPLES[key][0], atol=1e-12)
        np.testing.assert_allclose(values, SAMPLES[key][1], atol=1e-12)


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_samples(kind: str, tmp_path: Path, in_mcap: Log) -> None:
    same(read_log(FORMATS[kind](tmp_path), SYSTEM), in_mcap)


@pytest.mark.parametrize("form", ["log.csv", "log.npz", "log"])
@pytest.mark.parametrize("by", ["everything", "the system's signals"])
@pytest.mark.parametrize("kind", ["protobuf", "csv"])
def test_a_converted_log_gives_the_same_samples(kind: str, by: str, form: str, tmp_path: Path) -> None:
    path, out = FORMATS[kind](tmp_path), tmp_path / "out" / form
    amhe.convert(path, out, SYSTEM if by != "everything" else None)
    same(read_log(out, SYSTEM), read_log(path, SYSTEM))
