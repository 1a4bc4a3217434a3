"""The sampled posterior: draws under the true cost of the clips, where the linearised one is a Gaussian.

Both weigh the residuals alike: by the robust loss, their autocorrelation, and the samples' bend at the
estimate. They are the same where the residuals are linear in the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, namespace_of, to_host
from amhe_cli.estimation.core.annealed import draw
from amhe_cli.estimation.offline.posterior import FinalFit
from amhe_cli.estimation.offline.problem import Problem

#: Residuals of candidates that are computed together take at most so many bytes.
AT_ONCE = 256 * 2**20
#: Evaluations of a likelihood for each draw that are usual, for the time that they will take.
USUAL = 15
#: Share of the draws that must be effective.
ENOUGH = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class SampledPosterior:
    """Draws of z from the posterior under the true cost.

    Args:
        z: The draws, shape (n, d).
        effective: Number of independent draws that they are worth.
        rollouts: Rollouts that they took.
    """

    z: FloatArray
    effective: float
    rollouts: int

    def spread(self, problem: Problem, fit: FinalFit, covariance: FloatArray) -> FloatArray:
        """The draws with what a covariance (d, d) has beyond noise added to them, shape (n, d).

        Errors of the model have no likelihood: as in the linearised posterior they are Gaussian.
        """
        more = covariance - np.linalg.inv(fit.posterior.hessian)
        values, vectors = np.linalg.eigh(more)
        normal = problem.rng(10).standard_normal(self.z.shape)
        return problem.system.space.clip(self.z + normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T)


def sampled_posterior(problem: Problem, fit: FinalFit) -> SampledPosterior:
    """Draw from the posterior of the clips, from all of the prior."""
    cost, space = fit.slopes.cost, problem.system.space
    clips, residuals = fit.found.weight.shape
    block = max(1, AT_ONCE // (8 * clips * residuals))

    def likelihood(z: FloatArray) -> FloatArray:
        return np.concatenate([_likelihood(fit, z[i : i + block]) for i in range(0, len(z), block)])

    drawn = draw(
        likelihood,
        space.prior_covariance,
        space.bounds,
        problem.settings.identify.draws,
        problem.rng(8),
    )
    return SampledPosterior(drawn.z, drawn.effective, drawn.evaluations * len(cost.clips.windows))


def _likelihood(fit: FinalFit, z: FloatArray) -> FloatArray:
    """Log-likelihood of candidates z (n, d), the first states fitted along, shape (n,).

    First states follow z as linearised; what of the residuals they could still absorb, by their slopes at the
    estimate, is no misfit.
    """
    found, slopes = fit.found, fit.slopes
    first = found.first(z - fit.z)
    nx = first.shape[2]
    residuals = slopes.cost.residuals(z, first if nx else None)
    values = residuals.stacked
    xp = namespace_of(values)
    weighted = values * xp.asarray(found.weight)
    misfit = to_host(xp.einsum("pcr,pcr->pc", values, weighted)) + (first**2).sum(axis=2)
    if nx:
        gx = slopes.gain[:, -nx:]
        gradient = to_host(xp.einsum("pcr,cxr->pcx", weighted, xp.asarray(gx))) + first
        absorbed = np.linalg.solve(found.nuisance_precision, gradient[..., None])[..., 0]
        misfit -= np.einsum("pcx,pcx->pc", gradient, absorbed)
    counted = fit.weight > 0.0
    completed = residuals.completed[:, counted].all(axis=1)
    return np.where(completed, -0.5 * misfit[:, counted] @ fit.weight[counted], -np.inf)
