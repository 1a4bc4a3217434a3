"""The posterior covariance: what the clips, the independent units of a log, say about z."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.information import Information, gauss_newton_step, information
from amhe_cli.estimation.core.linearise import Linearisation

#: Clips that the model's own noise is worth against the scatter of the clips' scores: with few clips the
#: scatter is itself uncertain.
NOISE_WORTH = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Estimate and covariance of z, from some clips and channels.

    Args:
        step: One Gauss-Newton step away from where the information was taken, shape (d,).
        hessian: Information of data and prior, shape (d, d).
        scatter: Covariance of the data's score, shape (d, d).
        prior: Information of the prior, shape (d, d).
    """

    step: FloatArray
    hessian: FloatArray
    scatter: FloatArray
    prior: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Posterior covariance of z: the sandwich H^-1 (B + P) H^-1, shape (d, d)."""
        inverse = np.linalg.inv(self.hessian)
        return inverse @ (self.scatter + self.prior) @ inverse

    @property
    def sd(self) -> FloatArray:
        """Posterior sd of each z, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def data_covariance(self) -> FloatArray:
        """The part of it that other data would change, shape (d, d)."""
        inverse = np.linalg.inv(self.hessian)
        return inverse @ self.scatter @ inverse


def posterior(z: FloatArray, found: Information, weight: FloatArray, prior: FloatArray) -> Posterior:
    """Combine the clips' information with the prior of z.

    The scatter of the clips' scores replaces what white noise would give (Huber's sandwich with the clip
    as the independent unit), corrected for the d directions that the fit has flattened, and shrunk towards
    the latter where there are few clips.

    Args:
        z: Where the information was taken, shape (d,).
        found: Information of c clips.
        weight: How often each clip counts, shape (c,); 0 leaves it out.
        prior: The prior's information, shape (d, d).
    """
    matrix = np.einsum("c,cij->ij", weight, found.matrix)
    step, hessian = gauss_newton_step(matrix, np.einsum("c,ci->i", weight, found.score), prior, z)
    score = found.score + np.einsum("cij,j->ci", found.matrix, step)
    count = int((weight > 0.0).sum())
    centred = score - (weight[:, None] * score).sum(axis=0) / max(weight.sum(), 1e-300)
    leverage = count / max(count - min(z.size, count / 2.0), 1.0)
    scatter = np.einsum("c,ci,cj->ij", weight, centred, centred) * leverage
    blended = (count * scatter + NOISE_WORTH * matrix) / (count + NOISE_WORTH)
    return Posterior(step, hessian, blended, prior)


def bootstrap_sd(
    z: FloatArray,
    found: Information,
    weight: FloatArray,
    prior: FloatArray,
    resamples: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Spread of the one-step estimate over resampled clips, sd of z, shape (d,); NaN without clips."""
    count = len(weight)
    if count < 2 or resamples < 2:
        return np.full(z.size, np.nan)
    draws = weight * rng.multinomial(count, np.full(count, 1.0 / count), size=resamples)  # (b, c)
    hessian = np.einsum("bc,cij->bij", draws, found.matrix) + prior
    gradient = np.einsum("bc,ci->bi", draws, found.score) + prior @ z
    return np.linalg.solve(hessian, gradient[..., None])[..., 0].std(axis=0, ddof=1)


def disagreement(one: Posterior, other: Posterior) -> tuple[FloatArray, FloatArray]:
    """Difference between two estimates from different data, and its sd, each (d,) in z."""
    difference = one.step - other.step
    return difference, np.sqrt(np.diag(one.data_covariance + other.data_covariance))


def by_kind(
    z: FloatArray, slopes: Linearisation, weight: FloatArray, prior: FloatArray, kinds: Sequence[str]
) -> dict[str, Posterior]:
    """Posterior from each kind of measurement alone.

    Args:
        kinds: Kind of each compared channel, such as 'position'.
    """
    return {
        kind: posterior(z, information(slopes, [k == kind for k in kinds]), weight, prior)
        for kind in dict.fromkeys(kinds)
    }
