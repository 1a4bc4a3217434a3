"""Bayesian D-optimal design: which excitation tells most about the parameters.

What an excitation tells depends on the truth, which nobody knows. So the expectation over a few draws of the
prior is maximised,

    mean over draws of log det(P + M),

P is the prior's precision, M the information of the excitation (Chaloner and Verdinelli 1995).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace


def ensemble(space: ParameterSpace, pairs: int, rng: np.random.Generator) -> FloatArray:
    """Draws of z that stand for its prior: the mean, and pairs one sd to either side, shape (1 + 2 pairs, d).

    With signs for coordinates the draws have the prior's spread, and none is extreme: a box that no robot can
    push would tell nothing.
    """
    d = len(space)
    signs = rng.choice([-1.0, 1.0], size=(pairs, d))
    steps = signs @ np.linalg.cholesky(space.prior_covariance).T
    return space.clip(np.concatenate((np.zeros((1, d)), steps, -steps)).astype(np.float64))


def criterion(information: FloatArray, prior: FloatArray) -> float:
    """Mean log det(P + M) over draws; `information` has shape (draws, d, d), `prior` (d, d)."""
    return float(np.linalg.slogdet(prior + information)[1].mean())


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """How well parameters are, or would be, known.

    Args:
        space: The parameters.
        covariance: Of phi, log(theta) where log-scaled, shape (d, d).
    """

    space: ParameterSpace
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Posterior sd of phi: a share of the parameter where log-scaled, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))

    def sd_along(self, powers: FloatArray) -> float:
        """Posterior sd of the log of a product of parameters to these powers (d,)."""
        return float(np.sqrt(powers @ self.covariance @ powers))


def accuracy(space: ParameterSpace, information: FloatArray) -> Accuracy:
    """Prior and information of data (draws, d, d) in z together; averaged over the draws."""
    covariance = np.linalg.inv(space.prior_precision + information).mean(axis=0)
    return Accuracy(space, covariance * np.outer(space.prior_sd, space.prior_sd))


def best_product(known: Accuracy) -> FloatArray | None:
    """Powers (d,) of the product or ratio of two parameters that gains most on both; None where none does."""
    log = np.flatnonzero(known.space.log)
    ones = np.eye(len(known.space))
    pairs = [ones[i] + sign * ones[j] for i in log for j in log if i < j for sign in (1.0, -1.0)]

    def against_the_better(powers: FloatArray) -> float:
        return known.sd_along(powers) / float(known.sd[powers != 0.0].min())

    best = min(pairs, key=against_the_better, default=None)
    return best if best is not None and against_the_better(best) < 1.0 else None
