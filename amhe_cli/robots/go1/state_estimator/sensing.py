"""What one cycle's samples contain: poses, whole robot samples, the trunk's velocity by its feet."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.core.samples import Samples
from amhe_cli.robots.go1 import kinematics as legs

#: Number of robot samples in one velocity of the feet: the errors of feet are slow, so more samples add
#: nothing.
_BLOCK = 5
#: Columns of `SensorSamples.table`.
_JOINTS, _RATES, _GYRO, _SPIN = slice(1, 13), slice(13, 25), slice(25, 28), [0, 25, 26, 27]
#: Offsets in time for differences [s]: now, a little later, a little earlier.
_DT = 1e-4
_INSTANT = sealed([0.0, _DT, -_DT])[:, None, None]


class Pose(NamedTuple):
    """Time [s], position [m] (3,) and unit quaternion (4,) of one body."""

    time: float
    position: FloatArray
    orientation: FloatArray


class Feet(NamedTuple):
    """A block of samples: time [s], the trunk's velocity in its own frame [m/s] by each foot, who stood.

    Shapes (4, 3) and (4,).
    """

    time: float
    velocities: FloatArray
    stood: BoolArray


def poses(measured: Samples, body: str) -> list[Pose]:
    """The poses in which trunk or box was seen, in the order of time."""
    (times, positions), (_, orientations) = measured[f"{body}.position"], measured[f"{body}.orientation"]
    sizes = np.sqrt(np.square(orientations).sum(axis=1))
    # Some systems send zeros in place of a body that they have lost.
    seen = np.isfinite(times) & np.isfinite(positions).all(axis=1) & np.isfinite(sizes) & (sizes > 0.5)
    rows = np.flatnonzero(seen)
    ordered = rows[np.argsort(times[rows], kind="stable")]
    return [Pose(float(times[i]), positions[i], orientations[i] / sizes[i]) for i in ordered]


@dataclass(frozen=True, slots=True, eq=False)
class SensorSamples:
    """The robot's own samples of one cycle: whole, new, and in the order of time.

    Args:
        table: Time [s], joints [rad], joint rates [rad/s] and gyro [rad/s], shape (m, 28).
        standing: Feet that should stand, shape (m, 4).
        spins: Time and gyro; before those of the table the last two of the cycles before, or as many as there
            were, shape (m + 2, 4).
    """

    table: FloatArray
    standing: BoolArray
    spins: FloatArray

    @staticmethod
    def of(
        measured: Samples, standing: Callable[[FloatArray], BoolArray], before: FloatArray
    ) -> SensorSamples:
        """Samples later than those of `before`, the last `spins`; none with a value that is not finite."""
        times, joints = measured["joints.position"]
        rates, gyro = measured["joints.velocity"][1], measured["imu.angular_velocity"][1]
        table = np.hstack((times[:, None], joints, rates, gyro))
        good = np.isfinite(table).all(axis=1)
        if len(before):
            good &= times > before[-1, 0]
        rows = np.flatnonzero(good)
        rows = rows[np.unique(times[rows], return_index=True)[1]]
        table = table[rows]
        return SensorSamples(table, standing(times)[rows], np.vstack((before[-2:], table[:, _SPIN])))

    def rows(self) -> Iterator[tuple[float, FloatArray, FloatArray, FloatArray]]:
        """Time [s], joints (12,), their rates (12,) and gyro (3,) of one sample after the other."""
        for time, row in zip(self.table[:, 0].tolist(), self.table, strict=True):
            yield time, row[_JOINTS], row[_RATES], row[_GYRO]


class Gyro:
    """Integrated gyro: the angle that the trunk turned. Samples are joined by lines, and held outside."""

    def __init__(self, samples: SensorSamples) -> None:
        times, rates = samples.spins[:, :1], samples.spins[:, 1:]
        steps = 0.5 * (rates[1:] + rates[:-1]) * (times[1:] - times[:-1])
        self._times = times[:, 0].tolist()
        self._angles = np.cumsum(np.vstack((np.zeros(3), steps)), axis=0)
        self.until, self.last = (self._times[-1], rates[-1]) if len(rates) else (-np.inf, np.zeros(3))

    def turned(self, start: float, end: float) -> FloatArray:
        """Rotation vector [rad] from one time [s] to a later one, shape (3,); zero before two samples."""
        if len(self._times) < 2 or start >= end:
            return np.zeros(3)
        return self._angle(end) - self._angle(start)

    def _angle(self, time: float) -> FloatArray:
        i = min(max(bisect(self._times, time), 1), len(self._times) - 1)
        early, late = self._times[i - 1], self._times[i]
        before, after = self._angles[i - 1], self._angles[i]
        return before + (time - early) / (late - early) * (after - before)


def feet(samples: SensorSamples, offset: FloatArray, upright: FloatArray) -> list[Feet]:
    """The trunk's velocity by its feet, block by block.

    Args:
        samples: The robot's samples.
        offset: Offset of the gyro, to be added to it [rad/s], shape (3,).
        upright: The world's upward direction in the trunk's frame, shape (3,).
    """
    count = len(samples.table)
    if not count:
        return []
    starts = np.arange(0, count, _BLOCK)
    sizes = np.minimum(count - starts, _BLOCK)
    # Means first: within a block, J(q) dq bends by less than 1 mm/s.
    means = np.add.reduceat(samples.table, starts) / sizes[:, None]
    velocities = trunk_velocities(means[:, _JOINTS], means[:, _RATES], means[:, _GYRO] + offset, upright)
    # A foot that stood in a part of the block only has hardly landed, or is about to leave.
    stood = np.logical_and.reduceat(samples.standing, starts)
    return [Feet(*block) for block in zip(means[:, 0].tolist(), velocities, stood, strict=True)]


def trunk_velocities(
    joints: FloatArray, joint_rates: FloatArray, gyro: FloatArray, upright: FloatArray
) -> FloatArray:
    """Velocity of the trunk if the lowest point of a foot rests, by each foot.

    A foot is a sphere that rolls on the floor: its centre does not rest.

    Args:
        joints: Angles [rad], shape (m, 12).
        joint_rates: Joint velocities [rad/s], shape (m, 12).
        gyro: Angular velocity of the trunk in its own frame [rad/s], shape (m, 3).
        upright: The world's upward direction in the trunk's frame, shape (3,).

    Returns:
        Velocities of the trunk's origin in its own frame [m/s], shape (m, 4, 3).
    """
    down = -legs.FOOT_RADIUS * upright
    hips, rates = joints.reshape(-1, 4, 3)[..., 0], joint_rates.reshape(-1, 4, 3)
    # One sweep for places and velocities; the difference is exact to 1e-7 m/s and costs half of the Jacobian.
    places, after, before = legs.feet(joints + _INSTANT * joint_rates)
    bends = rates[..., 1] + rates[..., 2]
    calves = np.stack((rates[..., 0], bends * np.cos(hips), bends * np.sin(hips)), axis=-1)
    turning = _cross(gyro[:, None], places + down) + _cross(calves, down)
    return (before - after) / (2.0 * _DT) - turning


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Like `np.cross` of vectors (..., 3), which takes twice as long for few of them."""
    ax, ay, az, bx, by, bz = (v[..., i] for v in (a, b) for i in range(3))
    return np.stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), axis=-1)
