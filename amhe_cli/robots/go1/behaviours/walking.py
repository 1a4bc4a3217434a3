"""Walking behind a box and pushing it (tasks T1-T4, hw1, hw2): where to push, joint targets and costs.

A box that is pushed at its middle goes straight on and turns as it likes. It is steered by where on its face
it is pushed: right of the middle turns it left. The robot follows the box's yaw rather than the path, or it
slides to a corner; where it has lost the face, it backs off, comes in line again, and returns.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import cos, exp, hypot, log, sin, sqrt

import numpy as np

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.robots.go1.behaviours.gait import WEIGHT, Gait, box_friction, contacts, switches, walk
from amhe_cli.robots.go1.behaviours.objective import (
    Course,
    PushWeights,
    Reference,
    bumper_from_box,
    limited,
    push_terms,
)
from amhe_cli.robots.go1.state import GRAVITY, Body, ModelLayout, State, heading_velocity, wrapped

#: Commanded speed along the path [m/s], and the last part of the path over which it goes to zero [m].
SPEED, TAPER = 0.2, 0.2
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
            beyond -= limited(self._missing, self.free)
        self.share = limited(self.share + self.gain * passed * beyond, self.limit)


@dataclass(slots=True, eq=False)
class Insisting:
    """How much harder to push a box that stands although it should move: less friction was believed.

    Args:
        gain: Growth of the share [1/s] while the box stands, and its fall while it moves.
        limit: Greatest share of the push and the speed that is added.
        least: The box stands below this share of its speed.
        share: Present share.
    """

    gain: float = 0.4
    limit: float = 0.8
    least: float = 0.25
    share: float = 0.0
    _time: float = np.inf

    def update(self, time: float, reached: float, speed: float) -> None:
        """Take in how fast the pushed box goes, and how fast it should go [m/s]."""
        passed, self._time = min(max(time - self._time, 0.0), _LONGEST), time
        more = passed * (self.gain if reached < self.least * speed else -self.gain)
        self.share = min(max(self.share + more, 0.0), self.limit)


@dataclass(frozen=True, slots=True)
class _Expected:
    """The trunk's speed [m/s] that a plan expects at a time [s], its force [N], and `Reflex.wrong` then."""

    time: float
    speed: float
    pushed: float
    wrong: float


@dataclass(slots=True, eq=False)
class Reflex:
    """Corrects the believed friction as soon as the trunk is slower, or faster, than plans expected.

    What a plan expects of the trunk's speed is compared `lead` later. The missing momentum is that of a force
    that the belief lacks, beside what plans pushed with meanwhile. Either the belief is right and the
    difference is noise, or box or floor has changed and the missing force has sd `spread`. The correction is
    the missing force times the probability of the latter (Bayes). Nothing is corrected before the bumper
    touches the box, or while the box is to stand: it resists by as much as it is pushed then.

    Args:
        at: The planner's model.
        lead: How far ahead speeds are compared [s].
        least: Least speed that plans expect of a box that is to move [m/s].
        noise: Sd of the speed from what was expected under the right belief [m/s].
        spread: Sd of the missing force under a wrong one [N].
        most: Largest force that is added [N].
        left: Least share of the believed force that is left.
        rate: How often box or floor change [1/s].
        lasting: What is left, from one comparison to the next, of the probability that the belief is wrong.
        mass: Mass of the robot [kg].
        wrong: That probability; 1 of a box that was never touched.
    """

    at: ModelLayout
    lead: float = 0.12
    least: float = 0.1
    noise: float = 0.03
    spread: float = 20.0
    most: float = 40.0
    left: float = 0.2
    rate: float = 0.1
    lasting: float = 0.5
    mass: float = WEIGHT / GRAVITY
    wrong: float = 1.0
    _plans: deque[_Expected] = field(default_factory=deque)

    def __call__(self, state: State, last: Plan | None, belief: Mapping[str, float]) -> dict[str, float]:
        """The belief to plan under, by the newest estimate: mass and friction share the correction."""
        force = believed = box_friction(belief)
        plans, expected = self._plans, self._expected(state, last) if last else None
        if last and expected:
            plans.append(expected)
            while plans[0].time < state.time - 0.5 * last.period:
                plans.popleft()
            then = plans[0]
            if then.time < state.time + 0.5 * last.period and then.speed > self.least:
                gain = (self.mass + belief["box_mass"]) / self.lead
                slower = then.speed - heading_velocity(state.trunk)[0]
                missing = sum(plan.pushed for plan in plans) / len(plans) + gain * slower - believed
                self.wrong = self._posterior(then.wrong, missing, gain * self.noise)
                force = max(believed + self.wrong * min(missing, self.most), self.left * believed)
        share = sqrt(force / believed)
        return {**belief, **{name: belief[name] * share for name in ("box_mass", "floor_friction")}}

    def _expected(self, state: State, last: Plan) -> _Expected | None:
        """What the last plan expects along the trunk's heading; None if it does not push, or ends before."""
        row = round(self.lead / last.period) - 2  # a plan begins one period late, and its rows end periods
        if last.reference.pushing != 1.0 or last.candidates is None or not last.step:
            return None
        weights = last.step.weights
        if not weights.any() or not 1 <= row < len(last.targets):
            return None
        moved = np.diff(last.candidates[:, row - 1 : row + 1, self.at.trunk][..., :2], axis=1)[:, 0]
        x, y = weights @ moved / (weights.sum() * last.period)
        speed = float(cos(state.trunk.yaw) * x + sin(state.trunk.yaw) * y)
        time = last.start - last.period + self.lead
        return _Expected(time, speed, box_friction(last.belief), self.wrong)

    def _posterior(self, before: float, missing: float, sd: float) -> float:
        """Probability that the belief is wrong, after a missing force [N] with that sd."""
        prior, either = self.rate * self.lead + self.lasting * before, sd**2 + self.spread**2
        odds = log(prior / (1.0 - prior)) + 0.5 * (missing**2 * (sd**-2 - 1.0 / either) - log(either / sd**2))
        return 1.0 / (1.0 + exp(-odds))


