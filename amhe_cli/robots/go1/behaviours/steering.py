"""Where to push next so that the box follows its path: the layer between the task's path and the planner.

A box that is pushed at its middle goes straight on and turns as it likes. It is steered by where on its face
it is pushed: right of the middle turns it left. The robot follows the box's yaw rather than the path, or it
slides to a corner; where it has lost the face, it backs off, comes in line again, and returns.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.course import Course, Place
from amhe_cli.robots.go1.behaviours.objective import Reference, bumper_from_box, wrapped
from amhe_cli.robots.go1.state import State, heading_velocity

#: Longest time that one cycle integrates over, after a pause too [s].
_LONGEST = 0.05


@dataclass(slots=True, eq=False)
class Pacing:
    """How much more speed to command: soft feet, slip and gears make a robot slower than its model.

    The planner does not know of it. So the missing share of the speed is integrated, as offset-free MPC does
    with disturbances that its model lacks (Maeder, Borrelli and Morari 2009).

    Args:
        gain: Integral gain [1/s], slower than any stride.
        free: Missing share that is ignored, because the mean of a pulsing speed wanders by as much; nothing
            is ignored while the correction goes the wrong way.
        smoothing: Time over which the speed is averaged [s].
        limit: Greatest correction, as a share of the commanded speed.
        share: Present correction, as a share of the commanded speed.
    """

    gain: float = 0.6
    free: float = 0.1
    smoothing: float = 0.5
    limit: float = 0.4
    share: float = 0.0
    _missing: float = 0.0
    _time: float | None = None

    def update(self, time: float, missing: float) -> None:
        """Integrate over one cycle of pushing.

        Args:
            time: Present time [s].
            missing: Missing share of the commanded speed.
        """
        passed = 0.0 if self._time is None else min(max(time - self._time, 0.0), _LONGEST)
        self._time = time
        self._missing += (missing - self._missing) * passed / self.smoothing
        beyond = self._missing
        if self._missing * self.share >= 0.0:
            beyond -= float(np.clip(self._missing, -self.free, self.free))
        self.share = float(np.clip(self.share + self.gain * passed * beyond, -self.limit, self.limit))


@dataclass(slots=True, eq=False)
class Insisting:
    """How much harder to push a box that stands although it should move: less friction was believed.

    Args:
        gain: Growth of the share [1/s] while the box stands, and its fall once it moves.
        limit: Greatest share of the push and the speed that is added.
        least: The box stands if it goes less than this share of its way in `window` [s].
        share: Present share.
    """

    gain: float = 0.4
    limit: float = 0.8
    least: float = 0.25
    window: float = 1.0
    share: float = 0.0
    _seen: deque[tuple[float, float]] = field(default_factory=deque)

    def update(self, time: float, progress: float, speed: float) -> None:
        """Take in how far the box has come along its path [m], and how fast it should go [m/s]."""
        passed = min(time - self._seen[-1][0], _LONGEST) if self._seen else 0.0
        self._seen.append((time, progress))
        while self._seen[0][0] < time - self.window:
            self._seen.popleft()
        begun, first = self._seen[0]
        known = time - begun > 0.9 * self.window
        stands = known and progress - first < self.least * speed * (time - begun)
        self.share = float(
            np.clip(self.share + passed * (self.gain if stands else -self.gain), 0.0, self.limit)
        )

    def rest(self) -> None:
        """The box is not pushed."""
        self._seen.clear()


@dataclass(frozen=True, slots=True)
class Steering:
    """Gains of the steering.

    Args:
        path_gain: How much the heading turns back to the path, per distance from it [rad/m], up to
            `path_limit` [rad].
        ahead: The box is turned to where its path will lead this much later [m].
        offset_gain: How far beside the box's middle to push, per missing turn of the box [m/rad], up to
            `offset_limit` [m].
        yaw_limit: How far the robot's yaw may lead the box's [rad].
        touching: Distance from bumper to box below which the box is to move [m].
        lead: The planner aims at this much more than the commanded speed: a box moves in pulses, and the
            quadratic cost of a pulsing speed is least below its mean.
        creep: The planner's aim is no slower than this [m/s] until the box is `enough` [m] before the goal:
            a box that is pushed ever more slowly sticks.
    """

    path_gain: float = 1.5
    path_limit: float = 0.5
    ahead: float = 0.15
    offset_gain: float = 1.0
    offset_limit: float = 0.12
    yaw_limit: float = 0.2
    touching: float = 0.015
    lead: float = 1.1
    creep: float = 0.08
    enough: float = 0.01


@dataclass(frozen=True, slots=True)
class Retreat:
    """When the bumper has lost the box's face, and when it has found it again.

    Args:
        lost_left: The face is lost when the bumper's middle is this far outside the box's edge [m].
        lost_turn: The face is lost when the robot's yaw differs this much from the box's [rad].
        clear: Distance to which the robot backs off [m].
        speed: Speed backwards [m/s].
        aligned_left, aligned_turn: The robot may come back when it is aligned this well [m], [rad].
    """

    lost_left: float = 0.02
    lost_turn: float = 0.6
    clear: float = 0.10
    speed: float = 0.15
    aligned_left: float = 0.04
    aligned_turn: float = 0.12


class Helm:
    """Turns states into references; remembers whether the robot is backing off, and how slow it is.

    Args:
        path: Path of the box.
        speed: Commanded speed [m/s].
        taper: Last distance of the path over which the speed goes to zero [m].
        half_length, half_width: Half the extent of the box along and across the push [m].
        steering, retreat: Gains and thresholds.
    """

    def __init__(
        self,
        path: Course,
        speed: float,
        taper: float,
        half_length: float,
        half_width: float,
        steering: Steering = Steering(),
        retreat: Retreat = Retreat(),
    ) -> None:
        self._path, self._speed, self._taper = path, speed, taper
        self._half_length, self._half_width = half_length, half_width
        self._steering, self._retreat, self._pacing, self._insisting = (
            steering,
            retreat,
            Pacing(),
            Insisting(),
        )
        self.retreating = False

    def on_path(self, state: State) -> Reference:
        """The fixed path reference: what the task demands, whether or not it can be done."""
        return self._on_path(state, self._path.place(state.box.position[:2]))

    def _on_path(self, state: State, place: Place) -> Reference:
        heading = float(place.heading)
        return Reference(
            time=state.time,
            speed=self._speed * self._path.tapered(place.progress, self._taper),
            origin=self._path.nearest(state.box.position[:2], place),
            heading=heading,
            yaw=heading,
            box_yaw=heading,
        )

    def reference(self, state: State) -> Reference:
        """What the controller is to do now."""
        place, s = self._path.place(state.box.position[:2]), self._steering
        path = self._on_path(state, place)
        normal = np.array([-np.sin(path.heading), np.cos(path.heading)])
        astray = float(normal @ (state.box.position[:2] - path.origin))
        back = float(np.clip(s.path_gain * astray, -s.path_limit, s.path_limit))
        heading = path.heading + self._path.curvature * s.ahead - back
        box_yaw = float(yaw_of(state.box.orientation))
        missing = float(wrapped(heading - box_yaw))
        offset = -float(np.clip(s.offset_gain * missing, -s.offset_limit, s.offset_limit))
        yaw = box_yaw + float(np.clip(missing, -s.yaw_limit, s.yaw_limit))
        speed = self._aim(path.speed, float(place.progress))
        wanted = replace(
            path,
            speed=speed,
            turn=speed * self._path.curvature,
            heading=heading,
            yaw=yaw,
            box_yaw=heading,
            offset=offset,
        )
        gap, left = self.gap(state)
        self._judge(gap, left - offset, left, float(wrapped(yaw_of(state.trunk.orientation) - box_yaw)))
        if self.retreating:
            return replace(wanted, speed=self._retreat_speed(gap), turn=0.0, yaw=box_yaw, pushing=0.0)
        touching = gap < s.touching
        if touching and path.speed == self._speed:  # not while the commanded speed falls
            self._pacing.update(state.time, 1.0 - float(heading_velocity(state.trunk)[0]) / self._speed)
        if touching and speed > 0.0:
            self._insisting.update(state.time, float(place.progress), speed)
        else:
            self._insisting.rest()
        more = self._insisting.share
        return replace(wanted, pushing=float(touching), speed=(1.0 + more) * speed, harder=more)

    def _aim(self, commanded: float, progress: float) -> float:
        s = self._steering
        if self._path.length - progress <= s.enough:
            return 0.0
        return (1.0 + self._pacing.share) * max(s.lead * commanded, s.creep)

    def gap(self, state: State) -> tuple[float, float]:
        """Distance from bumper to the box's face, and the bumper's middle left of the box's [m]."""
        ahead, left = bumper_from_box(state.trunk, state.box)
        return -self._half_length - float(ahead), float(left)

    def _judge(self, gap: float, misplaced: float, left: float, turn: float) -> None:
        """Enter or leave the retreat."""
        r = self._retreat
        if abs(left) > self._half_width + r.lost_left or abs(turn) > r.lost_turn:
            self.retreating = True
        elif abs(misplaced) < r.aligned_left and abs(turn) < r.aligned_turn and gap > 0.5 * r.clear:
            self.retreating = False

    def _retreat_speed(self, gap: float) -> float:
        return -self._retreat.speed if gap < self._retreat.clear else 0.0
