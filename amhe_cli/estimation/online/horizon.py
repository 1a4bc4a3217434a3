"""Moving-horizon estimation: a belief that is brought up to date by one window after the other."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import Belief, belief_of
from amhe_cli.core.settings import MheSettings
from amhe_cli.core.statistics import Z90
from amhe_cli.engine.rollout import RolloutEngine
from amhe_cli.estimation.online.arrival import Arrival, arrival_of, reported
from amhe_cli.estimation.online.linearised import linearised_update
from amhe_cli.estimation.online.logrank import logrank_update
from amhe_cli.estimation.online.update import Noise, Outcome, Task, Update
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

#: What became of a window. 'gap': a signal was silent in it; 'still': it says nothing, and tells of no jump;
#: 'diverged': the mean, or too many of the samples, could not be rolled out.
Mark = Literal["updated", "jump", "still", "gap", "diverged"]

UPDATES: Mapping[str, Update] = {"linearised": linearised_update, "logrank": logrank_update}

#: Fewer steps of the model than this are no window, and fewer samples tell no slopes.
LEAST, LEAST_SAMPLES = 5, 4


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What is believed after one window.

    Args:
        time: Of the window's last instant [s], on the log's clock.
        theta: Parameters, shape (d,).
        sd: Their standard deviations in the same units, shape (d,).
        lower, upper: Central 90 % intervals, shape (d,).
        belief: The same with its covariance.
        mark: What became of the window.
        misfit: Rms residual before the update, in noise sd; NaN where nothing was rolled out.
        excitation: Rms move of the predictions under the samples, in noise sd; NaN likewise.
        rollouts, diverged: How many were run, and how many of them diverged.
        update_ms: Time that the update took [ms].
    """

    time: float
    theta: FloatArray
    sd: FloatArray
    lower: FloatArray
    upper: FloatArray
    belief: Belief
    mark: Mark
    misfit: float
    excitation: float
    rollouts: int
    diverged: int
    update_ms: float

    @property
    def updated(self) -> bool:
        """The window moved the belief."""
        return self.mark in ("updated", "jump")


def check_window(settings: MheSettings, dt: float) -> None:
    """A window must hold a few steps of the model, `dt` [s] each, and updates must be a step apart.

    Raises:
        ConfigError: It holds fewer, or they are not.
    """
    if round(settings.window / dt) < LEAST:
        raise ConfigError(
            f"a window of {settings.window:g} s is too short: it takes at least {LEAST} steps of the model, "
            f"{LEAST * dt:g} s"
        )
    if round(settings.update_period / dt) < 1:
        raise ConfigError(
            f"an update period of {settings.update_period:g} s is too short: the model's step is {dt:g} s"
        )


