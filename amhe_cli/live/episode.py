"""The live loop: measure, estimate, plan, act; one `Cycle` after the other, under a fixed or adaptive belief.

States and truths are of the robot's own type: the loop passes them on and reads only their `time` [s].
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from amhe_cli.control.controller import LEAST, Controller, Plan, remembered
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Samples
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.workers import News
from amhe_cli.live.target import Target


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """Measurements, estimates, plan and truth of one control period.

    Args:
        samples: Samples for log and estimator.
        estimate: Estimated state.
        played: Joint targets in force while it was planned [rad], shape (n,).
        plan: The plan made from that state; it takes effect one period later.
        belief: The belief by name, before the controller's reflex corrects it (`Plan.belief`).
        truth: The true state now; None where it is unknown.
        parameters: The true parameters now; None where they are unknown.
        plan_ms: Time that the cycle took to compute [ms].
        misses: Number of periods without a new plan, so far.
        over: The episode ends with this cycle.
        hurried: There was time for no more than the least number of rollouts, or not even for them.
        news: Estimates that arrived since the last cycle, and troubles of the estimator.
    """

    samples: Samples
    estimate: Any
    played: FloatArray
    plan: Plan
    belief: dict[str, float]
    truth: Any
    parameters: dict[str, float] | None
    plan_ms: float
    misses: int
    over: bool
    hurried: bool
    news: tuple[News, ...] = ()

    @property
    def time(self) -> float:
        """Time of the state that was planned from [s]."""
        return self.estimate.time


class BeliefSource:
    """The believed parameters; estimates change them only between two plans.

    Args:
        parameters: Returns the parameters by name: fixed ones, or those of a plant at the moment.
        tracker: The estimator whose newest estimate replaces them; None: nothing is estimated.
    """

    def __init__(self, parameters: Callable[[], Mapping[str, float]], tracker: Tracker | None = None) -> None:
        self._parameters, self._tracker = parameters, tracker
        self._estimated: dict[str, float] = {}

    @property
    def now(self) -> dict[str, float]:
        """Parameters by name, at present: line 9 of Algorithm 1."""
        return {**self._parameters(), **self._estimated}

    def learn(self, cycle: Cycle) -> tuple[News, ...]:
        """Take in a cycle; returns the estimates and troubles for the next."""
        if self._tracker is None:
            return ()
        news = self._tracker.feed(cycle.samples, cycle.time, begin=not cycle.hurried)
        for estimate in news:
            if isinstance(estimate, Estimate):
                self._estimated |= zip(estimate.belief.names, estimate.theta.tolist(), strict=True)
        return news

    def close(self) -> None:
        """Release its resources; it is not used any more."""
        if self._tracker is not None:
            self._tracker.close()


class EpisodeJudge(Protocol):
    """Watches an episode and says when it is over."""

    def watch(self, state: Any) -> bool:
        """Take in the state of one cycle, the true one where it is known; True: the episode is over."""
        ...

    @property
    def verdict(self) -> tuple[int, str]:
        """How the episode ended: a level of diagnostics, and one line of text."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """One run of a task on a target.

    Args:
        target: Robot or simulation that is controlled.
        observe: Gives the state at a time [s] from the measurements since the last call.
        belief: Gives the believed parameters.
        sample: Gives the samples for log and estimator, from the measurements of a cycle and its estimate.
        judge: Says when the episode is over.
    """

    target: Target
    observe: Callable[[float, Samples], Any]
    controller: Controller
    belief: BeliefSource
    sample: Callable[[Samples, Any], Samples]
    judge: EpisodeJudge

    def cycles(self) -> Iterator[Cycle]:
        """Run to the end of the episode.

        Raises:
            SimulationError: The plant diverged.
        """
        news: tuple[News, ...] = ()
        aside = 0.0
        while True:
            now, measured = self.target.measure()
            begun, due = time.perf_counter(), self.target.deadline
            if due is not None:
                due -= aside  # what is done after a plan must not take the time of the next
            estimate = self.observe(now, measured)
            played = self.target.in_force(now)
            belief = self.belief.now
            plan = self.controller.plan(estimate, played, belief, due)
            self.target.play(plan)  # before anything else takes time
            handed_over = time.monotonic()
            plan_ms = 1e3 * (time.perf_counter() - begun)
            least = plan.step is not None and plan.step.rollouts <= LEAST
            hurried = due is not None and (least or handed_over > due)
            truth = self.target.truth
            over = self.judge.watch(truth or estimate)
            cycle = Cycle(
                self.sample(measured, estimate), estimate, played, plan, belief,
                truth, self.target.parameters, plan_ms, self.target.misses, over, hurried,
                news,
            )  # fmt: skip
            news = self.belief.learn(cycle)
            yield cycle
            aside = remembered(aside, time.monotonic() - handed_over)
            if over:
                return
