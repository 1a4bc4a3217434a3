"""Pushing a box aside with a front leg while the other three stand (task T5).

The robot shifts its trunk, lifts the leg, puts the foot to the middle of the box's face, and sweeps. A leg
alone reaches 0.2 m: the trunk leans after it and turns, always over the triangle of the other feet.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.control.gait import Gait, standing
from amhe_cli.control.objective import Reference, SweepWeights, lean_terms, sweep_terms, wrapped, yaw_of
from amhe_cli.control.path import Path
from amhe_cli.control.tripod import Tripod, stand_on_three, support_margin
from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.go1.legs import FOOT_RADIUS, feet
from amhe_cli.go1.state import Body, State

#: Noise of the channels: the foot's speed ahead and left [m/s], the trunk's place ahead and left [m] and
#: turn [rad], push to the left [N].
CHANNEL_SIGMA = sealed([0.03, 0.04, 0.004, 0.004, 0.03, 6.0])


@dataclass(frozen=True, slots=True)
class SweepShape:
    """How the leg sweeps, in the frame of the three standing feet: x ahead, y left.

    Args:
        height: Of the foot over the floor [m].
        clearance: From foot to box when the foot is first put there [m].
        speed: Of foot and box [m/s].
        reach: The foot goes no further to the side than this [m].
        lean: Where the trunk is by then, ahead and left of where it lifted the leg [m], and its turn [rad].
        lean_ahead: The trunk leans as if the foot were so much further [m]: it lags its targets.
        lean_time: From the sweep's begin, the lean comes in this time [s].
        back_first: How much earlier the trunk goes back than it leans aside: backwards is where the triangle
            is wide.
        lead: The foot's target is where it would be so much later [s]: the servo's damping over its gain.
        yaw_gain: How far beside the box's middle to push, per turn of the box [m/rad], up to `yaw_limit` [m].
        leash: The foot's target is never further from the foot than this [m]: a soft servo pushes with little
            more than the force that the belief, and the plan's channel, ask of it.
        kick_leash: The same in the kick, and on the way back [m].
        kick: Speed over the last `kick_length` [m] of the reach [m/s]: the box slides on by itself.
        margin: Nearer to the edge of the three feet's triangle than this, the trunk first comes back [m].
        longest: The sweep is given up after this time [s].
        return_speed: With which the foot comes back when all is done [m/s].
        touching: Distance from foot to box below which the box is to move [m].
    """

    height: float = 0.14
    clearance: float = 0.01
    speed: float = 0.08
    reach: float = 0.57
    lean: tuple[float, float, float] = (-0.11, -0.08, -0.65)
    lean_ahead: float = 0.05
    lean_time: float = 0.6
    back_first: float = 1.6
    lead: float = 0.06
    yaw_gain: float = 0.3
    yaw_limit: float = 0.05
    leash: float = 0.004
    kick_leash: float = 0.04
    kick: float = 0.3
    kick_length: float = 0.08
    margin: float = 0.03
    longest: float = 12.0
    return_speed: float = 0.1
    touching: float = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class SweepMove:
    """Sweeping from one situation; see `behaviour.Move`. Places are in the frame of the standing feet.

    Args:
        owner: What does not change.
        foot: Where the free foot is, or is to be put first [m], shape (3,).
        trunk_now: Where the trunk is: ahead, left [m], turn [rad], shape (3,); None before the sweep, when
            the command does nothing.
        lean: Where the trunk should be: place in the world [m] and heading [rad], shape (3,).
        reference: What is wanted.
        command: See `CHANNEL_SIGMA`, shape (6,).
    """

    owner: Sweeping
    foot: FloatArray
    trunk_now: FloatArray | None
    lean: FloatArray
    reference: Reference
    command: FloatArray

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        """See `behaviour.Move`."""
        owner = self.owner
        if self.trunk_now is None:
            commands = np.zeros_like(commands)
        elapsed = times - self.reference.time + owner.shape.lead
        foot = np.broadcast_to(self.foot, (len(commands), times.size, 3)).copy()
        foot[..., :2] += elapsed[:, None] * commands[:, None, :2]
        foot[..., 1] = np.maximum(foot[..., 1], -owner.shape.reach - owner.shape.kick_leash)
        trunk = owner.lean(times, foot[..., 1]) + commands[:, None, 2:5]
        push = np.zeros((len(commands), 1, 2))
        push[:, 0, 1] = np.minimum(commands[:, 5], 0.0)
        return stand_on_three(
            owner.gait, owner.tripod, times[None], foot, trunk, push, self.trunk_now
        ).targets

    def terms(self, times: FloatArray, trunk: Body, box: Body, joints: FloatArray) -> dict[str, FloatArray]:
        """See `behaviour.Move`."""
        owner = self.owner
        terms = sweep_terms(owner.weights, trunk, box, owner.trunk_height, self.reference)
        return terms | lean_terms(owner.weights, trunk, self.lean)


@dataclass(slots=True, eq=False)
class Sweeping:
    """The behaviour of T5; see `behaviour.Behaviour`. Remembers where the three feet were put.

    Args:
        path: Of the box.
        half_width: Of the box, from its middle to the face that is pushed [m].
        taper: Last distance of the path over which the speed goes to zero [m].
        gait, tripod: Of the stance.
        shape: Of the sweep.
        weights: Of the cost.
        trunk_height: That is wanted [m].
    """

    path: Path
    half_width: float
    taper: float = 0.05
    gait: Gait = field(default_factory=lambda: standing(Gait()))
    tripod: Tripod = field(default_factory=Tripod)
    shape: SweepShape = field(default_factory=SweepShape)
    weights: SweepWeights = field(default_factory=SweepWeights)
    trunk_height: float = 0.27
    _stance: tuple[FloatArray, float] | None = None
    _start: float = 0.0
    _over: bool = False
    _y: float = 0.0
    _time: float = 0.0

    @property
    def channel_sigma(self) -> FloatArray:
        """See `behaviour.Behaviour`."""
        return CHANNEL_SIGMA

    @property
    def knot_weight(self) -> float:
        """See `behaviour.Behaviour`."""
        return self.weights.knots

    def switches(self, start: float, end: float) -> bool:
        """See `behaviour.Behaviour`. Nobody steps: the trot's rhythm is kept for the refinement."""
        half = 0.5 * self.gait.period
        return int(end / half) > int(start / half)

    def standing(self, times: FloatArray) -> BoolArray:
        """See `behaviour.Behaviour`."""
        stands = np.ones((*np.shape(times), 4), dtype=np.bool_)
        stands[..., self.tripod.index] = times < self.tripod.shift_time
        return stands

    def move(self, state: State, resistance: float) -> SweepMove:
        """See `behaviour.Behaviour`."""
        _, yaw = self._frame(state)
        box, box_yaw = self._from_stance(state.box.position), yaw_of(state.box.orientation) - yaw
        s = self.shape
        turn = np.clip(s.yaw_gain * wrapped(box_yaw), -s.yaw_limit, s.yaw_limit)
        line = box[0] + float(turn)
        face = box[1] + self.half_width + FOOT_RADIUS
        ready = np.array([line, face + s.clearance, s.height - self.gait.height])
        begun = state.time - (self.tripod.shift_time + self.tripod.lift_time)
        at = self._reference(state)
        if begun < 0.0:
            self._start, self._y, self._time = ready[1], ready[1], state.time
            return SweepMove(self, ready, None, self._lean_in_world(state.time, ready[1]), at, np.zeros(6))
        foot = self._foot(state)
        foot[2] = ready[2]
        foot[0] = line
        trunk = self._from_stance(state.trunk.position)
        trunk[2] = wrapped(yaw_of(state.trunk.orientation) - yaw)
        self._over |= foot[1] < -s.reach or at.speed == 0.0 or begun > s.longest
        speed, push = at.speed, 0.0
        if self._over:
            speed = -float(np.clip(self._start - foot[1], 0.0, s.return_speed))
        elif support_margin(self.gait, self.tripod, trunk) < s.margin:
            speed = 0.0
        elif foot[1] - face < s.touching:
            push = resistance
            if foot[1] < s.kick_length - s.reach:
                speed = s.kick
        at = replace(at, speed=max(speed, 0.0))
        foot[1] = self._y = self._aim(state.time, foot[1], speed)
        lean = self._lean_in_world(state.time, foot[1])
        return SweepMove(self, foot, trunk, lean, at, np.array([0.0, -speed, 0.0, 0.0, 0.0, -push]))

    def running_cost(self, state: State) -> dict[str, float]:
        """See `behaviour.Behaviour`."""
        at = self._reference(state)
        terms = sweep_terms(self.weights, state.trunk, state.box, self.trunk_height, at)
        return {name: float(term) for name, term in terms.items()}

    def lean(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """How the trunk has leant and turned when the free foot is at y [m] (...), shape (..., 3)."""
        s = self.shape
        begun = np.clip((times - self.tripod.shift_time - self.tripod.lift_time) / s.lean_time, 0.0, 1.0)
        gone = begun * (self._start + s.lean_ahead - y) / max(self._start + s.reach, 0.05)
        back, rest = np.clip(s.back_first * gone, 0.0, 1.0), np.clip(gone, 0.0, 1.0)
        return np.stack((s.lean[0] * back, s.lean[1] * rest, s.lean[2] * rest), axis=-1)

    def _lean_in_world(self, time: float, y: float) -> FloatArray:
        shifted = min(1.0, time / self.tripod.shift_time)
        ahead, left, turn = self.lean(np.array(time), np.array(y))
        ahead, left = np.array([ahead, left]) + shifted * self.tripod.shift
        origin, yaw = self._stance if self._stance is not None else (np.zeros(2), 0.0)
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([origin[0] + c * ahead - s * left, origin[1] + s * ahead + c * left, yaw + turn])

    def _aim(self, time: float, y: float, speed: float) -> float:
        """Where the foot's target is [m]: it goes at the speed, but not far from the foot itself."""
        gone, self._time = speed * (time - self._time), time
        leash = self.shape.kick_leash if speed == self.shape.kick or self._over else self.shape.leash
        return float(np.clip(self._y - gone, y - leash, y + leash))

    def _reference(self, state: State) -> Reference:
        place = self.path.place(state.box.position[:2])
        share = np.clip((self.path.length - place.progress) / self.taper, 0.0, 1.0)
        started = state.time >= self.tripod.shift_time + self.tripod.lift_time
        left = place.left * np.array([-np.sin(place.heading), np.cos(place.heading)])
        return Reference(
            time=state.time,
            speed=float(self.shape.speed * share) * started,
            origin=state.box.position[:2] - left,
            heading=float(place.heading),
            yaw=0.0,
            box_yaw=self.path.heading + 0.5 * np.pi,
        )

    def _foot(self, state: State) -> FloatArray:
        """The free foot in the frame of the standing feet [m], shape (3,)."""
        own = feet(state.joints)[self.tripod.index]
        return self._from_stance(state.trunk.position + rotations.rotate(state.trunk.orientation, own))

    def _frame(self, state: State) -> tuple[FloatArray, float]:
        if self._stance is None:
            self._stance = np.array(state.trunk.position[:2]), float(yaw_of(state.trunk.orientation))
        return self._stance

    def _from_stance(self, point: FloatArray) -> FloatArray:
        origin, yaw = self._stance if self._stance is not None else (np.zeros(2), 0.0)
        d, c, s = point[:2] - origin, np.cos(yaw), np.sin(yaw)
        return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], point[2]])