@dataclass(frozen=True, slots=True)
class Steering:
    """Gains of the steering.

    Args:
        path_gain: How much the heading turns back to the path, per distance from it [rad/m], up to
            `path_limit` [rad].
        path_hold: How much it turns further back per distance from it and way along it [rad/m^2]: a box that
            creeps aside would come to rest beside its path.
        ahead: The box is turned to where its path will lead this much later [m].
        offset_gain: How far beside the box's middle to push, per missing turn of the box [m/rad], up to
            `offset_limit` [m].
        yaw_limit: How far the robot's yaw may lead the box's [rad].
        touching: Distance from bumper to box below which the box is to move [m].
        near: The same where the box has stood for `patience` [s]: a face may be nearer than stated.
        lead: The planner aims at this much more than the commanded speed: a box moves in pulses, and the
            quadratic cost of a pulsing speed is least below its mean.
        creep: The planner's aim is no slower than this [m/s] until the box is `enough` [m] before the goal:
            a box that is pushed ever more slowly sticks. One that comes no further than that stands.
    """

    path_gain: float = 1.5
    path_limit: float = 0.5
    path_hold: float = 0.5
    ahead: float = 0.08
    offset_gain: float = 1.0
    offset_limit: float = 0.12
    yaw_limit: float = 0.2
    touching: float = 0.015
    near: float = 0.03
    patience: float = 0.5
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


def commanded_speed(path: Course, progress: float) -> float:
    """Commanded speed of the robot [m/s] when the box has come so far along its path [m]."""
    return SPEED * path.tapered(progress, TAPER)


