"""Pushing a box aside with a front leg while the other three stand (task T5).

The robot shifts its trunk over the triangle of the other feet, then lifts the leg (in the other order it
falls towards it), puts the foot to the middle of the box's face, and sweeps. A leg alone reaches 0.2 m: the
trunk leans after it and turns, always over that triangle. When all is done the foot comes back, and down:
four feet stand safer than three. Where the path goes on, the robot steps after the box and sweeps again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.robots.go1.behaviours.gait import (
    Gait,
    LegTargets,
    box_friction,
    contacts,
    ground_forces,
    leg_targets,
    neutral_feet,
    standing,
    walk,
)
from amhe_cli.robots.go1.behaviours.objective import (
    Course,
    Reference,
    SweepWeights,
    limited,
    sweep_terms,
)
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, feet
from amhe_cli.robots.go1.state import Body, Plane, State, wrapped

#: Places of the free leg among the four, and of the two at the ends of the long side of their triangle.
FREE, _FRONT, _REAR = 0, 1, 2
#: How far the trunk goes ahead and left, away from the free leg [m].
SHIFT = sealed([-0.05, 0.04])


def stand_on_three(
    gait: Gait,
    shape: SweepShape,
    time: ArrayLike,
    foot: ArrayLike,
    trunk: ArrayLike = (0.0, 0.0, 0.0),
    push: ArrayLike = (0.0, 0.0),
    trunk_now: ArrayLike | None = None,
    planted: FloatArray | None = None,
) -> LegTargets:
    """Shift the trunk, lift the leg, and from then on put the free foot where `foot` says.

    Places are in the frame of the trunk *before* the shift: that frame stays with the three feet. Those of
    the result are in the trunk's frame, as always.

    Args:
        gait: Height and servo gain; the rest is not used.
        shape: How fast the leg becomes free; the rest is not used.
        time: Time since the start of the shift [s], shape (...).
        foot: Place of the free foot [m], shape (..., 3).
        trunk: Further movement of the trunk: ahead, left [m], turn [rad], shape (..., 3).
        push: Force of the free foot on what it touches, ahead and left [N], shape (..., 2).
        trunk_now: Where the trunk really is: ahead, left [m], turn [rad], shape (3,). The free foot is
            placed, and the weight spread, as seen from there: a trunk that lags its target by a tenth of a
            radian would put the foot 3 cm astray. None: where it should be.
        planted: Where the feet stand [m], shape (4, 3); that of the free leg is where it is lifted from.
            None: they are neutral.
    """
    time, foot, trunk, push = (np.asarray(x, dtype=np.float64) for x in (time, foot, trunk, push))
    batch = np.broadcast_shapes(time.shape, foot.shape[:-1], trunk.shape[:-1], push.shape[:-1])
    shifted = _smooth(time / shape.shift_time)
    lifted = _smooth((time - shape.shift_time) / shape.lift_time)[..., None]
    planted = neutral_feet(gait) if planted is None else planted
    places = np.broadcast_to(planted, (*batch, 4, 3)).copy()
    places[..., FREE, :] += lifted * (foot - places[..., FREE, :])
    moved = shifted[..., None] * SHIFT + trunk[..., :2]
    feet = _from_trunk(places, np.broadcast_to(moved, (*batch, 2)), np.broadcast_to(trunk[..., 2], batch))
    seen = feet
    if trunk_now is not None:
        now = np.asarray(trunk_now, dtype=np.float64)
        seen = _from_trunk(places, now[:2], now[2])
        feet[..., FREE, :] = seen[..., FREE, :]

    load = np.ones((*batch, 4))
    load[..., FREE] = 1.0 - shifted
    height = gait.height + places[..., FREE, 2]
    push = np.broadcast_to(push, (*batch, 2))
    forces = ground_forces(gait, seen, load, push, height)
    # three feet carry the robot and push back on the floor; the free one has the push upon it
    free = load[..., FREE] == 0.0
    forces[..., FREE, :2] = np.where(free[..., None], -push, forces[..., FREE, :2])
    return leg_targets(gait, feet, np.zeros_like(feet), forces)


def support_margin(planted: FloatArray, trunk: FloatArray) -> float:
    """How far the trunk is inside the triangle of the other feet, from the side of the free leg [m].

    Args:
        planted: See `stand_on_three`, shape (4, 3).
        trunk: Place ahead and left of neutral [m], shape (2,) or more.
    """
    front, rear = planted[[_FRONT, _REAR], :2]
    along = (front - rear) / np.linalg.norm(front - rear)
    place = np.asarray(trunk)[:2] - rear
    return float(along[0] * place[1] - along[1] * place[0])


def _from_trunk(places: FloatArray, moved: FloatArray, turn: FloatArray) -> FloatArray:
    """Places (..., 4, 3) as a trunk sees them that has moved (..., 2) and turned (...) in their frame."""
    c, s = np.cos(turn)[..., None], np.sin(turn)[..., None]
    x, y = (places[..., i] - moved[..., None, i] for i in (0, 1))
    return np.stack((c * x + s * y, c * y - s * x, places[..., 2]), axis=-1)


def _smooth(share: FloatArray) -> FloatArray:
    """A smooth step from 0 to 1, clipped outside."""
    x = np.clip(share, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


#: The robot has stepped to its place when it is this near [m]; it then takes some last steps [s]. How far a
#: plan's own goal is ahead of the trunk [s].
_NEAR, _SETTLING, _PLANNED = 0.03, 0.5, 0.16
#: Noise of the channels: the foot's speed ahead and left [m/s], the trunk's place ahead and left [m] and
#: turn [rad], push to the left [N].
CHANNEL_SIGMA = sealed([0.03, 0.04, 0.004, 0.004, 0.03, 6.0])


@dataclass(frozen=True, slots=True)
class SweepShape:
    """How the leg sweeps, in the frame of the three standing feet: x ahead, y left.

    Args:
        shift_time: The trunk moves over the other three feet in this time [s].
        lift_time: The free foot then goes to its first place in this time [s].
        height: Height of the foot over the floor [m].
        clearance: Distance from foot to box when the foot is first put there [m].
        speed: Speed of foot and box [m/s].
        reach: The foot goes no further to the side than this [m].
        lean: Trunk at full reach: ahead and left of where the leg was lifted [m], and its turn [rad].
        lean_ahead: The trunk leans as if the foot were so much further along [m]: it lags its targets.
        lean_time: Time over which the lean sets in after the sweep has begun [s].
        back_first: How much earlier the trunk goes back than it leans aside: backwards is where the triangle
            is wide.
        lead: Time by which the foot's target leads the foot [s]: the servo's damping over its gain.
        yaw_gain: How far beside the box's middle to push, per turn of the box [m/rad], up to `yaw_limit` [m].
        path_gain: How much the box is turned back to its path, per distance from it [rad/m].
        leash: Largest distance of the foot's target from the foot [m]: so a soft servo pushes with little
            more than the force that the belief, and the plan's channel, demand.
        back_leash: The same as `leash`, on the way back [m].
        margin: Nearer to the edge of the three feet's triangle than this, the trunk first comes back [m].
        longest: The sweep, and the way to the next one, are given up after this time [s].
        return_speed: Speed with which the foot comes back when all is done [m/s].
        back: The foot is set down when it is this near to where it began [m].
        set_down: Speed with which the foot is set down [m/s].
        slip_time: Time constant with which the places of slipped feet are updated [s]: legs that pull feet
            back to where they stood make them slip on, and the trunk no longer follows its lean.
        touching: Distance from foot to box below which the box is to move [m].
        sweeps: How often the leg sweeps at most: a box that is left beyond its reach is walked after.
        aside: Speed of the steps to where the next sweep begins [m/s].
    """

    shift_time: float = 1.0
    lift_time: float = 0.6
    height: float = 0.14
    clearance: float = 0.01
    speed: float = 0.08
    reach: float = 0.5
    lean: tuple[float, float, float] = (-0.11, -0.08, -0.65)
    lean_ahead: float = 0.05
    lean_time: float = 0.6
    back_first: float = 1.6
    lead: float = 0.06
    yaw_gain: float = 0.3
    yaw_limit: float = 0.05
    path_gain: float = 3.0
    leash: float = 0.004
    back_leash: float = 0.02
    margin: float = 0.03
    longest: float = 8.0
    return_speed: float = 0.1
    back: float = 0.03
    set_down: float = 0.1
    slip_time: float = 1.0
    touching: float = 0.015
    sweeps: int = 3
    aside: float = 0.12


@dataclass(frozen=True, slots=True, eq=False)
class SweepMove:
    """Sweeping from one situation; see `Move`. Places are in the frame of the standing feet.

    Args:
        owner: The behaviour that made the move, for all that does not change.
        foot: Where the free foot is, or is to be put first [m], shape (3,).
        trunk_now: Where the trunk is: ahead, left [m], turn [rad], shape (3,); None before the sweep, when
            the command does nothing.
        planted: Where the feet stand [m], shape (4, 3).
        lean: Where the trunk should be: place in the world [m] and heading [rad], shape (3,).
        reference: What robot and box should do.
        command: A command, in the order of `CHANNEL_SIGMA`, shape (6,); ahead, left [m/s] and yaw rate
            [rad/s] first while the robot steps aside.
    """

    owner: Sweeping
    foot: FloatArray
    trunk_now: FloatArray | None
    planted: FloatArray
    lean: FloatArray
    reference: Reference
    command: FloatArray

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        """See `Move`."""
        owner = self.owner
        if owner.steps(self.reference.time):
            still = np.zeros((len(commands), 1, 2))
            return walk(owner.trot, times[None], commands[:, None, :3], still, np.zeros(4)).targets
        times = times - owner.begun
        if self.trunk_now is None:
            commands = np.zeros_like(commands)
        elapsed = times + owner.begun - self.reference.time + owner.shape.lead
        foot = np.broadcast_to(self.foot, (len(commands), times.size, 3)).copy()
        foot[..., :2] += elapsed[:, None] * commands[:, None, :2]
        foot[..., 1] = np.maximum(foot[..., 1], -owner.shape.reach - owner.shape.back_leash)
        trunk = owner.lean(times, foot[..., 1]) + commands[:, None, 2:5]
        push = np.zeros((len(commands), 1, 2))
        push[:, 0, 1] = np.minimum(commands[:, 5], 0.0)
        return stand_on_three(
            owner.gait, owner.shape, times[None], foot, trunk, push, self.trunk_now, self.planted
        ).targets

    def terms(self, times: FloatArray, bodies: tuple[Body, Body]) -> dict[str, FloatArray]:
        """See `Move`."""
        (trunk, box), owner = bodies, self.owner
        off = ((trunk.position[..., :2] - self.lean[:2]) ** 2).sum(axis=-1)
        return sweep_terms(owner.weights, trunk, box, owner.trunk_height, self.reference) | {
            "trunk_place": owner.weights.trunk_place * off,
            "trunk_turn": owner.weights.trunk_turn * wrapped(trunk.yaw - self.lean[2]) ** 2,
        }


@dataclass(slots=True, eq=False)
class Sweeping:
    """The behaviour of T5; see `control.protocols.Behaviour`.

    Remembers where the three feet were put and have slipped to, where the sweep began, the foot's
    last target, and how far the foot has been lowered since it came back.

    Args:
        half_width: Distance from the box's middle to the face that is pushed [m].
        taper: Last distance of the path over which the speed goes to zero [m].
        gait: Shape of the stance.
        shape: How the leg becomes free, and sweeps.
        trunk_height: Desired height of the trunk [m].
        begun: When the present sweep's shift of the trunk begins, or the next one's [s].
    """

    path: Course
    half_width: float
    taper: float = 0.05
    gait: Gait = field(default_factory=lambda: standing(Gait()))
    shape: SweepShape = field(default_factory=SweepShape)
    weights: SweepWeights = field(default_factory=SweepWeights)
    trunk_height: float = 0.27
    begun: float = 0.0
    _sweeps: int = 0
    _latest: float = 0.0
    _stance: Plane | None = None
    _planted: FloatArray = field(init=False)
    _start_y: float = 0.0
    _over: bool = False
    _target_y: float = 0.0
    _lowered: float = 0.0
    _last_time: float = 0.0
    _beside: FloatArray = field(default_factory=lambda: np.zeros(2))
    _goal: FloatArray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        self._planted = neutral_feet(self.gait)

    channel_sigma = CHANNEL_SIGMA

    @property
    def knot_weight(self) -> float:
        """See `Behaviour`."""
        return self.weights.knots

    @property
    def trot(self) -> Gait:
        """How the robot steps aside."""
        return replace(self.gait, duty=Gait().duty)

    def steps(self, time: float) -> bool:
        """Whether the robot steps aside at a time [s], before its next sweep."""
        return time < self.begun

    def switches(self, start: float, end: float) -> bool:
        """See `Behaviour`. The trot's rhythm is kept for the refinement while nobody steps."""
        half = 0.5 * self.gait.period
        return int(end / half) > int(start / half)

    def standing(self, times: FloatArray) -> BoolArray:
        """Which feet should stand at times [s] (...), shape (..., 4)."""
        stands = np.ones((*np.shape(times), 4), dtype=np.bool_)
        stands[..., FREE] = times < self.begun + self.shape.shift_time
        return np.where((times < self.begun)[..., None], contacts(self.trot, times), stands)

    def move(self, state: State, belief: Mapping[str, float]) -> SweepMove:
        """See `Behaviour`."""
        at = self._reference(state)
        if self._lowered >= self.shape.height and self._sweeps + 1 < self.shape.sweeps and at.speed > 0.0:
            self._begin_again(state)
        if self.steps(state.time):
            return self._step_aside(state, at)
        if self._stance is None:
            self._stance = Plane.under(state.trunk.position, state.trunk.orientation)
            if not self._sweeps:
                self._beside = (state.box.position - state.trunk.position)[:2]
        line, face = self._contact(self._stance, state.box)
        face -= belief.get("face_overlap", 0.0)
        begun = state.time - self._begin
        if begun < 0.0:
            return self._prepare(self._stance, state, line, face, at)
        seen, passed = self._see_feet(self._stance, state), state.time - self._last_time
        self._follow(seen, passed)
        foot = np.array([line, seen[FREE, 1], self.shape.height - self.gait.height])
        trunk = self._stance.pose(state.trunk)
        s = self.shape
        self._over |= begun > s.longest or foot[1] < -s.reach or at.speed == 0.0
        speed, push = self._pace(trunk, foot[1], face, at.speed, box_friction(belief))
        self._last_time = state.time
        if self._over and self._start_y - foot[1] < self.shape.back:
            self._lowered = min(self._lowered + self.shape.set_down * passed, self.shape.height)
        foot[2] -= self._lowered
        foot[1] = self._target_y = self._aim(passed, foot[1], speed)
        lean = self._lean_in_world(self._stance, state.time, foot[1])
        command = np.array([0.0, -speed, 0.0, 0.0, 0.0, -push])
        at = replace(at, speed=max(speed, 0.0))
        return SweepMove(self, foot, trunk, self._planted, lean, at, command)

    @property
    def _begin(self) -> float:
        """Time at which the sweep begins [s]."""
        return self.begun + self.shape.shift_time + self.shape.lift_time

    def _begin_again(self, state: State) -> None:
        """Step after the box, until it stands beside the robot as it did at first; then sweep once more."""
        self._goal = state.box.position[:2] - self._beside
        self.begun, self._latest = state.time + _SETTLING, state.time + self.shape.longest
        self._stance, self._planted, self._sweeps = None, neutral_feet(self.gait), self._sweeps + 1
        self._over, self._lowered = False, 0.0

    def _step_aside(self, state: State, at: Reference) -> SweepMove:
        """Trot to where the next sweep begins."""
        limit, turn = self.shape.aside, state.trunk.yaw
        missing = self._goal - state.trunk.position[:2]
        if np.abs(missing).max() > _NEAR:
            self.begun = min(state.time + _SETTLING, self._latest)
        speed = np.clip(2.0 * missing, -limit, limit)
        in_trunk = Plane(np.zeros(2), turn).place(np.array([*speed, 0.0]))[:2]
        command = np.array([*in_trunk, limited(-3.0 * turn, 0.4), 0.0, 0.0, 0.0])
        ahead = np.array([*(state.trunk.position[:2] + _PLANNED * speed), 0.0])
        return SweepMove(self, np.zeros(3), None, self._planted, ahead, replace(at, speed=0.0), command)

    def _contact(self, stance: Plane, box: Body) -> tuple[float, float]:
        """Where to push: the push's line, and where the middle of a foot is that touches the face [m]."""
        s, place = self.shape, stance.place(box.position)
        astray = self.path.place(box.position[:2]).left
        aside = limited(s.yaw_gain * (stance.turn(box) + s.path_gain * astray), s.yaw_limit)
        return float(place[0]) + aside, float(place[1]) + self.half_width + FOOT_RADIUS

    def _prepare(self, stance: Plane, state: State, line: float, face: float, at: Reference) -> SweepMove:
        """Shift the trunk, lift the leg, and put the foot beside the box."""
        ready = np.array([line, face + self.shape.clearance, self.shape.height - self.gait.height])
        self._start_y, self._target_y, self._last_time = ready[1], ready[1], state.time
        lean = self._lean_in_world(stance, state.time, ready[1])
        return SweepMove(self, ready, None, self._planted, lean, at, np.zeros(6))

    def _pace(
        self, trunk: FloatArray, y: float, face: float, commanded: float, friction: float
    ) -> tuple[float, float]:
        """Speed of the foot to the right [m/s], negative on its way back, and its force on the box [N]."""
        s = self.shape
        if self._over:
            return -min(max(self._start_y - y, 0.0), s.return_speed), 0.0
        if support_margin(self._planted, trunk) < s.margin:
            return 0.0, 0.0
        return commanded, friction if y - face < s.touching else 0.0

    def running_cost(self, state: State) -> dict[str, float]:
        """Terms of the running cost of a realised state, measured against the task's fixed path."""
        at = self._reference(state)
        terms = sweep_terms(self.weights, state.trunk, state.box, self.trunk_height, at)
        return {name: float(term) for name, term in terms.items()}

    def lean(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """How the trunk has leant and turned when the free foot is at y [m] (...), shape (..., 3)."""
        s = self.shape
        since = times - self.shape.shift_time - self.shape.lift_time
        begun = np.clip(since / s.lean_time, 0.0, 1.0)
        gone = begun * (self._start_y + s.lean_ahead - y) / max(self._start_y + s.reach, 0.05)
        back, rest = np.clip(s.back_first * gone, 0.0, 1.0), np.clip(gone, 0.0, 1.0)
        return np.stack((s.lean[0] * back, s.lean[1] * rest, s.lean[2] * rest), axis=-1)

    def _lean_in_world(self, stance: Plane, time: float, y: float) -> FloatArray:
        time -= self.begun
        lean = self.lean(np.array(time), np.array(y))
        lean[:2] += min(1.0, time / self.shape.shift_time) * SHIFT
        return stance.in_world(lean)

    def _aim(self, passed: float, y: float, speed: float) -> float:
        """Where the foot's target is [m]: it goes at the speed, but not far ahead of the foot itself.

        It gives way to a foot that is held up, or thrown back, no faster than the foot comes back: the trunk
        leans by it, and would unwind with a foot that has slipped.
        """
        leash = self.shape.back_leash if self._over else self.shape.leash
        wanted = self._target_y - speed * passed
        return float(max(wanted, min(y - leash, self._target_y + self.shape.return_speed * passed)))

    def _reference(self, state: State) -> Reference:
        place = self.path.place(state.box.position[:2])
        speed = self.shape.speed * self.path.tapered(place.progress, self.taper)
        speed, origin = speed * (state.time >= self._begin), self.path.nearest(state.box.position[:2], place)
        across = self.path.heading + 0.5 * np.pi
        return Reference(state.time, speed, origin, place.heading, yaw=0.0, box_yaw=across)

    def _see_feet(self, stance: Plane, state: State) -> FloatArray:
        """All feet in the frame of the standing ones [m], shape (4, 3)."""
        from_trunk = rotations.rotate(state.trunk.orientation, feet(state.joints))
        return np.array([stance.place(state.trunk.position + foot) for foot in from_trunk])

    def _follow(self, seen: FloatArray, passed: float) -> None:
        """Update where the standing feet are after they have slipped; they stay on the floor."""
        share = np.full((4, 1), min(1.0, passed / self.shape.slip_time))
        share[FREE] = 0.0
        self._planted = self._planted + share * (seen - self._planted) * (1.0, 1.0, 0.0)
