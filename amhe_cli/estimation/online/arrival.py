"""The arrival cost: what is believed of the parameters before a window is seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import Belief, ParameterSpace


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A Gaussian over z, handed on from window to window.

    The paper's equation (5) weighs the distance from the last estimate with a fixed diagonal W_p; this is
    the whole inverse covariance, which knows that mass times friction is known better than either.

    Args:
        z: Mean, shape (d,).
        covariance: Shape (d, d).
    """

    z: FloatArray
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Of each coordinate, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))

    def widened(self, variance: FloatArray) -> Arrival:
        """With more variance of each coordinate, shape (d,): parameters drift, or have jumped."""
        return replace(self, covariance=self.covariance + np.diag(variance))

    def floored(self, sd: FloatArray) -> Arrival:
        """With at least this sd of each coordinate, shape (d,); correlations stay."""
        wider = np.maximum(sd / np.maximum(self.sd, 1e-12), 1.0)
        return replace(self, covariance=self.covariance * np.outer(wider, wider))


def arrival_of(space: ParameterSpace, belief: Belief | None, least_sd: float) -> Arrival:
    """Where a live estimation starts: a belief with a floor under its sd, so that it can still move.

    Args:
        space: The system's parameters.
        belief: None: the system's own prior.
        least_sd: The floor, as a share of each value.
    """
    if belief is None:
        return Arrival(np.zeros(len(space)), np.array(space.prior_covariance))
    return Arrival(*space.gaussian_of(belief)).floored(space.in_z(least_sd))


def reported(space: ParameterSpace, arrival: Arrival, systematic: Mapping[str, float]) -> Arrival:
    """With what the model itself does not know: an error along one direction (a share of each parameter).

    It is no noise, which windows average away; so it is added to what is told, and not to what is handed on.
    """
    along = space.in_z([systematic.get(name, 0.0) for name in space.names])
    return replace(arrival, covariance=arrival.covariance + np.outer(along, along))