class MovingHorizon:
    """The estimator: windows in, estimates out; Algorithm 1's lines 6 to 9 as seen from the buffer.

    Args:
        system: Model, parameters, signals, settings.
        engine: Rollout engine.
        rng: For samples.
        belief: To start from; None: the system's prior.
    """

    def __init__(
        self, system: System, engine: RolloutEngine, rng: np.random.Generator, belief: Belief | None = None
    ) -> None:
        self._system, self._engine, self._rng = system, engine, rng
        self._settings = system.settings.mhe
        self._update = UPDATES[self._settings.method]
        self._arrival = arrival_of(system.space, belief, self._settings.start_sd)
        self._noise = Noise()
        self._row = 0
        self._last: float | None = None
        self._took = (0.0, 0.0)

    def update(self, window: Window, at: float, budget: float | None = None) -> Estimate:
        """Learn from the newest window.

        A window that says nothing leaves the belief where it is, and less sure. Where windows want the
        parameters far from it, something has jumped: the linearised update learns with a wider belief.

        Args:
            window: Its signals must be valid at its start; gaps inside are allowed for by their masks.
            at: Time of its last instant [s].
            budget: Most time that it may take [s]: no iteration begins after that, and it has no more samples
                than the time per rollout of the update before allows.
        """
        begun = time.perf_counter()
        setting, space = self._settings, self._system.space
        elapsed = min(setting.update_period, window.duration) if self._last is None else at - self._last
        self._last = at
        self._arrival = self._arrival.widened(space.drift**2 * elapsed)
        if not usable(self._system, window):
            self._row = 0
            return self._estimate(at, "gap", None, begun)
        cost = MatchingCost(self._system, [window], self._engine, self._system.settings.cost)
        share = min(1.0, elapsed / window.duration)
        late = _never if budget is None else (lambda: time.perf_counter() - begun > budget)
        samples = self._affordable(budget)
        outcome = self._update(
            Task(cost, self._arrival, self._surprised, self._noise, share, setting, samples, self._rng, late)
        )
        self._took = self._timed(outcome, samples, time.perf_counter() - begun)
        return self._estimate(at, self._judge(outcome), outcome, begun)

    def _timed(self, outcome: Outcome, samples: int, seconds: float) -> tuple[float, float]:
        """Seconds per rollout, and rollouts of an iteration beside the samples that were asked for."""
        each = outcome.rollouts / outcome.iterations
        return seconds / outcome.rollouts, max(0.0, each - samples)

    def _affordable(self, budget: float | None) -> int:
        """Samples of an iteration, in pairs."""
        most, (pace, beside) = self._settings.sample_count, self._took
        if budget is None or not pace:
            return most
        return int(np.clip(2 * ((budget / pace - beside) // 2), LEAST_SAMPLES, most))

    def _judge(self, outcome: Outcome) -> Mark:
        """Take the outcome in, or leave it."""
        jumped, row = self._jumped(outcome.surprise), self._row + 1
        self._row = 0
        if not np.isfinite(outcome.before + outcome.after):
            return "diverged"
        self._row = row if outcome.surprise > self._settings.jump else 0
        if outcome.excitation < self._settings.excitation and not jumped:
            return "still"
        self._arrival, self._noise = outcome.arrival, outcome.noise
        return "jump" if jumped else "updated"

    def _jumped(self, surprise: float) -> bool:
        """Whether a window that wants the parameters so many sd off is the last of enough in a row."""
        return surprise > self._settings.jump and self._row + 1 >= self._settings.jump_windows

    def _surprised(self, surprise: float) -> Arrival:
        """The belief before a window, in whose light the window is seen."""
        if not self._jumped(surprise):
            return self._arrival
        return self._arrival.widened(np.full(len(self._system.space), self._settings.jump_sd**2))

    def _estimate(self, at: float, mark: Mark, outcome: Outcome | None, begun: float) -> Estimate:
        space = self._system.space
        arrival = reported(space, self._arrival, self._settings.systematic)
        theta = space.theta_of(arrival.z)
        phi_sd = arrival.sd * space.prior_sd
        lower, upper = (
            space.theta_of(space.clip(arrival.z + side * Z90 * arrival.sd)) for side in (-1.0, 1.0)
        )
        return Estimate(
            time=at,
            theta=theta,
            sd=np.where(space.log, theta * phi_sd, phi_sd),
            lower=lower,
            upper=upper,
            belief=belief_of(self._system.name, space, arrival.z, arrival.covariance, {}),
            mark=mark,
            misfit=outcome.before if outcome else np.nan,
            excitation=outcome.excitation if outcome else np.nan,
            rollouts=outcome.rollouts if outcome else 0,
            diverged=outcome.diverged if outcome else 0,
            update_ms=1e3 * (time.perf_counter() - begun),
        )


def usable(system: System, window: Window) -> bool:
    """Whether every signal is known at the window's start, and the inputs all through it."""
    log = window.log
    if window.start < 0 or window.stop >= log.steps:
        return False
    starts = all(log[c.key].valid[window.start] for c in system.channels if c.sets_state)
    driven = all(log[i.key].valid[window.start : window.stop].all() for i in system.inputs)
    after = slice(window.start + 1, window.stop + 1)
    compared = [log[c.key] for c in system.channels if c.compared]
    seen = any((s.sampled[after] & s.valid[after]).any() for s in compared if not s.derived)
    return starts and driven and seen


def _never() -> bool:
    return False
