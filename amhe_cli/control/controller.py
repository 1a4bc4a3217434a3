"""One control cycle: predict over the latency, steer, plan with MPOPI under the present belief."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.control.mpopi import JOINTS, Mpopi, Scores, Step
from amhe_cli.control.protocols import Behaviour, Move
from amhe_cli.control.splines import spline_basis
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.settings import ControlSettings
from amhe_cli.engine.rollout import RolloutEngine, Rollouts
from amhe_cli.robots.go1.behaviours.objective import Reference
from amhe_cli.robots.go1.kinematics import LOWER, UPPER
from amhe_cli.robots.go1.model import Layout
from amhe_cli.robots.go1.state import Body, State, coordinates, state_of


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Joint targets over the horizon.

    Args:
        start: When the first row takes effect [s]; each holds for one period.
        period: [s].
        targets: [rad], shape (H, 12).
        reference: What was wanted.
        command: Of the behaviour, channels included, shape (c,).
        step: How the sampling went; None for a plan that nobody sampled.
    """

    start: float
    period: float
    targets: FloatArray
    reference: Reference | None = None
    command: FloatArray | None = None
    step: Step | None = None

    def at(self, time: float) -> FloatArray:
        """Joint targets (12,) in force at a time [s]; the last row is held."""
        row = int((time - self.start) / self.period + 1e-6)
        return self.targets[min(max(row, 0), len(self.targets) - 1)]


class Controller:
    """Plans one period ahead of the state that it is given.

    Args:
        behaviour: Of the task.
        engine: Rollouts of the planner's model.
        at: Its layout.
        settings: Of MPOPI.
        rng: The source of all samples.
    """

    def __init__(
        self,
        behaviour: Behaviour,
        engine: RolloutEngine,
        at: Layout,
        settings: ControlSettings,
        rng: np.random.Generator,
    ) -> None:
        self._behaviour, self._engine, self._at, self._settings = behaviour, engine, at, settings
        self._sampler = Mpopi(settings, behaviour.channel_sigma, rng)
        self._basis = spline_basis(np.linspace(0.0, 1.0, settings.horizon), settings.knots)

    def plan(self, state: State, in_force: FloatArray, theta: FloatArray, resistance: float) -> Plan:
        """Plan from one period after the state.

        Args:
            state: Now.
            in_force: Joint targets that act until then, shape (12,).
            theta: Parameters believed, shape (d,).
            resistance: What the box's friction resists with by them [N].
        """
        period = self._settings.period
        start = self._predicted(state, in_force, theta)
        move = self._behaviour.move(start, resistance)
        times = start.time + period * np.arange(self._settings.horizon, dtype=np.float64)
        qpos, qvel = coordinates(self._at, start)

        sampled: list[FloatArray] = []

        def evaluate(x: FloatArray) -> Scores:
            sampled.append(self._targets(move, times, x))
            rollouts = self._roll_out(theta, qpos, qvel, sampled[-1])
            trunk, box = _bodies(self._at, rollouts.qpos, rollouts.qvel)
            terms = move.terms(times + period, trunk, box)
            return self._scores(x, terms, rollouts.completed)

        switched = self._behaviour.switches(start.time - period, start.time)
        step = self._sampler.step(evaluate, switched)
        if step.weights.any():
            targets = np.tensordot(step.weights, sampled[-1], axes=1)
        else:
            targets = self._targets(move, times, step.mean[None])[0]
        command = move.command + self._sampler.split(step.mean)[1]
        return Plan(start.time, period, targets, move.reference, command, step)

    def _predicted(self, state: State, in_force: FloatArray, theta: FloatArray) -> State:
        qpos, qvel = coordinates(self._at, state)
        one = self._roll_out(theta, qpos, qvel, in_force[None, None])
        time = state.time + self._settings.period
        if not one.completed[0]:
            return replace(state, time=time)
        return state_of(self._at, time, one.qpos[0, 0], one.qvel[0, 0])

    def _targets(self, move: Move, times: FloatArray, x: FloatArray) -> FloatArray:
        """Joint targets of plans (n, d), within the joints' limits, shape (n, H, 12)."""
        knots, channels = self._sampler.split(x)
        targets = move.targets(times, move.command + channels) + self._basis @ knots
        return np.clip(targets, LOWER, UPPER, out=targets)

    def _roll_out(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, targets: FloatArray
    ) -> Rollouts:
        """Roll out joint targets (n, H, 12); one row of states for each control period."""
        count, fine = len(targets), self._settings.substeps
        inputs = np.empty((count, fine * targets.shape[1], JOINTS))
        inputs[..., self._at.servos] = np.repeat(targets, fine, axis=1)
        theta = np.broadcast_to(theta, (count, theta.size))
        rows = self._engine.rollout(theta, qpos, qvel, inputs, np.full(count, inputs.shape[1]))
        return replace(rows, qpos=rows.qpos[:, fine - 1 :: fine], qvel=rows.qvel[:, fine - 1 :: fine])

    def _scores(self, x: FloatArray, terms: dict[str, FloatArray], completed: BoolArray) -> Scores:
        knots, _ = self._sampler.split(x)
        means = {name: term.mean(axis=-1) for name, term in terms.items()}
        means["knots"] = self._behaviour.knot_weight * (knots**2).sum(axis=-1).mean(axis=-1)
        cost = np.sum(list(means.values()), axis=0)
        return Scores(np.where(completed & np.isfinite(cost), cost, np.inf), means)


def _bodies(at: Layout, qpos: FloatArray, qvel: FloatArray) -> tuple[Body, Body]:
    """Trunk and box of rollouts (n, H, ...)."""

    def body(q: slice, v: slice) -> Body:
        pose, twist = qpos[..., q], qvel[..., v]
        return Body(pose[..., :3], pose[..., 3:], twist[..., :3], twist[..., 3:])

    return body(at.trunk, at.trunk_v), body(at.box, at.box_v)
