"""Messages between sender and program: plans and orders one way, samples and reports the other."""

from __future__ import annotations

import json
from enum import IntEnum
from typing import Any

import numpy as np

from amhe_cli.robots.go1.link.motion import Targets


class Phase(IntEnum):
    """What the sender is doing; only later ones follow."""

    CONNECT = 0
    """Packets that do nothing are sent, so that the robot sends its state."""
    HOLD = 1
    """Gains rise about the joints' present angles."""
    STAND = 2
    """The robot moves slowly by the folded pose to standing."""
    READY = 3
    """The robot stands, and waits for the operator."""
    RUN = 4
    """The robot follows plans."""
    PAUSE = 5
    """Plan or poses are lost: the robot stands still where it is."""
    SIT = 6
    """The robot moves slowly to the folded pose."""
    DAMP = 7
    """Motors only damp."""
    OVER = 8
    """The last packet that does nothing has been sent."""


#: One-byte orders.
STAND, ARM, FINISH, STOP = b"S", b"A", b"F", b"X"
#: Each begins the reason why poses cannot be believed any more: too many of them cannot be true, or the robot
#: itself contradicts them.
DOUBT, CONTRADICTION = b"D", b"C"
_PLAN, _SAMPLE, _REPORT = b"P", b"s", b"r"

#: A state of the robot, on our clock, with the phase in which it arrived and the joint targets followed then.
SAMPLE: Any = np.dtype(
    [
        ("time", "f8"), ("phase", "u1"), ("quaternion", "f8", 4), ("gyro", "f8", 3),
        ("accelerometer", "f8", 3), ("joints", "f8", 12), ("joint_rates", "f8", 12),
        ("targets", "f8", 12),
    ]
)  # fmt: skip
_HEADER = np.dtype([("start", "f8"), ("period", "f8"), ("pose_time", "f8"), ("sent", "f8")])


def plan_message(plan: Targets, pose_time: float, now: float) -> bytes:
    """A plan that is sent now, and the time of the older one of the newest poses of trunk and box [s]."""
    header = np.array([(plan.start, plan.period, pose_time, now)], dtype=_HEADER)
    return _PLAN + header.tobytes() + np.ascontiguousarray(plan.rows, dtype=np.float64).tobytes()


def read_plan(message: bytes) -> tuple[Targets, float, float] | None:
    """The inverse of `plan_message`; None: the message is not a plan."""
    if message[:1] != _PLAN:
        return None
    end = 1 + _HEADER.itemsize
    header = np.frombuffer(message[1:end], dtype=_HEADER)[0]
    rows = np.frombuffer(message[end:], dtype=np.float64).reshape(-1, 12)
    plan = Targets(float(header["start"]), float(header["period"]), rows)
    return plan, float(header["pose_time"]), float(header["sent"])


def sample_message(sample: Any) -> bytes:
    """A record of `SAMPLE`."""
    return _SAMPLE + sample.tobytes()


def report_message(report: dict[str, Any]) -> bytes:
    """A report of the sender, as plain values."""
    return _REPORT + json.dumps(report).encode()


def read(message: bytes) -> Any:
    """A sample as a record, a report as a dictionary; None: neither."""
    if message[:1] == _SAMPLE:
        return np.frombuffer(message[1:], dtype=SAMPLE)[0]
    return json.loads(message[1:]) if message[:1] == _REPORT else None
