"""State of robot and box from motion capture, gyro, joint encoders and the standing feet.

One small filter (`kalman.py`) for each of: position and orientation of trunk and box, joints, and angular
velocity of the trunk. The trunk's velocity comes from its feet: the lowest point of a standing foot rests. A
foot that should stand but has not yet landed, or slips, disagrees with the prediction and is left out.

Nothing is assumed of the box: it may lift or tilt. The accelerometer is not used: see docs/notes/control.md.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Callable
from dataclasses import dataclass
from math import dist, isfinite, sqrt
from typing import NamedTuple

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, columns, sealed
from amhe_cli.core.log import Samples
from amhe_cli.core.rotations import cross
from amhe_cli.robots.go1 import kinematics as legs
from amhe_cli.robots.go1.kalman import REST, Turn, ValueFilter, Vector
from amhe_cli.robots.go1.state import Body, SensorNoise, State

#: Number of robot samples in one velocity of the feet: the errors of feet are slow, so more samples add
#: nothing.
_BLOCK = 5
#: Columns of `SensorSamples.table`.
_SPIN, _GYRO, _JOINTS, _RATES = slice(0, 4), slice(1, 4), slice(4, 16), slice(16, 28)
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
    found = []
    for time, position, orientation in zip(times.tolist(), positions, orientations, strict=True):
        size = sqrt(orientation @ orientation)
        # Some systems send zeros in place of a body that they have lost.
        if size > 0.5 and isfinite(time + size + sum(position.tolist())):
            found.append(Pose(time, position, orientation / size))
    return sorted(found, key=lambda pose: pose.time)


@dataclass(frozen=True, slots=True, eq=False)
class SensorSamples:
    """The robot's own samples of one cycle: whole, new, and in the order of time.

    Args:
        table: Time [s], gyro [rad/s], joints [rad] and joint rates [rad/s], shape (m, 28).
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
        table = np.concatenate((times[:, None], gyro, joints, rates), axis=1)
        good = np.isfinite(table).all(axis=1)
        if len(before):
            good &= times > before[-1, 0]
        table = table[good]
        if (table[1:, 0] <= table[:-1, 0]).any():
            table = table[np.unique(table[:, 0], return_index=True)[1]]
        return SensorSamples(table, standing(table[:, 0]), np.concatenate((before[-2:], table[:, _SPIN])))


class Gyro:
    """Integrated gyro: the angle that the trunk turned. Samples are joined by lines, and held outside."""

    def __init__(self, samples: SensorSamples) -> None:
        times, rates = samples.spins[:, :1], samples.spins[:, 1:]
        steps = 0.5 * (rates[1:] + rates[:-1]) * (times[1:] - times[:-1])
        self._times = times[:, 0].tolist()
        self._angles = [REST, *np.cumsum(steps, axis=0).tolist()]
        self.until, self.last = (self._times[-1], rates[-1].tolist()) if len(rates) else (-np.inf, REST)

    def turned(self, start: float, end: float) -> Vector:
        """Rotation vector [rad] from one time [s] to a later one; zero before two samples."""
        if len(self._times) < 2 or start >= end:
            return REST
        return [b - a for a, b in zip(self._angle(start), self._angle(end), strict=True)]

    def _angle(self, time: float) -> Vector:
        i = min(max(bisect(self._times, time), 1), len(self._times) - 1)
        early, late = self._times[i - 1], self._times[i]
        share = (time - early) / (late - early)
        return [a + share * (b - a) for a, b in zip(self._angles[i - 1], self._angles[i], strict=True)]


