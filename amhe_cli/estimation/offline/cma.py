"""SPI's search as in the paper: CMA-ES (the `cmaes` package) over the matching cost and the prior."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.information import mean_squares, noise_scale
from amhe_cli.estimation.core.result import Iteration
from amhe_cli.estimation.offline.problem import Problem
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
        number: Iterations done.
        memory: MEMORY of the CMA; empty before its first generation.
        z: Its mean, shape (d,).
        scale: Channel -> residual sd over declared noise sd.
        record: One entry an iteration.
        done: Whether the search has finished.
    """

    number: int
    memory: Mapping[str, FloatArray]
    z: FloatArray
    scale: Mapping[str, float] = field(default_factory=dict)
    record: tuple[Iteration, ...] = ()
    done: bool = False


def start(problem: Problem) -> CmaState:
    """State before the first generation."""
    return CmaState(0, {}, np.zeros(len(problem.system.space)))


def total(problem: Problem, state: CmaState) -> int:
    """Expected number of iterations."""
    return problem.settings.identify.cmaes_iterations


def advance(problem: Problem, state: CmaState) -> CmaState:
    """One generation: draw clips, sample candidates, and update the optimizer by their costs."""
    rng = problem.rng(1, 0, state.number)
    windows = problem.drawn(rng, problem.clip_count)
    cost = problem.cost(windows, state.scale)
    optimizer = restored(problem, state, rng)
    free = np.flatnonzero(problem.active)
    candidates = np.zeros((optimizer.population_size + 1, state.z.size))
    candidates[:-1, free] = [optimizer.ask() for _ in range(optimizer.population_size)]
    candidates[-1, free] = optimizer.mean
    residuals = cost.residuals(candidates)
    worth = problem.coverage(windows) * cost.clips.counts.sum()
    costs = cost.costs_of(residuals)
    prior = problem.system.space.prior_precision
    values = worth * costs + quadratic_prior(candidates, np.zeros_like(state.z), prior)
    finite = np.where(np.isfinite(values), values, 1e300)  # cmaes sorts numbers
    optimizer.tell([(z[free], value) for z, value in zip(candidates[:-1], finite[:-1], strict=True)])
    mean = candidates[-1].copy()
    mean[free] = optimizer.mean
    memory = memory_of(optimizer)
    best = int(np.argmin(values))
    squares = mean_squares(cost, residuals.flat[best], np.ones(len(windows), dtype=bool))
    entry = Iteration(
        number=state.number + 1,
        method="cmaes",
        cost=float(cost.as_declared(residuals)[best]),
        sigma=float(memory["_sigma"] * np.sqrt(np.diag(memory["_C"])).mean()),
        rollouts=residuals.completed.size,
        diverged=int((~residuals.completed).sum()),
        theta=tuple(float(t) for t in problem.system.space.theta_of(mean)),
    )
    number = state.number + 1
    return CmaState(
        number,
        memory,
        z=mean,
        scale=noise_scale(squares, state.scale),
        record=(*state.record, entry),
        done=number >= problem.settings.identify.cmaes_iterations or bool(optimizer.should_stop()),
    )


def restored(problem: Problem, state: CmaState, rng: np.random.Generator) -> CMA:
    """The optimizer after the last generation, with a generator of this generation's own."""
    from cmaes import CMA  # it loads all of scipy.stats, for a second

    free = np.flatnonzero(problem.active)
    lower, upper = problem.system.space.bounds
    optimizer = CMA(
        mean=np.clip(np.zeros(free.size), lower[free] + 1e-9, upper[free] - 1e-9),
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
