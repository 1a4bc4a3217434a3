"""The live loop: measure, estimate, plan, act; one `Cycle` after the other."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from amhe_cli.control.controller import Controller, Plan
from amhe_cli.control.protocols import Behaviour
from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.live.target import Target
from amhe_cli.robots.go1.judge import Judge
from amhe_cli.robots.go1.state import Measurements, State
from amhe_cli.robots.go1.state_estimator.estimator import StateEstimator


@dataclass(frozen=True, slots=True, eq=False)
class News:
    """Something that came from the estimator.

    Args:
        time: When it was known [s].
        estimate: In force from now on; None: there is only something to tell.
        text: What went wrong.
    """

    time: float
    estimate: Estimate | None
    text: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """All that happened in one control period.

    Args:
        measured: By the sensors, up to now.
        estimate: State by the estimator.
        played: Joint targets in force while it was planned, shape (12,).
        plan: Made from it; takes effect one period later.
        belief: Parameters that it was made with, by name.
        truth: The true state now; None where nobody knows it.
        parameters: The true parameters now, likewise.
        plan_ms: Time that the cycle took to compute [ms].
        misses: Periods without a new plan, so far.
        over: The episode ends with this cycle.
        news: Of the estimator, since the cycle before.
    """

    measured: Measurements
    estimate: State
    played: FloatArray
    plan: Plan
    belief: dict[str, float]
    truth: State | None
    parameters: dict[str, float] | None
    plan_ms: float
    misses: int
    over: bool
    news: tuple[News, ...] = ()


class BeliefSource(Protocol):
    """What the controller plans with."""

    def at(self, time: float) -> dict[str, float]:
        """Parameters by name, at a time [s]."""
        ...

    def saw(self, cycle: Cycle) -> tuple[News, ...]:
        """Learn from a cycle; what is new for the next."""
        ...

    def close(self) -> None:
        """Let go of what it holds; nothing is asked of it after."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """One run of a task on a target.

    Args:
        target: What is controlled.
        behaviour: Of the task.
        controller: That plans.
        belief: What it believes.
        judge: That says when it is over.
    """

    target: Target
    behaviour: Behaviour
    controller: Controller
    belief: BeliefSource
    judge: Judge

    def cycles(self) -> Iterator[Cycle]:
        """Run to the end of the episode.

        Raises:
            SimulationError: The plant diverged.
        """
        estimator = StateEstimator()
        news: tuple[News, ...] = ()
        while True:
            measured = self.target.measure()
            begun = time.perf_counter()
            estimate = estimator.update(measured, self.behaviour.standing(measured.robot_times))
            played = self.target.in_force(estimate.time)
            belief = self.belief.at(estimate.time)
            plan = self.controller.plan(estimate, played, belief)
            self.target.play(plan)  # before anything else takes time
            plan_ms = 1e3 * (time.perf_counter() - begun)
            truth = self.target.truth
            over = self.judge.watch(truth or estimate)
            cycle = Cycle(
                measured, estimate, played, plan, belief, truth, self.target.parameters,
                plan_ms, self.target.misses, over, news,
            )  # fmt: skip
            news = self.belief.saw(cycle)
            yield cycle
            if over:
                return