class Helm:
    """Turns states into references; remembers whether the robot is backing off, and how slow it is.

    Args:
        size: Extent of the box along and across the push [m], and its height.
    """

    def __init__(self, path: Course, size: tuple[float, float, float]) -> None:
        self._path, self._half_length, self._half_width = path, 0.5 * size[0], 0.5 * size[1]
        self._steering, self._retreat = Steering(), Retreat()
        self._pacing, self._insisting = Pacing(), Insisting()
        self.retreating = False
        self._gone, self._held, self._mark = 0.0, 0.0, (-np.inf, 0.0)

    def on_path(self, state: State) -> Reference:
        """The fixed path reference: what the task demands, whether or not it can be done."""
        place = self._path.place(state.box.position[:2])
        origin, heading = self._path.nearest(state.box.position[:2], place), place.heading
        commanded = commanded_speed(self._path, place.progress)
        return Reference(state.time, commanded, origin, heading, yaw=heading, box_yaw=heading)

    def reference(self, state: State, overlap: float = 0.0) -> Reference:
        """What the controller is to do now, if the box's face is so far behind its stated place [m]."""
        place, s = self._path.place(state.box.position[:2]), self._steering
        origin = self._path.nearest(state.box.position[:2], place)
        progress, box_yaw = place.progress, state.box.yaw
        commanded = commanded_speed(self._path, progress)
        gone, self._gone = self._gone, max(self._gone, progress)  # noise of a box that stands is no way
        self._held = limited(self._held + s.path_hold * place.left * (self._gone - gone), s.path_limit)
        back = limited(s.path_gain * place.left + self._held, s.path_limit)
        heading = place.heading + self._path.curvature * s.ahead - back
        missing = wrapped(heading - box_yaw)
        offset = -limited(s.offset_gain * missing, s.offset_limit)
        speed = self._aim(commanded, progress)
        gap, left = self.gap(state, overlap)
        self._judge(gap, left - offset, left, wrapped(state.trunk.yaw - box_yaw))
        if self.retreating:
            speed = -self._retreat.speed if gap < self._retreat.clear else 0.0
            return Reference(
                state.time, speed, origin, heading, box_yaw, box_yaw=heading, offset=offset, pushing=0.0
            )
        touching = gap < s.touching
        if touching and commanded == SPEED:  # not while the commanded speed falls
            self._pacing.update(state.time, 1.0 - heading_velocity(state.trunk)[0] / SPEED)
        stands = self._stands(state.time, progress, gap)
        if speed > 0.0 and (touching or stands or (gap < s.near and self._insisting.share > 0.0)):
            reached = heading_velocity(state.box)[0] if touching else speed
            self._insisting.update(state.time, 0.0 if stands else reached, speed)
        more = self._insisting.share
        pushing = 1.0 if touching else more if gap < s.near else 0.0
        return Reference(
            state.time, (1.0 + more) * speed, origin, heading, box_yaw + limited(missing, s.yaw_limit),
            heading, speed * self._path.curvature, offset, pushing, more,
        )  # fmt: skip

    def _aim(self, commanded: float, progress: float) -> float:
        s = self._steering
        if self._path.length - progress <= s.enough:
            return 0.0
        return (1.0 + self._pacing.share) * max(s.lead * commanded, s.creep)

    def gap(self, state: State, overlap: float = 0.0) -> tuple[float, float]:
        """Distance from bumper to the box's face, and the bumper's middle left of the box's [m]."""
        ahead, left = bumper_from_box(state.trunk, state.box)
        return overlap - self._half_length - float(ahead), float(left)

    def _stands(self, time: float, progress: float, gap: float) -> bool:
        """Whether the box that the robot is near has come no further for a while."""
        s, (mark, since) = self._steering, self._mark
        if gap >= s.near or progress > mark + s.enough:
            self._mark = progress, time
            return False
        return time - since > s.patience

    def _judge(self, gap: float, misplaced: float, left: float, turn: float) -> None:
        """Enter or leave the retreat."""
        r = self._retreat
        if abs(left) > self._half_width + r.lost_left or abs(turn) > r.lost_turn:
            self.retreating = True
        elif abs(misplaced) < r.aligned_left and abs(turn) < r.aligned_turn and gap > 0.5 * r.clear:
            self.retreating = False


@dataclass(slots=True, eq=False)
class Stepping:
    """Where feet land: a robot that drifts aside steps to that side, or it topples over its diagonal.

    Two feet of a trot do not balance: the trunk falls about the line between them until the next two land.
    They stop it where they land at the capture point, sqrt(h / g) times the velocity beside the trunk (Pratt
    et al. 2006; Raibert 1986 for the rule). The planner's horizon is shorter than a stride, so it cannot find
    this out.

    Args:
        gain: Distance per speed [s]; sqrt(h / g) is 0.17.
        limit: Greatest distance from neutral [m].
        settling: Time in which a flying foot goes to a new place [s]; it smooths noisy velocities.
    """

    gain: float = 0.12
    limit: float = 0.1
    settling: float = 0.05
    _left: FloatArray = field(default_factory=lambda: np.zeros(4))
    _time: float | None = None

    def update(self, time: float, drift: float, standing: BoolArray) -> FloatArray:
        """Places of the feet left of neutral [m], shape (4,); standing feet stay where they are.

        Args:
            time: The time now [s].
            drift: Speed of the trunk to the left beyond the commanded one [m/s].
            standing: Which feet are on the floor, shape (4,).
        """
        passed, self._time = 0.0 if self._time is None else time - self._time, time
        wanted = limited(self.gain * drift, self.limit)
        share = min(1.0, max(0.0, passed) / self.settling)
        self._left = np.where(standing, self._left, self._left + share * (wanted - self._left))
        return self._left


#: Noise of the channels: speed ahead and left [m/s], yaw rate [rad/s], push [N].
CHANNEL_SIGMA = sealed([0.06, 0.02, 0.15, 10.0])


