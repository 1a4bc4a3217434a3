"""Poses against what the robot feels: its legs and IMU say how far it went, contact says where the box is.

A pose that stays, or slides, while its stamps run on is as good as any other to the gate, which knows poses
alone. Legs and cameras must agree about the way of the last 0.3 s; no part of the robot is inside the box,
and the box moves only where the robot is.
"""

from __future__ import annotations

from collections import deque
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.rotations import conjugate, mean, multiply, rotate
from amhe_cli.robots.go1.kalman import REST, ValueFilter
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, feet
from amhe_cli.robots.go1.poses.gate import up
from amhe_cli.robots.go1.poses.sources import Pose
from amhe_cli.robots.go1.state_estimator import Pose as Seen
from amhe_cli.robots.go1.state_estimator import trunk_velocities

#: Ways are compared over this time [s], and where robot and box are is averaged over that.
_WINDOW, _BRIEF = 0.3, 0.1
#: The least number of poses in each of these times, and how many are kept of a body.
_LEAST, _KEPT = 4, 120
#: The clocks of robot and cameras agree to this [s].
_CLOCKS = 0.1
#: Robot samples in one velocity of the feet.
_BLOCK = 5
#: A foot stands that is no higher over the lowest one than this [m] ...
_LANDED = 0.012
#: ... and whose velocity is predicted: noise of a foot [m/s], root of the density of the trunk's acceleration
#: [m/s^2/sqrt(Hz)], and the largest deviation in sd.
_FOOT, _DRIVE, _AGREES = 0.03, 0.6, 3.0
#: What slipping feet may add to the way [m/s], and stamps and the rigid body's offset [m], sd.
_SLIP, _OFFSET = 0.015, 0.001
#: Cameras show nothing as still as this [m] for 0.2 s; legs that have moved the trunk by that [m] deny it.
#: Those of a simulated robot that stands wander by 1.0 mm in the longest time [s] that counts.
_STILL, _MOVED, _LONGEST = 1e-5, 0.0012, 0.5
#: Cameras whose noise never was below this many times that [m], for so long [s], are not suddenly so still.
_RESTLESS, _KNOWN = 20.0, 1.0
#: How well the distance of robot and box is known [m], sd, and what the robot does not touch is further away
#: than that.
_FACE, _UNTOUCHED = 0.0035, 0.05
#: Points of the bumper in the trunk's frame [m], and its radius.
_BUMPER = sealed([[0.255, y, z] for y in (-0.13, -0.065, 0.0, 0.065, 0.13) for z in (0.0, -0.08)])
_BUMPER_RADIUS = 0.015
_RADII = sealed([_BUMPER_RADIUS] * len(_BUMPER) + [FOOT_RADIUS] * 4)


class _Felt(NamedTuple):
    """Pose of the trunk at a time [s] by legs and IMU in a frame of its own, feet (4, 3), how blind it is.

    Blind is the sum of the cubes of the times without a state until then [s^3].
    """

    time: float
    place: FloatArray
    turn: FloatArray
    feet: FloatArray
    blind: float


