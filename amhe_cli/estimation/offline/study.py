"""A close look at an estimate: the linearisation from which its uncertainty is taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.information import (
    Information,
    channel_times,
    clip_weights,
    fitted_noise_scale,
    information,
    objective,
)
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, linearise
from amhe_cli.estimation.core.shape import bounded, changed, diagonal, sampling_sd
from amhe_cli.estimation.offline import cma, search
from amhe_cli.estimation.offline.posterior import Posterior, posterior
from amhe_cli.estimation.offline.problem import Problem, first_floor, spread_floor

#: What a search ends with.
Finding = search.State | cma.State

#: Linearisations until the shape of the samples is that of the posterior, and the sd of the first [prior sd].
TURNS, SMALL = 4, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The final linearisation on the tiles, and what it says.

    Args:
        slopes, found: Linearisation, and the information it is worth.
        weight: How often each tile counts, shape (c,).
        posterior: Of z.
        shape: Of the samples of z.
        scale: Channel -> residual sd over declared noise sd.
        z: Where, shape (d,).
    """

    slopes: Linearisation
    found: Information
    weight: FloatArray
    posterior: Posterior
    shape: FloatArray
    scale: Mapping[str, float]
    z: FloatArray

    @property
    def times(self) -> tuple[float, ...]:
        """Autocorrelation time of each channel's residuals, in samples."""
        return channel_times(self.slopes.cost, self.found.residual, self.slopes.completed)

    def cost_beside(self, z: FloatArray) -> FloatArray:
        """Mean cost of candidates z (p, d) near the estimate, first states fitted along, shape (p,)."""
        cost = self.slopes.cost
        first = self.found.first(z - self.z)
        residuals = cost.residuals(z, first if first.shape[2] else None)
        counted = (self.weight > 0.0).astype(float)
        total = objective(cost, residuals, first, (1.0,) * len(residuals.values), counted)
        return total / max(float((counted * cost.clips.counts).sum()), 1.0)


def study_of(problem: Problem, finding: Finding) -> Study:
    """Linearise at the estimate, in the shape of the posterior, which the linearisation itself gives."""
    prior = problem.system.space.prior_precision
    coverage = problem.coverage(problem.tiles)
    floor = spread_floor(problem)
    searched = isinstance(finding, search.State)
    shape = finding.shape if searched else diagonal(SMALL, problem.active)
    scale, first = finding.scale, finding.first if searched else None
    # of a rough cost they are known by the search's own last steps, in this shape
    known = problem.rough and first is not None
    for turn in range(TURNS):
        slopes = _linearised(problem, finding, scale, shape, first, turn)
        found = information(slopes)
        weight = clip_weights(slopes, found) * coverage
        study = Study(
            slopes, found, weight, posterior(finding.z, found, weight, prior), shape, scale, finding.z
        )
        wanted = bounded(4.0 * study.posterior.covariance, floor, problem.active)
        if known and not changed(sampling_sd(shape), sampling_sd(wanted)):
            break
        shape, scale, known = wanted, fitted_noise_scale(slopes, found, scale), True
        first = found.first_states(np.zeros_like(finding.z), first_floor(problem))
    return study


def step_ratio(problem: Problem, finding: Finding, study: Study) -> FloatArray:
    """Posterior sd at the step over that at a doubled step, shape (d,): 1 where the model is linear."""
    first = study.slopes.first
    found = information(_linearised(problem, finding, study.scale, 2.0 * study.shape, first, TURNS))
    doubled = posterior(finding.z, found, study.weight, problem.system.space.prior_precision)
    return np.where(problem.active, study.posterior.sd / doubled.sd, np.nan)


def _linearised(
    problem: Problem,
    finding: Finding,
    scale: Mapping[str, float],
    shape: FloatArray,
    first: FirstStates | None,
    place: int,
) -> Linearisation:
    cost = problem.cost(problem.tiles, scale)
    fitted = problem.settings.identify.first_state != "never"
    at = first or FirstStates.recorded(len(problem.tiles), cost.nx if fitted else 0)
    samples = problem.settings.identify.samples
    return linearise(cost, finding.z, at, shape, samples, problem.rng(3, place), averaged=problem.rough)
