"""SPI's search as in the paper: CMA-ES (the `cmaes` package) over the matching cost and the prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.information import mean_squares, noise_scale
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.matching.cost import quadratic_prior

if TYPE_CHECKING:
    from cmaes import CMA

#: Private attributes that a `cmaes.CMA` changes from generation to generation. The package cannot save them
#: other than by pickle, which no file is ever loaded from.
MEMORY = ("_mean", "_C", "_sigma", "_p_sigma", "_pc", "_g", "_funhist_values")


@dataclass(frozen=True, slots=True, eq=False)
class CmaState:
    """State of a CMA-ES search between two iterations; a checkpoint holds just this.

    Args:
        start: Number of the current start, from 0.
        starts: How many there are.
        number: Iterations done, of all starts.
        generation: Iterations done of this start.
        memory: MEMORY of the current start's CMA; empty before its first generation.
        best_value: Cost of z on all clips; inf before the first start is finished.
        z: Best of the finished starts and of the search before them; else the mean of the first start. It is
            the result if the search is stopped here, shape (d,).
        scale: Channel -> residual sd over declared noise sd.
        record: One entry an iteration.
        done: Whether the search has finished.
    """

    start: int
    starts: int
    number: int
    generation: int
    memory: Mapping[str, FloatArray]
    best_value: float
    z: FloatArray
    scale: Mapping[str, float] = field(default_factory=dict)
    record: tuple[Iteration, ...] = ()
    done: bool = False


def start(problem: Problem, starts: int, after: SearchState | None = None) -> CmaState:
    """State before the first generation.

    Args:
        problem: The problem.
        starts: Number of starts.
        after: A linearised search that failed: its record is continued, and its estimate is beaten or kept.
    """
    zero = np.zeros(len(problem.system.space))
    state = CmaState(0, starts, 0, 0, {}, np.inf, zero)
    if after is None:
        return state
    known = np.stack((after.z, zero))
    values = _on_clips(problem, known)
    best = int(np.argmin(values))
    return replace(
        state,
        number=after.number,
        record=after.record,
        scale=after.scale,
        z=known[best],
        best_value=float(values[best]),
    )


def total(problem: Problem, state: CmaState) -> int:
    """Expected number of iterations."""
    return (
        state.number
        - state.generation
        + (state.starts - state.start) * problem.settings.identify.cmaes_iterations
    )


def advance(problem: Problem, state: CmaState) -> CmaState:
    """One generation: draw clips, sample candidates, and update the optimizer by their costs."""
    rng = problem.rng(1, state.start, state.generation)
    windows = problem.drawn(rng, problem.clip_count)
    cost = problem.cost(windows, state.scale)
    optimizer = _restored(problem, state, rng)
    free = np.flatnonzero(problem.active)
    candidates = np.zeros((optimizer.population_size + 1, state.z.size))
    candidates[:-1, free] = [optimizer.ask() for _ in range(optimizer.population_size)]
    candidates[-1, free] = optimizer.mean
    residuals = cost.residuals(candidates)
    worth = problem.coverage(windows) * cost.clips.counts.sum()
    costs = cost.rescaled(residuals, [1.0] * len(cost.clips.observed))
    costs = np.where(residuals.completed.all(axis=1), costs, np.inf)
    prior = problem.system.space.prior_precision
    values = worth * costs + quadratic_prior(candidates, np.zeros_like(state.z), prior)
    finite = np.where(np.isfinite(values), values, 1e300)  # cmaes sorts numbers
    optimizer.tell([(z[free], value) for z, value in zip(candidates[:-1], finite[:-1], strict=True)])
    mean = candidates[-1].copy()
    mean[free] = optimizer.mean
    memory = memory_of(optimizer)
    declared = [state.scale.get(o.channel.key, 1.0) for o in cost.clips.observed]
    best = int(np.argmin(values))
    squares = mean_squares(cost, residuals.flat[best], np.ones(len(windows), dtype=bool))
    entry = Iteration(
        number=state.number + 1,
        method=f"cmaes, start {state.start + 1}",
        cost=float(cost.rescaled(residuals, declared)[best]),
        sigma=float(memory["_sigma"] * np.sqrt(np.diag(memory["_C"])).mean()),
        rollouts=residuals.completed.size,
        diverged=int((~residuals.completed).sum()),
        theta=tuple(float(t) for t in problem.system.space.theta_of(mean)),
    )
    moved = replace(
        state,
        number=state.number + 1,
        generation=state.generation + 1,
        memory=memory,
        z=mean if np.isinf(state.best_value) else state.z,
        scale=noise_scale(squares, state.scale),
        record=(*state.record, entry),
    )
    over = moved.generation >= problem.settings.identify.cmaes_iterations or optimizer.should_stop()
    return _finish_start(problem, moved, mean) if over else moved


def _restored(problem: Problem, state: CmaState, rng: np.random.Generator) -> CMA:
    """The optimizer after the last generation, with a generator of this generation's own."""
    from cmaes import CMA  # it loads all of scipy.stats, for a second

    free = np.flatnonzero(problem.active)
    lower, upper = problem.system.space.bounds
    mean = np.zeros(free.size)
    if state.start:
        mean = problem.rng(2, state.start).normal(0.0, 0.7, free.size)
    optimizer = CMA(
        mean=np.clip(mean, lower[free] + 1e-9, upper[free] - 1e-9),
        sigma=0.5,
        bounds=np.stack((lower[free], upper[free]), axis=1),
        seed=int(rng.integers(2**31)),
        population_size=problem.settings.identify.samples,
    )
    restore(optimizer, state.memory)
    return optimizer


def memory_of(optimizer: CMA) -> dict[str, FloatArray]:
    """MEMORY of an optimizer, as arrays."""
    return {name: np.array(getattr(optimizer, name), dtype=float) for name in MEMORY}


def restore(optimizer: CMA, memory: Mapping[str, FloatArray]) -> None:
    """Set MEMORY of a new optimizer; scalars keep the type that the package gave them."""
    for name, value in memory.items():
        setattr(optimizer, name, value if value.ndim else type(getattr(optimizer, name))(value))


def _on_clips(problem: Problem, z: FloatArray) -> FloatArray:
    """Cost of candidates (p, d) on all clips, with the prior, shape (p,), by which starts are compared."""
    cost = problem.cost(problem.clips)
    prior = quadratic_prior(z, np.zeros(z.shape[1]), problem.system.space.prior_precision)
    return cost.costs(z) + prior / cost.clips.counts.sum()


def _finish_start(problem: Problem, state: CmaState, mean: FloatArray) -> CmaState:
    """End a start: keep its mean if that is better than the best so far."""
    value = float(_on_clips(problem, mean[None])[0])
    better = value < state.best_value
    return replace(
        state,
        start=state.start + 1,
        generation=0,
        memory={},
        z=mean if better else state.z,
        best_value=min(value, state.best_value),
        done=state.start + 1 >= state.starts,
    )