class Witness:
    """Compares the poses of trunk and box with what the robot feels.

    Args:
        gate: Largest deviation in sd.
        state_age: How old the robot's states may be [s].
        trunk, box: Names of the bodies.
        size: Edge lengths of the box [m], shape (3,).
    """

    def __init__(self, gate: float, state_age: float, trunk: str, box: str, size: FloatArray) -> None:
        self._gate, self._latest, self._half = gate, state_age + _CLOCKS, 0.5 * size
        self._names = trunk, box
        self.begin()

    def begin(self) -> None:
        """Forget what came until now: the run begins."""
        self._way: ValueFilter | None = None
        self._felt: deque[_Felt] = deque(maxlen=_KEPT)
        self._seen: dict[str, deque[Seen]] = {name: deque(maxlen=_KEPT) for name in self._names}
        self._gaps: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._stir, self._stirred_since, self._until = np.inf, np.inf, np.inf

    def feel(self, robot: Any, until: float = np.inf) -> None:
        """Take in states of the robot, in the order of time: fields of `mail.SAMPLE`, shape (m,).

        Args:
            robot: The states.
            until: When they were taken from the sender [s]: later ones may be there already.
        """
        self._until = until
        for block in np.array_split(robot, max(1, len(robot) // _BLOCK)) if len(robot) else ():
            time, joints = float(block["time"].mean()), block["joints"].mean(axis=0)
            turn = block["quaternion"][len(block) // 2]
            upright, at = up(turn), feet(joints)
            rates, gyro = block["joint_rates"].mean(axis=0), block["gyro"].mean(axis=0)
            velocities = trunk_velocities(joints[None], rates[None], gyro[None], upright)[0]
            heights = at @ upright
            way = self._step(time, rotate(turn, velocities[heights < heights.min() + _LANDED]))
            last = self._felt[-1] if self._felt else _Felt(time, way, turn, at, 0.0)
            # states may be lost in the middle of a block, too
            step = max(time - last.time, np.diff(block["time"]).max(initial=0.0))
            self._felt.append(_Felt(time, way, turn, at, last.blind + step**3))

    def see(self, body: str, time: float, pose: Pose) -> None:
        """Take in a pose of trunk or box in one frame, z upward; one older than the newest is left out."""
        seen = self._seen[body]
        if not seen or time > seen[-1].time:
            seen.append(Seen(time, *pose))

    @property
    def contradiction(self) -> str:
        """What contradicts the poses, in words; '' if nothing does."""
        return self._out_of_step() or self._frozen() or self._astray() or self._untouchable()

    def _out_of_step(self) -> str:
        """By how much states are older than poses, in words: they are not those of now."""
        seen = self._seen[self._names[0]]
        late = min(seen[-1].time, self._until) - self._felt[-1].time if seen and self._felt else 0.0
        words = f"states of the robot are {1e3 * late:.0f} ms older than its poses"
        return words if late > self._latest else ""

    # -- legs ---------------------------------------------------------------------------------------------

    def _step(self, time: float, velocities: FloatArray) -> FloatArray:
        """The trunk's way (3,), from the velocities that each of the lowest feet gives it (n, 3).

        Some of these feet do not stand yet, and are left out.
        """
        way = self._way = self._way or ValueFilter(time, REST, REST, 0.0, 0.01, _DRIVE)
        way.advance(time)
        off = np.square(velocities - way.rate).sum(axis=1)
        standing = velocities[off < _AGREES**2 * (way.rr + _FOOT**2)]
        if len(standing):
            scatter = np.square(standing - standing.mean(axis=0)).mean()
            way.see_rate(standing.mean(axis=0).tolist(), float(np.sqrt(_FOOT**2 + scatter)))
        return np.array(way.value)

    def _window(self, body: str, longest: float = _WINDOW, other: str = "") -> list[Seen]:
        """The newest poses of a body, as old as those of another one, that the robot has felt the time of.

        None if they are too few.
        """
        both = [self._felt, *(self._seen[name] for name in (body, other or body))]
        if not all(both):
            return []
        end = min(newest[-1].time for newest in both)
        start = max(end - longest, self._felt[0].time)
        seen = [one for one in self._seen[body] if start <= one.time <= end]
        return seen if len(seen) >= _LEAST and seen[-1].time - seen[0].time > 0.8 * longest else []

    def _frozen(self) -> str:
        """That cameras show the trunk stiller than they ever did, or than its legs say, in words."""
        seen = self._seen[self._names[0]]
        if not seen:
            return ""
        last = seen[-1].position
        still = [*takewhile(lambda one: np.abs(one.position - last).max() < _STILL, reversed(seen))]
        if still[0].time - still[-1].time < 2.0 * _BRIEF:
            self._learn_noise(seen)
            return ""
        if self._stir > _RESTLESS * _STILL and still[-1].time - self._stirred_since > _KNOWN:
            return f"the poses of {self._names[0]!r} froze: its cameras were never so still"
        since = max(still[-1].time, still[0].time - _LONGEST)
        ways = [one.place for one in self._felt if since <= one.time <= still[0].time]
        if len(ways) < _LEAST or np.linalg.norm(np.ptp(ways, axis=0)) < _MOVED:
            return ""
        return f"cameras and legs contradict each other: {self._names[0]!r} stands still, or its poses froze"

    def _learn_noise(self, seen: deque[Seen]) -> None:
        """Remember the least noise of the cameras so far, over longer than a freeze takes."""
        last = seen[-1]
        brief = [one.position for one in seen if one.time > last.time - 3.0 * _BRIEF]
        if len(brief) >= _LEAST and last.time - seen[0].time > 3.0 * _BRIEF:
            self._stir = min(self._stir, _noise(np.array(brief)))
            self._stirred_since = min(self._stirred_since, last.time)

    def _astray(self) -> str:
        """How the trunk's way in the cameras contradicts its legs, in words."""
        seen = self._window(self._names[0])
        if not seen:
            return ""
        start, end = seen[0], seen[-1]
        # by time: states that are suddenly older go back
        felt = sorted((one for one in self._felt if start.time - 0.1 < one.time), key=lambda one: one.time)
        times, ways = np.array([one.time for one in felt]), np.array([one.place for one in felt])
        first, last = (_at(time, times, ways) for time in (start.time, end.time))
        places = np.array([one.position for one in seen])
        began = felt[int(np.abs(times - start.time).argmin())]
        way = rotate(multiply(start.orientation, conjugate(began.turn)), last - first)
        off, span = (end.position - start.position - way)[:2], end.time - start.time
        # between velocities that are known: a bridge
        unfelt = _DRIVE**2 / 12.0 * np.ptp([one.blind for one in felt])
        sd = np.sqrt(2.0 * _noise(places) ** 2 + _OFFSET**2 + (_SLIP * span) ** 2 + unfelt)
        if np.linalg.norm(off) <= self._gate * sd:
            return ""
        seen_by = 100.0 * np.linalg.norm((end.position - start.position)[:2])
        return (
            f"cameras and legs contradict each other: {seen_by:.1f} and {100.0 * np.linalg.norm(way[:2]):.1f}"
            f" cm in {1e3 * span:.0f} ms, {100.0 * np.linalg.norm(off):.1f} cm apart"
        )

    # -- contact ------------------------------------------------------------------------------------------

    def _untouchable(self) -> str:
        """How the box contradicts where the robot is, in words."""
        one, other = self._names
        box, near = self._window(other), self._window(other, _BRIEF, one)
        trunk = self._window(one, _BRIEF, other)
        if not (near and trunk):
            return ""
        nearest, gap = self._gap(trunk, near)
        self._gaps.append((near[-1].time, nearest))
        if gap < -self._gate * _FACE:
            return f"the robot would be {-100.0 * gap:.1f} cm inside the box: one of them is not there"
        if not box or min(gap for time, gap in self._gaps if time > box[0].time) < _UNTOUCHED:
            return ""
        places = np.array([one.position for one in box])
        moved = float(np.linalg.norm((places[-1] - places[0])[:2]))
        sd = np.sqrt(2.0 * _noise(places) ** 2 + _FACE**2)
        words = f"the box moves by {100.0 * moved:.1f} cm, and nothing touches it"
        return words if moved > self._gate * sd else ""

    def _gap(self, trunk: list[Seen], box: list[Seen]) -> tuple[float, float]:
        """Least and largest distance of the box from bumper and feet [m]; negative: they would be inside it.

        Between two states feet are where a line joins them, as uncertain as the trunk's way over them.
        """
        time = float(np.mean([one.time for one in box]))
        states = sorted(self._felt, key=lambda one: one.time)
        after = next((i for i, one in enumerate(states[1:], 1) if one.time >= time), len(states) - 1)
        one, other = states[after - 1], states[after]
        share = np.clip((time - one.time) / max(other.time - one.time, 1e-9), 0.0, 1.0)
        unfelt = _DRIVE * np.sqrt(max(other.blind - one.blind, 0.0) / 12.0)
        (place, turn), (centre, yaw) = (
            (np.mean([one.position for one in seen], axis=0), mean([one.orientation for one in seen]))
            for seen in (trunk, box)
        )
        points = np.vstack((_BUMPER, one.feet + share * (other.feet - one.feet)))
        points = rotate(turn, points) + place - centre
        outside = np.abs(rotate(conjugate(yaw), points)) - self._half
        flat = outside[:, :2]
        gaps = np.linalg.norm(np.maximum(flat, 0.0), axis=1) + np.minimum(flat.max(axis=1), 0.0) - _RADII
        beside = outside[:, 2] < _RADII
        off = self._gate * unfelt * (np.arange(len(gaps)) >= len(_BUMPER))
        least, largest = (float(np.min(each[beside], initial=np.inf)) for each in (gaps - off, gaps + off))
        return least, largest


def _at(time: float, times: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n, 3) at a time [s], joined by lines, shape (3,)."""
    return np.array([np.interp(time, times, column) for column in values.T])


def _noise(places: FloatArray) -> float:
    """The noise of positions (n, 3) of a camera that sees them move evenly [m], sd along an axis."""
    return float(np.sqrt(np.square(np.diff(places, n=2, axis=0)).mean() / 6.0))