@dataclass(frozen=True, slots=True)
class WalkGains:
    """Feedback of the bare reference; plans are deviations from it.

    Args:
        left: Speed to the left per distance [1/s], up to `left_limit` [m/s].
        yaw: Yaw rate per turn [1/s], up to `yaw_limit` [rad/s].
        full_push: Speed above which the box's friction is pushed against with full force [m/s].
        start_time: Time in which the speed rises to the commanded one [s].
    """

    left: float = 1.0
    left_limit: float = 0.08
    yaw: float = 3.0
    yaw_limit: float = 0.4
    full_push: float = 0.05
    start_time: float = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class WalkMove:
    """Walking from one situation; see `control.protocols.Move`.

    Args:
        gait: How the legs step.
        height: Desired height of the trunk [m].
        reference: What robot and box should do.
        command: A command: ahead, left [m/s], yaw rate [rad/s], push [N]; shape (4,).
        left: How far left of neutral each foot steps [m], shape (4,).
    """

    gait: Gait
    weights: PushWeights
    height: float
    reference: Reference
    command: FloatArray
    left: FloatArray

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        """See `Move`."""
        push = np.zeros((len(commands), 1, 2))
        push[:, 0, 0] = np.maximum(commands[:, 3], 0.0)
        return walk(self.gait, times[None], commands[:, None, :3], push, self.left).targets

    def terms(self, times: FloatArray, bodies: tuple[Body, Body]) -> dict[str, FloatArray]:
        """See `Move`."""
        trunk, box = bodies
        elapsed = times - self.reference.time
        return push_terms(self.weights, trunk, box, self.height, self.reference, elapsed)


@dataclass(frozen=True, slots=True, eq=False)
class Walking:
    """The behaviour of all tasks in which the robot walks; see `control.protocols.Behaviour`.

    Args:
        helm: Decides where to go.
        gait: How the legs step.
        gains: Gains of the bare reference.
        stepping: Where feet land when the robot drifts aside.
        height: Desired height of the trunk in the cost [m]. Not `Gait.height`, which is how far below the
            trunk the bare reference puts the feet: the trunk walks between the two, at 0.273 m in T1.
    """

    helm: Helm
    gait: Gait = field(default_factory=Gait)
    weights: PushWeights = field(default_factory=PushWeights)
    gains: WalkGains = WalkGains()
    stepping: Stepping = field(default_factory=Stepping)
    height: float = 0.28

    channel_sigma = CHANNEL_SIGMA

    @property
    def knot_weight(self) -> float:
        """See `Behaviour`."""
        return self.weights.knots

    def switches(self, start: float, end: float) -> bool:
        """See `Behaviour`."""
        return switches(self.gait, start, end)

    def standing(self, times: FloatArray) -> BoolArray:
        """Which feet should stand at times [s] (...), shape (..., 4)."""
        return contacts(self.gait, times)

    def move(self, state: State, belief: Mapping[str, float]) -> WalkMove:
        """See `Behaviour`."""
        at = self.helm.reference(state, belief.get("face_overlap", 0.0))
        if state.time < self.gains.start_time:
            at = replace(at, speed=at.speed * state.time / self.gains.start_time)
        command = self._command(state, at, box_friction(belief))
        drift = heading_velocity(state.trunk)[1] - command[1]
        left = self.stepping.update(state.time, drift, self.standing(np.array(state.time)))
        gait = replace(self.gait, height=self.gait.height + at.lift) if at.lift else self.gait
        return WalkMove(gait, self.weights, self.height + at.lift, at, command, left)

    def running_cost(self, state: State) -> dict[str, float]:
        """Terms of the running cost of a realised state, measured against the task's fixed path."""
        at, now = self.helm.on_path(state), np.array(0.0)
        terms = push_terms(self.weights, state.trunk, state.box, self.height, at, now)
        return {name: float(term) for name, term in terms.items()}

    def _command(self, state: State, at: Reference, resistance: float) -> FloatArray:
        g = self.gains
        _, left = bumper_from_box(state.trunk, state.box)
        sideways = limited(g.left * (at.offset - float(left)), g.left_limit)
        # on a curve, what turns flush with the box goes aside as fast as it is behind the box's middle
        ahead, aside, _ = (state.box.position - state.trunk.position).tolist()
        sideways -= at.pushing * at.turn * hypot(ahead, aside)
        turn = at.turn + g.yaw * wrapped(at.yaw - state.trunk.yaw)
        push = at.pushing * (1.0 + at.harder) * resistance * min(max(at.speed / g.full_push, 0.0), 1.0)
        return np.array([at.speed, sideways, limited(turn, g.yaw_limit), push])
