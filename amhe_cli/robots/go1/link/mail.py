"""What program and sender tell each other: plans and orders one way, samples and reports the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from amhe_cli.core.errors import AmheError, OperatorStopError
from amhe_cli.robots.go1.link.motion import Targets
from amhe_cli.robots.go1.link.state import RobotState


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


#: Fields of an inbox that a newer plan replaces.
_NEWEST = ("plan", "plan_time", "pose_time")


@dataclass(slots=True, eq=False)
class Inbox:
    """The newest of all that has arrived; the sender's loop fills it.

    Args:
        state: Newest state of the robot; None: none yet.
        state_time: Time after which it arrived [s].
        bad_packets: Damaged datagrams since the last good one.
        share: Share of the robot's last states that reached us.
        plan: Newest plan.
        plan_time: Time at which the program sent it [s].
        pose_time: Time of the older one of the newest poses of trunk and box [s].
        doubt: Why poses cannot be believed any more; '' if they can.
        contradiction: What contradicts the poses; '' if nothing does.
        stand, arm, finish: Whether the operator, or the program, wants this.
        stop: Why motors are to be damped at once; '' if they are not.
    """

    state: RobotState | None = None
    state_time: float = -np.inf
    bad_packets: int = 0
    share: float = 1.0
    plan: Targets | None = None
    plan_time: float = -np.inf
    pose_time: float = -np.inf
    doubt: str = ""
    contradiction: str = ""
    stand: bool = False
    arm: bool = False
    finish: bool = False
    stop: str = ""

    def take(self, news: Mapping[str, Any]) -> None:
        """Take in fields that the program sends: a newer plan, and orders, of which the first stays."""
        for name, value in news.items():
            setattr(self, name, value if name in _NEWEST else getattr(self, name) or value)


#: A state of the robot, on our clock, with the phase in which it arrived and the joint targets followed then.
SAMPLE: Any = np.dtype(
    [
        ("time", "f8"), ("phase", "u1"), ("quaternion", "f8", 4), ("gyro", "f8", 3),
        ("accelerometer", "f8", 3), ("joints", "f8", 12), ("joint_rates", "f8", 12),
        ("targets", "f8", 12),
    ]
)  # fmt: skip

#: What the operator stops a run with, as the sender names it.
_OPERATOR = ("key", "the terminal is gone", "SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")


class StoppedError(AmheError):
    """A trip ended the run; the robot has been let down, or is being.

    Args:
        reason: Why, in words.
        trip: Name of the trip; '': none ended it.
    """

    def __init__(self, reason: str, trip: str = "") -> None:
        super().__init__(f"trip {trip}: {reason}" if trip else reason)
        self.trip = trip


@dataclass(slots=True)
class SenderReport:
    """The newest report of the sender: see `sender.Sender._report`."""

    phase: Phase = Phase.CONNECT
    trip: str = ""
    reason: str = ""
    contact: dict[str, Any] = field(default_factory=dict)
    refused: int = 0
    intervals: dict[str, float] = field(default_factory=dict)
    robot: RobotState | None = None
    realtime: bool = True
    unfit: str = ""

    @property
    def stop(self) -> AmheError:
        """Why the run ended before its end, as an error to raise."""
        if self.trip == "remote" or self.reason in _OPERATOR:
            return OperatorStopError(f"stopped by the operator: {self.reason}")
        return StoppedError(self.reason, self.trip) if self.trip else StoppedError("the run was ended")
