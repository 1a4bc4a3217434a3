"""One control cycle: predict over the latency, steer, plan with MPOPI in the time left, under a belief."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from amhe_cli.control.mpopi import Mpopi, MpopiStep, Scores, spline_basis
from amhe_cli.control.protocols import Behaviour, Move, Robot
from amhe_cli.control.settings import ControlSettings
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.engine.rollout import Engine, Rollouts, joined

#: Rollouts of a cycle that are made in any case: the mean, the best plan so far, the bare reference, and one
#: with noise.
LEAST = 4
#: Share of the newest measurement in what is remembered.
_NEWEST = 0.2
#: Share of the time left that the next rollouts may take: where they turn out slower there is still some.
_SHARE = 0.6


class RolloutPace:
    """Measures rollouts, and what comes after them, and divides the time that is left.

    Args:
        clock: Present time [s], on the clock of all deadlines.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._rollout = self._rest = 0.0
        self._since = 0.0

    def next(self, done: int, wanted: int, deadline: float | None) -> int:
        """How many of the wanted rollouts to make next, after so many are done; 0: no more.

        Args:
            done, wanted: Numbers of rollouts.
            deadline: When the plan is due, by `clock`; None: there is time for all of them.
        """
        self._since = self.clock()
        if deadline is None:
            return wanted - done
        if done < LEAST:
            return min(LEAST, wanted) - done
        left = deadline - self._since - self._rest
        if left < self._rollout:
            return 0
        return int(min(wanted - done, max(1.0, _SHARE * left / max(self._rollout, 1e-6))))

    def rolled_out(self, count: int) -> None:
        """So many rollouts have been made since `next`."""
        now = self.clock()
        self._rollout = remembered(self._rollout, (now - self._since) / count)
        self._since = now

    def planned(self) -> None:
        """The plan is finished, and handed over next."""
        self._rest = remembered(self._rest, self.clock() - self._since)


