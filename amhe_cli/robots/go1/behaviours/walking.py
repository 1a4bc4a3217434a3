"""Walking behind a box and pushing it (tasks T1-T4, hw1, hw2): from commands to joint targets and costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.gait import Gait, box_friction, contacts, mode_switches, walk
from amhe_cli.robots.go1.behaviours.objective import (
    PushWeights,
    Reference,
    bumper_from_box,
    push_terms,
    wrapped,
)
from amhe_cli.robots.go1.behaviours.steering import Helm
from amhe_cli.robots.go1.state import Body, State, heading_velocity


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
        wanted = np.clip(self.gain * drift, -self.limit, self.limit)
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
        weights: Weights of the cost.
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
        weights: Weights of the cost.
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

    @property
    def channel_sigma(self) -> FloatArray:
        """See `Behaviour`."""
        return CHANNEL_SIGMA

    @property
    def knot_weight(self) -> float:
        """See `Behaviour`."""
        return self.weights.knots

    def switches(self, start: float, end: float) -> bool:
        """See `Behaviour`."""
        return mode_switches(self.gait, start, end).size > 0

    def standing(self, times: FloatArray) -> BoolArray:
        """Which feet should stand at times [s] (...), shape (..., 4)."""
        return contacts(self.gait, times)

    def move(self, state: State, belief: Mapping[str, float]) -> WalkMove:
        """See `Behaviour`."""
        at = self.helm.reference(state)
        at = replace(at, speed=at.speed * min(1.0, state.time / self.gains.start_time))
        command = self._command(state, at, box_friction(belief))
        drift = heading_velocity(state.trunk)[1] - command[1]
        left = self.stepping.update(state.time, drift, self.standing(np.array(state.time)))
        return WalkMove(self.gait, self.weights, self.height, at, command, left)

    def running_cost(self, state: State) -> dict[str, float]:
        """Terms of the running cost of a realised state, measured against the task's fixed path."""
        at, now = self.helm.on_path(state), np.array(0.0)
        terms = push_terms(self.weights, state.trunk, state.box, self.height, at, now)
        return {name: float(term) for name, term in terms.items()}

    def _command(self, state: State, at: Reference, resistance: float) -> FloatArray:
        g = self.gains
        _, left = bumper_from_box(state.trunk, state.box)
        sideways = np.clip(g.left * (at.offset - left), -g.left_limit, g.left_limit)
        turn = at.turn + g.yaw * wrapped(at.yaw - yaw_of(state.trunk.orientation))
        push = at.pushing * (1.0 + at.harder) * resistance * np.clip(at.speed / g.full_push, 0.0, 1.0)
        return np.array([at.speed, sideways, np.clip(turn, -g.yaw_limit, g.yaw_limit), push])
