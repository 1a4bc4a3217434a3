"""What program and sender send each other: plans and orders one way, samples and reports the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.errors import AmheError, OperatorStopError
from amhe_cli.robots.go1.kinematics import LOWER, TORQUE_LIMIT, UPPER
from amhe_cli.robots.go1.link.packets import RobotState

#: Limits of the vendor's library and of the robot's description differ: a command stays within both.
_VENDOR_LOWER = sealed(np.tile([-1.047, -0.663, -2.721], 4))
_VENDOR_UPPER = sealed(np.tile([1.047, 2.966, -0.837], 4))
LOWEST = sealed(np.maximum(LOWER, _VENDOR_LOWER))
HIGHEST = sealed(np.minimum(UPPER, _VENDOR_UPPER))
#: Number of packets whose joint targets are remembered: those of a second.
_REMEMBERED = 500
#: Time between two samples of the commands that a robot followed [s].
_FOLLOWED_PERIOD = 0.004
#: Times [s], shape (m,), and joint targets [rad], shape (m, 12).
Track = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Joint targets over time.

    Each row is meant for one period and is reached in its middle; between the middles targets move along
    straight lines, so that they are smooth and, on average, no later than rows that were held.

    Args:
        start: When the first row takes effect [s].
        period: Period of a row [s].
        rows: Joint targets [rad], shape (n, 12).
    """

    start: float
    period: float
    rows: FloatArray

    def at(self, time: float) -> FloatArray:
        """Targets at a time [s], shape (12,); the first and last row are held."""
        place = min(max((time - self.start) / self.period - 0.5, 0.0), len(self.rows) - 1.0)
        row = int(place)
        if row + 1 >= len(self.rows):
            return self.rows[-1]
        return self.rows[row] + (place - row) * (self.rows[row + 1] - self.rows[row])


class Sent:
    """The last joint targets that were sent.

    Args:
        first: Joint targets in force before any was sent [rad], shape (12,).
    """

    def __init__(self, first: FloatArray) -> None:
        self._sent = deque([(-np.inf, first)], _REMEMBERED)

    def add(self, time: float, targets: FloatArray) -> None:
        """Targets (12,) sent at a time [s]."""
        self._sent.append((time, targets))

    def by(self, time: float) -> FloatArray:
        """The newest targets (12,) that had been sent by a time [s]; times must not decrease."""
        while len(self._sent) > 1 and self._sent[1][0] <= time:
            self._sent.popleft()
        return self._sent[0][1]


class Followed:
    """Joint targets with the times since when they were followed; a reader holds each until the next.

    Plans are not what a robot followed: one that is late begins late, a new one is blended into, and the
    motors' torque is limited.
    """

    def __init__(self) -> None:
        self._until = -np.inf
        self._newest = np.empty(0), np.empty((0, LOWEST.size))

    def take(self, time: float, in_force: FloatArray, times: FloatArray, targets: FloatArray) -> Track:
        """The commands of one cycle; call it once for each, in their order.

        Args:
            time: Time of the cycle [s].
            in_force: Joint targets in force then [rad], shape (12,): the first command.
            times: Times [s] (m,) at which the robot followed targets [rad] (m, 12) since the last cycle.
            targets: Those targets.

        Returns:
            Times [s], shape (c,), and targets [rad], shape (c, 12): those in the middle of each short period.
        """
        if not np.isfinite(self._until):
            self._until = time
            return np.array([time]), in_force[None]
        times, targets = np.append(self._newest[0], times), np.vstack((self._newest[1], targets))
        self._newest = times[-1:], targets[-1:]
        known = np.max(times, initial=self._until) - 0.5 * _FOLLOWED_PERIOD
        count = int((known - self._until) / _FOLLOWED_PERIOD + 1e-6)
        stamps = self._until + _FOLLOWED_PERIOD * np.arange(1, count + 1, dtype=np.float64)
        if not stamps.size:
            return stamps, np.empty((0, targets.shape[1]))
        self._until = float(stamps[-1])
        middles = stamps + 0.5 * _FOLLOWED_PERIOD
        return stamps, np.stack([np.interp(middles, times, column) for column in targets.T], axis=1)


def eased(start: FloatArray, end: FloatArray, share: float) -> FloatArray:
    """Move from start to end (12,), slowly at both ends; `share` of the time from 0 to 1."""
    share = min(max(share, 0.0), 1.0)
    return start + share * share * (3.0 - 2.0 * share) * (end - start)


def travel_time(start: FloatArray, end: FloatArray, speed: float) -> float:
    """Time that `eased` takes if no joint exceeds a speed [rad/s]: [s]."""
    return 1.5 * float(np.abs(end - start).max()) / speed


def allowed(targets: FloatArray, joints: FloatArray, kp: float, share: float) -> FloatArray:
    """Targets within the joints' limits that demand no more than a share of the available torque.

    The torque limit comes first: a joint outside of its limits is led back by no more than that, and its
    target may then be outside, too. The trip `range` handles joints that are outside when they should
    not be.

    Args:
        targets: Joint targets [rad], shape (12,).
        joints: Present joint angles [rad], shape (12,).
        kp: Gain [N m/rad].
        share: Allowed share of the torque limit.
    """
    reach = share * TORQUE_LIMIT / max(kp, 1e-6)
    inside = np.minimum(np.maximum(targets, LOWEST), HIGHEST)
    return np.minimum(np.maximum(inside, joints - reach), joints + reach)


def beyond(joints: FloatArray, margin: float) -> bool:
    """Whether a joint is outside the limits by more than a margin [rad]."""
    return bool(((joints < LOWEST - margin) | (joints > HIGHEST + margin)).any())


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