def remembered(old: float, new: float) -> float:
    """A duration to expect [s]: a longer one counts at once, a shorter one bit by bit."""
    return max(new, (1.0 - _NEWEST) * old + _NEWEST * new)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Joint targets over the horizon.

    Args:
        start: Time from which the first row acts [s]; each row holds for one period.
        period: Control period, the time between two rows [s].
        targets: Joint targets [rad], shape (H, n).
        reference: What the behaviour aimed at; None for a plan without a behaviour.
        command: Command of the behaviour with the plan's channels added, shape (c,).
        step: Statistics of the sampling; None for a plan that was not sampled.
        candidates: States qpos that the sampled plans would lead to, shape (n, H, nq).
        expected: The state at the start, as the planner's model predicts it; None: nobody did.
        belief: Parameters under which it was made, by name.
    """

    start: float
    period: float
    targets: FloatArray
    reference: Any = None
    command: FloatArray | None = None
    step: MpopiStep | None = None
    candidates: FloatArray | None = None
    expected: Any = None
    belief: Mapping[str, float] = field(default_factory=dict)

    def at(self, time: float) -> FloatArray:
        """Joint targets (n,) in force at a time [s]; the last row is held."""
        row = int((time - self.start) / self.period + 1e-6)
        return self.targets[min(max(row, 0), len(self.targets) - 1)]


class Controller:
    """Plans from one period after the given state on.

    Args:
        behaviour: How the task moves the robot.
        robot: The robot as the planner's model has it.
        sigma: Start sd of the sampling noise on each joint's knots [rad], shape (n,).
        engine: Rollouts of the planner's model.
        names: Names of the parameters theta, in the engine's order.
        rng: Source of all samples.
        pace: Divides the time before a deadline; of this controller alone.
        reflex: Corrects the belief before each plan, from the state and the last plan; None: it is used as
            it is.
    """

    def __init__(
        self,
        behaviour: Behaviour,
        robot: Robot,
        sigma: FloatArray,
        engine: Engine,
        settings: ControlSettings,
        names: Sequence[str],
        rng: np.random.Generator,
        pace: RolloutPace | None = None,
        reflex: Callable[[Any, Plan | None, Mapping[str, float]], Mapping[str, float]] | None = None,
    ) -> None:
        self._pace, self._reflex = pace or RolloutPace(), reflex
        self._last: Plan | None = None
        self._behaviour, self._robot, self._engine = behaviour, robot, engine
        self._settings, self._names = settings, names
        self._inputs = np.argsort(robot.servos)  # which joint each input of the engine moves
        self._sampler = Mpopi(settings, sigma, behaviour.channel_sigma, rng)
        self._steps = settings.period * np.arange(settings.horizon, dtype=np.float64)
        self._basis = spline_basis(np.linspace(0.0, 1.0, settings.horizon), settings.knots)

    def plan(
        self, state: Any, in_force: FloatArray, belief: Mapping[str, float], deadline: float | None = None
    ) -> Plan:
        """Plan from one period after the state on.

        Args:
            state: The state now, of the robot's own type.
            in_force: Joint targets that act until then [rad], shape (n,).
            belief: Believed parameters by name.
            deadline: When the plan is due, by time.monotonic() [s]: samples for which there is no time are
                left out, the least worthy first. None: no sample is left out.
        """
        if self._reflex:
            belief = self._reflex(state, self._last, belief)
        period = self._settings.period
        theta = np.array([belief[name] for name in self._names])
        start, qpos, qvel = self._predicted(state, in_force, theta)
        move = self._behaviour.move(start, belief)
        times = start.time + self._steps

        sampled: list[tuple[FloatArray, FloatArray]] = []

        def evaluate(x: FloatArray) -> Scores:
            targets = self._targets(move, times, x)
            rollouts = self._roll_out_in_time(theta, qpos, qvel, targets, deadline)
            done = len(rollouts.completed)
            sampled.append((targets[:done], rollouts.qpos))
            terms = move.terms(times + period, self._robot.bodies(rollouts.qpos, rollouts.qvel))
            return self._scores(x[:done], terms, rollouts.completed)

        switched = self._behaviour.switches(start.time - period, start.time)
        step = self._sampler.step(evaluate, switched)
        if step.weights.any():
            made = sampled[-1][0]
            targets = (step.weights @ made.reshape(len(made), -1)).reshape(made.shape[1:])
        else:
            targets = self._targets(move, times, step.mean[None])[0]
        command = move.command + self._sampler.split(step.mean)[1]
        self._pace.planned()
        candidates = sampled[-1][1]
        plan = Plan(start.time, period, targets, move.reference, command, step, candidates, start, belief)
        self._last = plan
        return plan

    def _predicted(
        self, state: Any, in_force: FloatArray, theta: FloatArray
    ) -> tuple[Any, FloatArray, FloatArray]:
        """The state one period later, with its coordinates; the same state where the prediction diverges."""
        qpos, qvel = self._robot.coordinates(state)
        one = self._roll_out(theta, qpos, qvel, in_force[None, None])
        time = state.time + self._settings.period
        if not one.completed[0]:
            return replace(state, time=time), qpos, qvel
        qpos, qvel = one.qpos[0, 0], one.qvel[0, 0]
        return self._robot.state_of(time, qpos, qvel), qpos, qvel

    def _targets(self, move: Move, times: FloatArray, x: FloatArray) -> FloatArray:
        """Joint targets of plans (n, d), within the joints' limits, shape (n, H, joints)."""
        knots, channels = self._sampler.split(x)
        targets = move.targets(times, move.command + channels) + self._basis @ knots
        return np.minimum(np.maximum(targets, self._robot.lower, out=targets), self._robot.upper, out=targets)

    def _roll_out_in_time(
        self,
        theta: FloatArray,
        qpos: FloatArray,
        qvel: FloatArray,
        targets: FloatArray,
        deadline: float | None,
    ) -> Rollouts:
        """Roll out the first ones of some joint targets (n, H, joints), as many as there is time for."""
        parts: list[Rollouts] = []
        done = 0
        while count := self._pace.next(done, len(targets), deadline):
            parts.append(self._roll_out(theta, qpos, qvel, targets[done : done + count]))
            self._pace.rolled_out(count)
            done += count
        return parts[0] if len(parts) == 1 else joined(parts)

    def _roll_out(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, targets: FloatArray
    ) -> Rollouts:
        """Roll out joint targets (n, H, joints); one row of states for each control period."""
        count, fine = len(targets), self._settings.substeps
        inputs = targets[..., self._inputs].repeat(fine, axis=1)
        lengths = np.full(count, inputs.shape[1])
        rows = self._engine.rollout(theta[None].repeat(count, axis=0), qpos, qvel, inputs, lengths)
        return Rollouts(rows.qpos[:, fine - 1 :: fine], rows.qvel[:, fine - 1 :: fine], None, rows.completed)

    def _scores(self, x: FloatArray, terms: dict[str, FloatArray], completed: BoolArray) -> Scores:
        knots, _ = self._sampler.split(x)
        means = np.array(list(terms.values())).sum(axis=-1) / self._settings.horizon
        bent = self._behaviour.knot_weight / knots.shape[1] * (knots**2).sum(axis=(1, 2))
        cost = means.sum(axis=0) + bent
        named = dict(zip(terms, means, strict=True)) | {"knots": bent}
        return Scores(np.where(completed & np.isfinite(cost), cost, np.inf), named)
