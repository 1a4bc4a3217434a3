"""A close look at an estimate: the linearisation from which its uncertainty is taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.trajectory import Window
from amhe_cli.estimation import cma, search
from amhe_cli.estimation.linearised import Information, Linearisation, information, linearise, objective
from amhe_cli.estimation.posterior import Posterior, posterior
from amhe_cli.estimation.problem import Problem, spread_floor
from amhe_cli.estimation.shape import bounded, changed, diagonal, sampling_sd

#: What a search ends with.
Finding = search.State | cma.State

#: Linearisations until the shape of the samples is that of the posterior, and the sd of the first [prior sd].
TURNS, SMALL = 4, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The final linearisation on the tiles, and what it says."""

    slopes: Linearisation
    found: Information
    weight: FloatArray
    posterior: Posterior
    shape: FloatArray
    scale: Mapping[str, float]
    z: FloatArray

    def cost_beside(self, z: FloatArray) -> FloatArray:
        """Mean cost of candidates z (p, d) near the estimate, first states fitted along, shape (p,)."""
        cost = self.slopes.cost
        first = self.found.first(z - self.z)
        residuals = cost.residuals(z, first if first.shape[2] else None)
        counted = (self.weight > 0.0).astype(float)
        total = objective(cost, residuals, first, (1.0,) * len(self.found.times), counted)
        return total / max(float((counted * cost.clips.counts).sum()), 1.0)


def study_of(problem: Problem, finding: Finding) -> Study:
    """Linearise at the estimate, in the shape of the posterior, which the linearisation itself gives."""
    prior = problem.system.space.prior_precision
    coverage = problem.coverage(problem.tiles)
    floor = spread_floor(problem)
    shape = finding.shape if isinstance(finding, search.State) else diagonal(SMALL, problem.active)
    scale = finding.scale
    for turn in range(TURNS):
        slopes = _linearised(problem, finding, scale, shape, turn)
        found = information(slopes)
        weight = search.clip_weights(slopes.cost, found) * coverage
        study = Study(
            slopes, found, weight, posterior(finding.z, found, weight, prior), shape, scale, finding.z
        )
        wanted = bounded(4.0 * study.posterior.covariance, floor, problem.active)
        known = turn > 0 or problem.rough  # of a rough cost: by the search's own last steps, in this shape
        if known and not changed(sampling_sd(shape), sampling_sd(wanted)):
            break
        shape, scale = wanted, search.noise_scale(slopes.cost, found, scale)
    return study


def step_ratio(problem: Problem, finding: Finding, study: Study) -> FloatArray:
    """Posterior sd at the step over that at a doubled step, shape (d,): 1 where the model is linear."""
    found = information(_linearised(problem, finding, study.scale, 2.0 * study.shape, TURNS))
    doubled = posterior(finding.z, found, study.weight, problem.system.space.prior_precision)
    return np.where(problem.active, study.posterior.sd / doubled.sd, np.nan)


def _linearised(
    problem: Problem, finding: Finding, scale: Mapping[str, float], shape: FloatArray, place: int
) -> Linearisation:
    cost = problem.cost(problem.tiles, scale)
    first = np.zeros((len(problem.tiles), cost.nx if problem.settings.identify.first_state != "never" else 0))
    samples = problem.settings.identify.samples
    return linearise(cost, finding.z, first, shape, samples, problem.rng(3, place))


def thinned(problem: Problem, rows: IntArray) -> tuple[Window, ...]:
    """The tiles of these rows, evenly thinned to what one iteration takes."""
    most = problem.settings.clips.count
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    return tuple(problem.tiles[i] for i in rows)
