"""The Gaussian over z that passes from window to window: the prior of the next one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.core.parameters import ParameterSpace


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Mean and covariance of z.

    The arrival cost of the paper's equation (5) weighs the distance from the last estimate with a fixed
    diagonal W_p. This is the inverse of a full covariance, which can represent that mass times friction is
    known better than either.

    Args:
        z: Mean of z, shape (d,).
        covariance: Covariance of z, shape (d, d).
    """

    z: FloatArray
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of each coordinate, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))

    def inflated(self, variance: FloatArray) -> Gaussian:
        """The same mean with this variance added to each coordinate, shape (d,)."""
        return replace(self, covariance=self.covariance + np.diag(variance))

    def floored(self, sd: FloatArray) -> Gaussian:
        """The same mean and correlations with at least this sd of each coordinate, shape (d,)."""
        wider = np.maximum(sd / np.maximum(self.sd, 1e-12), 1.0)
        return replace(self, covariance=self.covariance * np.outer(wider, wider))


def prior_of(space: ParameterSpace, belief: Belief | None, least_sd: float) -> Gaussian:
    """Prior of the first window: a belief whose sd is floored, so that estimates can still move.

    Args:
        space: The system's parameters.
        belief: The belief to start from; None: the system's own prior, not floored.
        least_sd: Smallest sd of each parameter, as a share of its value.
    """
    if belief is None:
        return Gaussian(np.zeros(len(space)), np.array(space.prior_covariance))
    return Gaussian(*space.gaussian_of(belief)).floored(space.in_z(least_sd))


def with_model_error(space: ParameterSpace, belief: Gaussian, systematic: Mapping[str, float]) -> Gaussian:
    """The belief that is reported: with the error of the model itself along one direction.

    It is the same in every window and does not average out, so it is added to what is reported and not to the
    prior of the next window.

    Args:
        space: The system's parameters.
        belief: The estimator's own belief.
        systematic: Parameter -> error (sd), as a share of its value; of a linear one in prior sd.
    """
    error = space.in_z([systematic.get(name, 0.0) for name in space.names])
    return replace(belief, covariance=belief.covariance + np.outer(error, error))
