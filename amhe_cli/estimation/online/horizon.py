"""Moving-horizon estimation: one window after the other updates a belief."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, belief_of
from amhe_cli.core.errors import ConfigError, LogError
from amhe_cli.core.log import Window
from amhe_cli.core.settings import MheSettings
from amhe_cli.core.statistics import Z90
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.online.updates import (
    Noise,
    Outcome,
    WindowFit,
    WindowProblem,
    fit_window,
    kept_error,
    linearised_update,
    logrank_update,
    prior_of,
)
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

#: How a window was used. 'jump': the parameters had jumped, and it updated an inflated prior. The others were
#: skipped. 'still': too little excitation; 'gap': a signal is missing; 'diverged': the rollout of the mean
#: diverged, or too many of the samples did.
Mark = Literal["updated", "jump", "still", "gap", "diverged"]

#: Fewest steps of the model in a window.
LEAST = 5
#: Fewest samples that determine slopes.
LEAST_SAMPLES = 4
#: Every so many updates a number's effect on a window is computed anew, which takes a rollout: a few of the
#: numbers in each update, all in the first.
_EVERY = 10


@dataclass(slots=True, eq=False)
class Considered:
    """Uncertainty of held parameters that somebody measured (Schmidt's consider filter); changes in place.

    Schmidt's filter (1966): a number c ~ N(0, 1) that the model has wrong by c of its sd moves each window's
    own estimate by T c, and the recursion passes on the error s c of the estimate. With K = I - gain M of an
    update

        s  <-  K s + (I - K) T,        T = -(M + I)^-1 G' W dr/dc

    The same c acts in all windows, so that s s' does not average out.

    Args:
        system: The system, with its held parameters.
        engine: Engine of the rollouts.
    """

    system: System
    engine: Engine
    _variants: list[tuple[System, Engine]] | None = None
    _own: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _error: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _updates: int = 0

    @property
    def covariance(self) -> FloatArray | float:
        """Covariance of z that is due to held parameters, shape (d, d); 0 where nobody measured any."""
        return self._error @ self._error.T if self._error.size else 0.0

    def after(self, cost: MatchingCost, z: FloatArray, fit: WindowFit, kept: FloatArray) -> None:
        """Take in an update.

        Args:
            cost: Matching cost of its window.
            z: Where the window was linearised, shape (d,).
            fit: The window, linearised.
            kept: How much of an error before the update is left after it, shape (d, d).
        """
        if self._variants is None:
            held = [(p.name, held.value + held.sd) for p, held, _, _ in self.system.edits.considered()]
            moved = [self.system.fixing({name: value}) for name, value in held]
            self._variants = [(one, self.engine.upon(one.model, one.edits)) for one in moved]
            self._error, self._own = np.zeros((2, z.size, len(self._variants)))
        if not self._variants:
            return
        number = len(self._variants)
        due = range(self._updates % _EVERY, number, _EVERY) if self._updates else range(number)
        for column in due:
            self._own[:, column] = self._of_window(self._variants[column], cost, z, fit)
        self._updates += 1
        self._error = kept @ self._error + (np.eye(z.size) - kept) @ self._own

    @staticmethod
    def _of_window(
        variant: tuple[System, Engine], cost: MatchingCost, z: FloatArray, fit: WindowFit
    ) -> FloatArray:
        """A column of T: how far a number of the variant moves the window's own estimate, shape (d,)."""
        (system, engine), info = variant, fit.information
        assert info is not None
        after = cost.upon(engine, system).residuals(z[None])
        if not after.completed.all():
            return np.zeros(z.size)
        pull = fit.slope @ (info.weight[0] * (after.flat[0] - fit.slopes.residual)[0])
        return -np.linalg.solve(info.matrix[0] + np.eye(z.size), pull)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Parameters after one window.

    Args:
        time: Time of the window's last instant [s].
        theta: Parameters, shape (d,).
        sd: Standard deviations of theta, shape (d,).
        lower, upper: Central 90 % intervals, shape (d,).
        belief: Parameters with their covariance.
        mark: How the window was used.
        misfit: Rms residual before the update, in noise sd; NaN where nothing was rolled out.
        excitation: Rms change of the predictions under the samples, in noise sd; NaN where nothing was rolled
            out.
        rollouts, diverged: Number of rollouts, and how many of them diverged.
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
    def values(self) -> dict[str, float]:
        """Estimated parameters by name."""
        return dict(zip(self.belief.names, map(float, self.theta), strict=True))

    @property
    def updated(self) -> bool:
        """Whether the window changed the estimate."""
        return self.mark in ("updated", "jump")


def check_window(settings: MheSettings, dt: float) -> None:
    """Check that a window holds a few steps of the model, `dt` [s] each, and that updates are a step apart.

    Raises:
        ConfigError: The window or the update period is too short.
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


@dataclass(frozen=True, slots=True)
class Pace:
    """Speed of the last update, from which a budget of time becomes a number of samples.

    Args:
        rollout: Time of a rollout [s]; 0 before the first update.
        fixed: Rollouts of an iteration in addition to the requested samples.
    """

    rollout: float = 0.0
    fixed: float = 0.0

    @staticmethod
    def of(seconds: float, samples: int, outcome: Outcome) -> Pace:
        """Pace of an update that took some time and requested so many samples an iteration."""
        each = outcome.rollouts / outcome.iterations
        return Pace(seconds / outcome.rollouts, max(0.0, each - samples))

    def affordable(self, budget: float | None, most: int) -> int:
        """Samples of an iteration, in pairs, that fit a budget [s]; None: no limit."""
        if budget is None or not self.rollout:
            return most
        return int(np.clip(2 * ((budget / self.rollout - self.fixed) // 2), LEAST_SAMPLES, most))


class MovingHorizon:
    """The online estimator: windows in, estimates out (lines 6 to 9 of Algorithm 1).

    Args:
        system: Model, parameters, signals, settings.
        engine: Engine of the rollouts.
        rng: Generator of the samples.
        belief: Belief to start from; None: the system's prior.
    """

    def __init__(
        self, system: System, engine: Engine, rng: np.random.Generator, belief: Belief | None = None
    ) -> None:
        self._system, self._engine, self._rng = system, engine, rng
        self._settings = setting = system.settings.mhe
        # what passes from window to window
        self._belief = prior_of(system.space, belief, setting.start_sd)
        self._noise = Noise()
        self._far = 0  # windows in a row that are far from the prior: a single one may be a missed contact
        self._pace = Pace()
        self._last: float | None = None
        self._considered = Considered(system, engine)

    def update(self, window: Window, at: float, budget: float | None = None) -> Estimate:
        """Learn from the newest window.

        A window with too little excitation leaves the mean where it is, and its covariance grows by the
        parameters' drift. After a jump, the linearised update starts from an inflated prior.

        Args:
            window: The window. Signals must be valid at its start; gaps inside are masked.
            at: Time of its last instant [s].
            budget: Most time that the update may take [s]; None: no limit. No iteration begins after it, and
                the samples are as many as the pace of the last update allows.
        """
        begun = time.perf_counter()
        setting = self._settings
        elapsed = min(setting.update_period, window.duration) if self._last is None else at - self._last
        self._last = at
        self._belief = self._belief.inflated(self._system.space.drift**2 * elapsed)
        cost = cost_of(self._system, window, self._engine)
        if cost is None:
            self._far = 0
            return self._estimate(at, "gap", None, begun)
        problem = WindowProblem(
            cost=cost,
            prior=self._belief,
            noise=self._noise,
            share=min(1.0, elapsed / window.duration),
            settings=setting,
            samples=self._pace.affordable(budget, setting.sample_count),
            rng=self._rng,
            late=lambda: budget is not None and time.perf_counter() - begun > budget,
        )
        outcome = self._learn(problem)
        self._pace = Pace.of(time.perf_counter() - begun, problem.samples, outcome)
        return self._estimate(at, self._accept(outcome), outcome, begun)

    def _learn(self, problem: WindowProblem) -> Outcome:
        """Decide whether the parameters have jumped, and update from the prior that follows from it."""
        setting, prior = self._settings, problem.prior
        if setting.method == "logrank":
            return logrank_update(problem)
        fit = fit_window(problem, prior.z)
        self._far = self._far + 1 if fit.innovation > setting.jump else 0
        if self._jumped:
            prior = prior.inflated(np.full(prior.z.size, setting.jump_sd**2))
        outcome = linearised_update(problem, fit, prior)
        excited = outcome.excitation >= setting.excitation and np.isfinite(outcome.before + outcome.after)
        if fit.information is not None and excited:
            kept = kept_error(problem, prior, fit.information)
            self._considered.after(problem.cost, problem.prior.z, fit, kept)
        return outcome

    def _accept(self, outcome: Outcome) -> Mark:
        """Take over the outcome, unless the window diverged or has too little excitation."""
        if not np.isfinite(outcome.before + outcome.after):
            self._far = 0
            return "diverged"
        if outcome.excitation < self._settings.excitation and not self._jumped:
            return "still"
        self._belief, self._noise = outcome.belief, outcome.noise
        return "jump" if self._jumped else "updated"

    @property
    def _jumped(self) -> bool:
        return self._far >= self._settings.jump_windows

    def _estimate(self, at: float, mark: Mark, outcome: Outcome | None, begun: float) -> Estimate:
        space = self._system.space
        # the model's own error is the same in every window: it is reported, and passes on to none
        error = space.in_z([self._settings.systematic.get(name, 0.0) for name in space.names])
        covariance = self._belief.covariance + np.outer(error, error) + self._considered.covariance
        belief = replace(self._belief, covariance=covariance)
        theta = space.theta_of(belief.z)
        phi_sd = belief.sd * space.prior_sd
        lower, upper = (space.theta_of(space.clip(belief.z + side * Z90 * belief.sd)) for side in (-1.0, 1.0))
        return Estimate(
            time=at,
            theta=theta,
            sd=np.where(space.log, theta * phi_sd, phi_sd),
            lower=lower,
            upper=upper,
            belief=belief_of(self._system, belief.z, belief.covariance),
            mark=mark,
            misfit=outcome.before if outcome else np.nan,
            excitation=outcome.excitation if outcome else np.nan,
            rollouts=outcome.rollouts if outcome else 0,
            diverged=outcome.diverged if outcome else 0,
            update_ms=1e3 * (time.perf_counter() - begun),
        )


def cost_of(system: System, window: Window, engine: Engine) -> MatchingCost | None:
    """The matching cost on one window, as it was known at its end; None where a signal is missing.

    Where efforts are matched, the motion is smoothed over the window and as much before it.
    """
    if not usable(system, window):
        return None
    if system.match == "effort":
        window = window.alone(window.length)
    try:
        cost = MatchingCost(system, [window], engine, system.settings.cost)
    except LogError:  # too few positions without a gap make no motion
        return None
    return cost if cost.clips.observed else None


def usable(system: System, window: Window) -> bool:
    """Whether every signal is known at the window's start, and the inputs all through it."""
    log = window.log
    if window.start < 0 or window.stop >= log.steps:
        return False
    starts = all(log[c.key].valid[window.start] for c in system.channels if c.sets_state)
    needed = (key for source in system.inputs for key in source.keys)
    driven = all(log[key].valid[window.start : window.stop].all() for key in needed)
    after = slice(window.start + 1, window.stop + 1)
    compared = [log[c.key] for c in system.channels if c.compared]
    seen = any((s.sampled[after] & s.valid[after]).any() for s in compared if not s.derived)
    return starts and driven and seen
