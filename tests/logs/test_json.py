"""JSON messages in an MCAP file, by the schemas of ROS and of Foxglove, read as their ROS twins are."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs import read_signals, survey

DT = 0.01
T = DT * np.arange(100)
START_NS = 1_700_000_000_000_000_000
Q = np.stack((np.sin(3.0 * T), np.cos(2.0 * T)), axis=1)
TURN = np.stack((np.cos(0.5 * T), np.sin(0.5 * T)), axis=1)  # half angle about z: w, z


def stamp(i: int) -> dict[str, int]:
    sec, nsec = divmod(START_NS + round(1e9 * T[i]), 10**9)
    return {"sec": sec, "nsec": nsec}


def pose(i: int) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": TURN[i, 1], "w": TURN[i, 0]}
    return {"position": {"x": Q[i, 0], "y": Q[i, 1], "z": 0.5}, "orientation": turn}


def write(path: Path, schema: str, message: Callable[[int], Any], topic: str = "/data") -> Path:
    """A JSON MCAP whose recorder was 50 ms late: only the messages' own stamps are right."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        about = writer.register_schema(schema, "jsonschema", b"{}")
        channel = writer.register_channel(topic, "json", about)
        for i in range(T.size):
            late = START_NS + round(1e9 * T[i]) + 50_000_000
            content = message(i)
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            writer.add_message(channel, late, data, late)
        writer.finish()
    return path


def read(path: Path, *quantities: str, **more: Any) -> Log:
    return read_signals(path, [Signal("s", "/data", quantities, **more)], DT, LogSettings())


JOINTS: Mapping[str, tuple[str, Callable[[int], Any]]] = {
    "ros": (
        "sensor_msgs/msg/JointState",
        lambda i: {
            "header": {"stamp": {"sec": stamp(i)["sec"], "nanosec": stamp(i)["nsec"]}, "frame_id": ""},
            "name": ["a", "b"], "position": list(Q[i]), "velocity": [], "effort": [],
        },
    ),
    "foxglove": (
        "foxglove.JointStates",
        lambda i: {
            "timestamp": stamp(i),
            "joints": [{"name": "b", "position": Q[i, 1]}, {"name": "a", "position": Q[i, 0]}],
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", sorted(JOINTS))
def test_joint_states(kind: str, tmp_path: Path) -> None:
    log = read(write(tmp_path / "log.mcap", *JOINTS[kind]), "position", "velocity", names=("a", "b"))
    assert log.steps == T.size
    assert log.start_ns == START_NS
    np.testing.assert_allclose(log["s.position"].values, Q, atol=1e-12)
    assert np.abs(log["s.velocity"].values[5:-5, 0] - 3.0 * np.cos(3.0 * T[5:-5])).max() < 0.01


SECOND_POSE = {
    "position": tuple(f"poses[1].position.{part}" for part in "xyz"),
    "orientation": tuple(f"poses[1].orientation.{part}" for part in "wxyz"),
}
POSES: Mapping[str, tuple[str, Callable[[int], Any], dict[str, Any]]] = {
    "pose in frame": ("foxglove.PoseInFrame", lambda i: {"timestamp": stamp(i), "pose": pose(i)}, {}),
    "transform": (
        "foxglove.FrameTransform",
        lambda i: {
            "timestamp": stamp(i), "parent_frame_id": "world", "child_frame_id": "box",
            "translation": pose(i)["position"], "rotation": pose(i)["orientation"],
        },
        {},
    ),
    "transforms": (
        "foxglove.FrameTransforms",
        lambda i: {
            "transforms": [
                {
                    "timestamp": stamp(i), "parent_frame_id": "world", "child_frame_id": name,
                    "translation": {**pose(i)["position"], "z": height}, "rotation": pose(i)["orientation"],
                }
                for name, height in (("other", 9.0), ("box", 0.5))
            ]
        },
        {"child_frame": "box"},
    ),
    "one of several poses, by its path": (
        "foxglove.PosesInFrame",
        lambda i: {"timestamp": stamp(i), "frame_id": "world", "poses": [pose(0), pose(i)]},
        {"fields": SECOND_POSE},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", sorted(POSES))
def test_poses(kind: str, tmp_path: Path) -> None:
    schema, message, more = POSES[kind]
    log = read(write(tmp_path / "log.mcap", schema, message), "position", "orientation", **more)
    assert log.start_ns == START_NS
    np.testing.assert_allclose(
        log["s.position"].values, np.column_stack((Q, np.full(T.size, 0.5))), atol=1e-9
    )
    np.testing.assert_allclose(log["s.orientation"].values[:, [0, 3]], TURN, atol=1e-9)


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


def test_damaged_messages_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    good = JOINTS["ros"][1]
    bad = {
        10: b"{", 20: b"[1]", 30: b"[" * 5000, 40: b'{"a": ' * 200 + b"1" + b"}" * 200,
        50: b'{"stamp": NaN}', 60: b'{"stamp": ' + b"9" * 400 + b"}", 70: b'{"a": ' + b"9" * 400 + b"}",
    }  # fmt: skip
    path = write(tmp_path / "log.mcap", JOINTS["ros"][0], lambda i: bad.get(i) or good(i))
    log = read(path, "position", names=("a", "b"))
    assert "7 messages damaged and dropped" in caplog.text
    np.testing.assert_allclose(log["s.position"].values, Q, atol=1e-3)
    (topic,) = survey(path).topics
    assert topic.quantities == ("position",)
    assert topic.entries == ("a", "b")


def test_null_is_a_number_that_was_not_measured(tmp_path: Path) -> None:
    path = write(tmp_path / "log.mcap", "own", lambda i: {"stamp": stamp(i), "q": None if i % 2 else Q[i, 0]})
    log = read(path, "value", fields={"value": ("q",)})
    assert log["s.value"].sampled.tolist() == [i % 2 == 0 for i in range(log.steps)]
