"""A close look at an estimate: the linearisation from which its uncertainty is taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.trajectory import Window
from amhe_cli.estimation import cma, search
from amhe_cli.estimation.linearised import Information, Linearisation, information, linearise
from amhe_cli.estimation.posterior import Posterior, posterior
from amhe_cli.estimation.problem import ROUGH, Problem, spread_floor

#: What a search ends with.
Finding = search.State | cma.State


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The final linearisation on the tiles, and what it says."""

    slopes: Linearisation
    found: Information
    weight: FloatArray
    posterior: Posterior
    spread: FloatArray
    scale: Mapping[str, float]


def study_of(problem: Problem, finding: Finding) -> Study:
    """Linearise at the estimate: to learn the noise and how rough the cost is, then at a step that suits."""
    coverage = problem.coverage(problem.tiles)
    spread = spread_floor(problem, np.inf) * problem.active
    slopes = _linearised(problem, finding, finding.scale, spread, 0)
    found = information(slopes)
    if slopes.roughness <= ROUGH:
        sd = posterior(finding.z, found, search.clip_weights(slopes.cost, found) * coverage).sd
        spread = np.clip(2.0 * sd, spread_floor(problem, slopes.roughness), spread) * problem.active
    scale = search.noise_scale(slopes.cost, found, finding.scale)
    slopes = _linearised(problem, finding, scale, spread, 1)
    found = information(slopes)
    weight = search.clip_weights(slopes.cost, found) * coverage
    return Study(slopes, found, weight, posterior(finding.z, found, weight), spread, scale)


def step_ratio(problem: Problem, finding: Finding, study: Study) -> FloatArray:
    """Sqrt of each parameter's information at a doubled step over that at the step, shape (d,)."""
    doubled = information(_linearised(problem, finding, study.scale, 2.0 * study.spread, 2))
    data = np.einsum("c,cii->i", study.weight, study.found.matrix)
    return np.sqrt(np.einsum("c,cii->i", study.weight, doubled.matrix) / np.where(data > 0.0, data, np.nan))


def _linearised(
    problem: Problem, finding: Finding, scale: Mapping[str, float], spread: FloatArray, place: int
) -> Linearisation:
    cost = problem.cost(problem.tiles, scale)
    first = np.zeros((len(problem.tiles), cost.nx if problem.settings.identify.first_state else 0))
    samples = problem.settings.identify.samples
    return linearise(cost, finding.z, first, spread, samples, problem.rng(3, place))


def thinned(problem: Problem, rows: IntArray) -> tuple[Window, ...]:
    """The tiles of these rows, evenly thinned to what one iteration takes."""
    most = problem.settings.clips.count
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    return tuple(problem.tiles[i] for i in rows)
