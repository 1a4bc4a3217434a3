"""SPI's search as steps from state to state, so that it can be watched, cut short and resumed to the bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.trajectory import Window
from amhe_cli.estimation.linearised import (
    Information,
    Linearisation,
    information,
    linearise,
    objective,
    split,
)
from amhe_cli.estimation.problem import Problem, spread_floor
from amhe_cli.estimation.result import Iteration
from amhe_cli.matching import MatchingCost

Stage = Literal["explore", "polish", "done"]

#: Iterations on fixed tiles that end the linearised search.
POLISH = 6
#: A step below this share of the posterior sd has settled.
SETTLED = 0.1
#: Multiples of the Gauss-Newton step that are tried, which on rough costs is often too timid; 0 stays.
LINE = np.array([4.0, 2.0, 1.0, 0.5, 0.2, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where a linearised search stands; all that a checkpoint needs.

    Args:
        stage: 'explore' re-draws random clips each iteration, 'polish' uses every tile.
        number: Iterations done.
        z: Estimate, shape (d,).
        spread: Sampling sd, shape (d,).
        scale: Channel -> residual sd over declared noise sd.
        record: One entry an iteration.
    """

    stage: Stage
    number: int
    z: FloatArray
    spread: FloatArray
    scale: Mapping[str, float] = field(default_factory=dict)
    record: tuple[Iteration, ...] = ()

    @property
    def done(self) -> bool:
        """Nothing is left to do."""
        return self.stage == "done"


def start(problem: Problem) -> State:
    """The prior mean, and a spread of half the prior."""
    d = len(problem.system.space)
    return State("explore", 0, np.zeros(d), np.full(d, 0.5) * problem.active)


def total(problem: Problem, state: State) -> int:
    """Most iterations that the search may take."""
    return problem.settings.identify.iterations


def restart(problem: Problem, z: FloatArray) -> State:
    """Polishing from z (d,), for a problem that is part of a solved one."""
    return State("polish", 0, z, np.full(z.size, 0.25) * problem.active)


def advance(problem: Problem, state: State) -> State:
    """One iteration: draw clips, linearise, step, and decide what comes next."""
    setting = problem.settings.identify
    exploring = state.stage == "explore"
    rng = problem.rng(0, state.number)
    windows = problem.pool.draw(rng, problem.clip_count) if exploring else problem.tiles
    cost = problem.cost(windows, state.scale)
    first = np.zeros((len(windows), cost.nx if setting.first_state else 0))
    slopes = linearise(cost, state.z, first, state.spread, setting.samples, rng)
    found = information(slopes)
    floor = spread_floor(problem, slopes.roughness)
    taken = gauss_newton(problem, cost, state, found, windows, floor)
    scale = noise_scale(cost, found, state.scale)
    moved = np.abs(taken.z - state.z) / taken.sd
    settled = bool((moved < SETTLED).all()) and taken.spread_settled
    number = state.number + 1
    return replace(
        state,
        stage=_next_stage(state, number, settled, setting.iterations),
        number=number,
        z=taken.z,
        spread=taken.spread,
        scale=scale,
        record=(*state.record, _entry(problem, state, taken, slopes)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A Gauss-Newton step that was tried and accepted."""

    z: FloatArray
    sd: FloatArray  # posterior sd of z
    spread: FloatArray
    spread_settled: bool
    cost: float  # in units of the declared noise
    rollouts: int
    diverged: int


def gauss_newton(
    problem: Problem,
    cost: MatchingCost,
    state: State,
    found: Information,
    windows: Sequence[Window],
    floor: FloatArray,
) -> Step:
    """Step towards the minimum of the linearised cost plus prior; the true cost decides how far.

    Args:
        floor: Smallest sampling sd worth having, shape (d,).
    """
    weight = clip_weights(cost, found) * problem.coverage(windows)
    hessian = np.einsum("c,cij->ij", weight, found.matrix) + np.eye(state.z.size)
    gradient = np.einsum("c,ci->i", weight, found.score) + state.z
    step = -np.linalg.solve(hessian, gradient)
    sd = np.sqrt(np.diag(np.linalg.inv(hessian)))
    reach = np.abs(step) / np.maximum(3.0 * state.spread, 1e-12) * problem.active
    step = step * problem.active / max(1.0, reach.max())
    tried = problem.system.space.clip(state.z + LINE[:, None] * step)
    first = found.first(tried - state.z)
    residuals = cost.residuals(tried, first if first.shape[2] else None)
    values = objective(cost, residuals, first, found.times, weight) + (tried**2).sum(axis=1)
    best = int(np.argmin(values))
    wanted = 2.0 * state.spread if reach.max() > 1.0 else np.maximum(2.0 * sd, 0.6 * state.spread)
    spread = np.clip(wanted, floor, np.maximum(0.5, floor)) * problem.active
    declared = [state.scale.get(o.channel.key, 1.0) for o in cost.clips.observed]
    return Step(
        z=tried[best],
        sd=sd,
        spread=spread,
        spread_settled=bool((spread <= np.maximum(3.0 * sd, floor * 1.01)).all()),
        cost=float(cost.rescaled(residuals, declared)[best]),
        rollouts=residuals.completed.size,
        diverged=int((~residuals.completed).sum()),
    )


def clip_weights(cost: MatchingCost, found: Information) -> FloatArray:
    """1 for a clip that counts, 0 for one that diverged or is among the worst, shape (c,)."""
    weight = found.completed.astype(float)
    misfit = (found.residual**2).sum(axis=1) / cost.clips.counts
    drop = int(np.floor(cost.settings.trim * len(misfit)))
    if drop:
        weight[np.argsort(np.where(found.completed, misfit, np.inf))[-drop:]] = 0.0
    return weight


def noise_scale(cost: MatchingCost, found: Information, before: Mapping[str, float]) -> dict[str, float]:
    """Residual sd over declared noise sd of each channel, after the first states have been fitted."""
    keep = clip_weights(cost, found) > 0.0
    total = max(float(cost.clips.counts[keep].sum()), 1.0)
    spent = float((found.first_offset[keep] ** 2).sum()) / total  # what fitting the first states hid
    scale = {}
    for observed, values in zip(cost.clips.observed, split(cost, found.residual), strict=True):
        count = observed.mask[keep].sum() * observed.width
        misfit = (values[keep] ** 2).sum() / max(count, 1) + spent
        key = observed.channel.key
        scale[key] = float(before.get(key, 1.0) * np.sqrt(max(misfit, 1e-12)))
    return scale


def _next_stage(state: State, number: int, settled: bool, budget: int) -> Stage:
    if state.stage == "explore":
        return "polish" if (settled and number >= 3) or number >= budget - POLISH else "explore"
    return "done" if settled or number >= budget else "polish"


def _entry(problem: Problem, state: State, taken: Step, found: Linearisation) -> Iteration:
    return Iteration(
        number=state.number + 1,
        method=f"linearised, {state.stage}",
        cost=taken.cost,
        sigma=float(state.spread[problem.active].mean()) if problem.active.any() else 0.0,
        rollouts=found.rollouts + taken.rollouts,
        diverged=found.diverged + taken.diverged,
        theta=tuple(float(t) for t in problem.system.space.theta_of(taken.z)),
    )
