"""Joint targets at any time: those of a plan, slow motions from one pose to another, and their limits."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.kinematics import LOWER, TORQUE_LIMIT, UPPER

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