def feet(samples: SensorSamples, offset: Vector, upright: FloatArray) -> list[Feet]:
    """The trunk's velocity by its feet, block by block.

    Args:
        samples: The robot's samples.
        offset: Offset of the gyro, to be added to it [rad/s].
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
    calves = columns(hips.shape, rates[..., 0], bends * np.cos(hips), bends * np.sin(hips))
    turning = cross(gyro[:, None], places + down) + cross(calves, down)
    return (before - after) / (2.0 * _DT) - turning


#: Poses that come later than this are left out; joints are not extrapolated any further than that [s].
_OLDEST, _HOLD = 0.1, 0.02
#: Noise of the trunk's rotation while the gyro is silent [rad/sqrt(s)]: a stride's rocking.
_BLIND = 0.1
#: Robot and box begin at rest: first sd of velocities [m/s], angular velocities, the gyro's offset [rad/s],
#: and of the trunk's angular acceleration [rad/s^2].
_FIRST_SPEED, _FIRST_TURN, _FIRST_OFFSET, _FIRST_SPIN_UP = 0.02, 0.05, 0.02, 5.0


@dataclass(frozen=True, slots=True)
class EstimatorNoise(SensorNoise):
    """Noise of the sensors (sd, see `SensorNoise`), and process noise of robot and box (root of a density).

    Args:
        foot: Noise of the trunk's velocity by the feet, slip and give of the ground included [m/s].
        gate: Feet that are further from the prediction, in sd, do not stand.
        trunk: Acceleration of the trunk [m/s^2/sqrt(Hz)].
        box: Acceleration of the box [m/s^2/sqrt(Hz)].
        box_turn: Angular acceleration of the box [rad/s^2/sqrt(Hz)].
        trunk_turn: Angle that the gyro misses, noise and vibration [rad/sqrt(s)].
        gyro_drift: Walk of the gyro's offset [rad/s/sqrt(s)].
        trunk_jerk: Change of the trunk's angular acceleration [rad/s^3/sqrt(Hz)].
        joint_drive: Acceleration of joints [rad/s^2/sqrt(Hz)].
    """

    foot: float = 0.015
    gate: float = 2.0
    trunk: float = 0.2
    box: float = 0.07
    box_turn: float = 0.2
    trunk_turn: float = 0.002
    gyro_drift: float = 0.001
    trunk_jerk: float = 150.0
    joint_drive: float = 10.0


class _Filters(NamedTuple):
    """The filters of trunk or box."""

    place: ValueFilter
    turn: Turn


class StateEstimator:
    """Pose and twist of trunk and box, joints and joint rates, once in a control cycle.

    Args:
        standing: Function that says which feet should stand at times [s] (m,), shape (m, 4).
    """

    def __init__(self, standing: Callable[[FloatArray], BoolArray]) -> None:
        self._standing, self._noise = standing, EstimatorNoise()
        self._trunk: _Filters | None = None
        self._box: _Filters | None = None
        self._joints: ValueFilter | None = None
        self._gyro: ValueFilter | None = None
        self._spins = np.empty((0, 4))

    def update(self, time: float, measured: Samples) -> State:
        """Take in the measurements since the last call, and estimate the state at a time [s].

        Raises:
            ValueError: See `state`; the measurements are taken in nevertheless.
        """
        self.observe(measured)
        return self.state(time)

    def observe(self, measured: Samples) -> None:
        """Take in the measurements since the last call; samples that are not finite are left out."""
        samples = SensorSamples.of(measured, self._standing, self._spins)
        self._spins = samples.spins
        self._see_joints(samples)
        self._see_trunk(poses(measured, "trunk"), samples)
        self._see_box(poses(measured, "box"))

    def state(self, time: float) -> State:
        """Robot and box at a time [s], from all measurements so far.

        Raises:
            ValueError: Trunk, box and joints have not each been measured once.
        """
        if self._trunk is None or self._box is None or self._joints is None or self._gyro is None:
            raise ValueError("no state yet: trunk, box and joints must each have been measured once")
        held = min(time, self._joints.time + _HOLD)
        turning = [a + b for a, b in zip(self._gyro.at(held), self._trunk.turn.error.rate, strict=True)]
        trunk = _body(self._trunk, time, turning)
        box = _body(self._box, time, self._box.turn.error.rate)
        return State(time, trunk, box, np.array(self._joints.at(held)), np.array(self._joints.rate))

    def _see_joints(self, samples: SensorSamples) -> None:
        """Take in joints, and the trunk's angular velocity by the gyro."""
        noise = self._noise
        for row in samples.table.tolist():
            time, spin, joints, rates = row[0], row[_GYRO], row[_JOINTS], row[_RATES]
            if self._joints is None or self._gyro is None:
                self._joints = ValueFilter(
                    time, joints, rates, noise.joint**2, noise.joint_rate**2, noise.joint_drive
                )
                self._gyro = ValueFilter(time, spin, REST, noise.gyro**2, _FIRST_SPIN_UP**2, noise.trunk_jerk)
                continue
            self._joints.advance(time)
            self._joints.see_value(joints, noise.joint, time)
            self._joints.see_rate(rates, noise.joint_rate)
            self._gyro.advance(time)
            self._gyro.see_value(spin, noise.gyro, time)

    def _see_trunk(self, seen: list[Pose], samples: SensorSamples) -> None:
        """Take in poses and feet in the order of time, the gyro in between."""
        noise = self._noise
        if self._trunk is None:
            if not seen:
                return
            self._trunk = self._started(
                seen[0], noise.trunk, (_FIRST_OFFSET, noise.gyro_drift, noise.trunk_turn)
            )
        place, turn = self._trunk
        gyro = Gyro(samples)
        events = (*seen, *feet(samples, turn.error.rate, np.array(turn.matrix()[2])))
        for event in sorted(events, key=lambda event: event.time):
            turn.error.walk = noise.trunk_turn if event.time <= gyro.until + _HOLD else _BLIND
            place.advance(event.time)
            turn.advance(event.time, gyro.turned(turn.time, min(event.time, gyro.until + _HOLD)))
            if isinstance(event, Pose):
                self._see_pose(self._trunk, event, gyro.last)
            else:
                self._see_feet(place, event, turn.matrix())
        # The next cycle's gyro no longer knows of these samples but the last two.
        if len(samples.table):
            end = float(samples.table[-1, 0])
            turn.advance(end, gyro.turned(turn.time, end))

    def _see_box(self, seen: list[Pose]) -> None:
        for pose in seen:
            if self._box is None:
                self._box = self._started(pose, self._noise.box, (_FIRST_TURN, self._noise.box_turn, 0.0))
            self._box.place.advance(pose.time)
            self._box.turn.advance(pose.time)
            self._see_pose(self._box, pose)

    def _see_pose(self, body: _Filters, pose: Pose, spin: Vector = REST) -> None:
        """Correct by a pose; `spin` is the gyro's angular velocity [rad/s], if already counted."""
        if pose.time > body.place.time - _OLDEST:
            body.place.see_value(pose.position.tolist(), self._noise.position, pose.time)
            body.turn.see(pose.orientation.tolist(), self._noise.orientation, pose.time, spin)

    def _started(self, pose: Pose, drive: float, turning: tuple[float, float, float]) -> _Filters:
        """Filters at rest at a pose; `turning`: first sd of the turning rate, its drive, the angle's walk."""
        noise, start, (sd, turn_drive, walk) = self._noise, pose.position.tolist(), turning
        place = ValueFilter(pose.time, start, REST, noise.position**2, _FIRST_SPEED**2, drive)
        error = ValueFilter(pose.time, REST, REST, noise.orientation**2, sd**2, turn_drive, walk)
        return _Filters(place, Turn(pose.orientation.tolist(), error))

    def _see_feet(self, place: ValueFilter, block: Feet, to_world: list[Vector]) -> None:
        """Correct the trunk's velocity by those feet whose velocity agrees with the prediction."""
        noise, velocities = self._noise, block.velocities @ np.array(to_world).T
        limit = noise.gate * sqrt(place.rr + noise.foot**2)
        rests = [seen for seen in velocities[block.stood].tolist() if dist(seen, place.rate) < limit]
        if rests:
            place.see_rate([sum(axis) / len(rests) for axis in zip(*rests, strict=True)], noise.foot)


def _body(filters: _Filters, time: float, rate: Vector) -> Body:
    """The body at a time [s], at this angular velocity [rad/s]."""
    place, turn = filters
    return Body(*map(np.array, (place.at(time), turn.at(time, rate), place.rate, rate)))
