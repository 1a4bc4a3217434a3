"""Beliefs of several runs as one: do they agree, and what do they say together?

Each belief is N(m_i, C_i) in z and holds the same prior N(m_0, P^-1) and data of its own. A part S_i of C_i
is systematic: it comes from the model. The rest, N_i, is independent. Beliefs weigh by C_i^-1, the prior
counts once, and the pooled covariance takes all S_i as one error. Without S_i the pooled precision is
sum_i C_i^-1 - (k - 1) P.

Two beliefs differ by what noise makes of them, with covariance C_i + C_j - C_i P C_j - C_j P C_i: what both
took from the prior does not differ. There S_i counts as each run's own: in other motions the model may err
otherwise, and that is no contradiction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import mean_within, positive, root

#: Share of a direction's variance below which it is rounding: both beliefs have it from the prior.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How far k beliefs about the same d unknowns differ.

    Args:
        chi_square, freedom: Squared differences in units of what noise explains, and their mean under noise.
        chance: Probability that noise alone makes them as large.
        distances: Difference of each pair in sd of that difference, shape (k, k, d); 0 where noise explains
            none, as where both are the prior.
    """

    chi_square: float
    freedom: int
    chance: float
    distances: FloatArray

    def farthest(self, column: int) -> tuple[int, int, float]:
        """The pair of beliefs that differ most in an unknown, and by how many sd."""
        rows, columns = np.triu_indices(len(self.distances), 1)
        sizes = np.abs(self.distances[rows, columns, column])
        at = int(sizes.argmax())
        return int(rows[at]), int(columns[at]), float(sizes[at])


def agreement(means: FloatArray, covariances: FloatArray, prior: FloatArray) -> Agreement:
    """Whether beliefs agree.

    Args:
        means, covariances: Of each belief in z, shape (k, d) and (k, d, d).
        prior: Precision of the prior that all hold, shape (d, d).
    """
    k, d = means.shape
    shared = np.einsum("iab,bc,jcd->ijad", covariances, prior, covariances)  # C_i P C_j
    distances = np.zeros((k, k, d))
    for i in range(k):
        for j in range(k):
            both = covariances[i] + covariances[j]
            variance = np.diag(both - shared[i, j] - shared[j, i])
            felt = variance > _ROUNDING * np.diag(both)
            distances[i, j] = np.where(
                felt & (i != j), (means[i] - means[j]) / np.sqrt(np.where(felt, variance, 1.0)), 0.0
            )
    first, rest = covariances[0], range(1, k)
    blocks = [
        [
            first + shared[i, j] - shared[i, 0] - shared[0, j] + (i == j) * (covariances[i] - shared[i, i])
            for j in rest
        ]
        for i in rest
    ]
    covariance = np.block(blocks)
    scale = np.sqrt(np.concatenate([np.diag(first + covariances[i]) for i in rest]))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    known = values > _ROUNDING
    along = vectors[:, known].T @ (np.concatenate([means[i] - means[0] for i in rest]) / scale)
    chi_square, freedom = float((along**2 / values[known]).sum()), int(known.sum())
    return Agreement(chi_square, freedom, exceeded(chi_square, freedom), distances)


def pooled(
    means: FloatArray,
    covariances: FloatArray,
    systematic: FloatArray,
    prior_mean: FloatArray,
    prior: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Most probable z within the bounds (d,), covariance (d, d) and its systematic part, of beliefs together.

    Args:
        means, covariances, prior: As in `agreement`.
        systematic: Systematic part of each covariance, shape (k, d, d).
        prior_mean: Mean of the prior, shape (d,).
        bounds: Lower and upper bounds of z, shape (d,) each.
    """
    weights = np.linalg.inv(covariances)
    own = covariances - systematic
    # what each belief has from the prior, as far as its own part and not the model's decides it
    seen = (weights @ (own @ prior @ own) @ weights).sum(axis=0)
    values, vectors = np.linalg.eigh(weights.sum(axis=0) - seen + prior)
    # a belief may be wider than its prior, where its run was not explained: then the prior is what remains
    inverse = (vectors / np.maximum(values, np.linalg.eigvalsh(prior).min())) @ vectors.T
    mean = inverse @ (np.einsum("kij,kj->i", weights, means) - (seen - prior) @ prior_mean)
    independent = inverse @ positive((weights @ own @ weights).sum(axis=0) - seen + prior) @ inverse
    # one error of the model moves each belief by the root of its part
    moved = inverse @ (weights @ np.array([root(one) for one in systematic])).sum(axis=0)
    shared = moved @ moved.T
    whole = independent + shared
    return mean_within(mean, whole, bounds), whole, shared


def exceeded(chi_square: float, freedom: int) -> float:
    """Probability that a chi-square variable is larger (Wilson & Hilferty 1931, good to 0.003)."""
    if not freedom:
        return 1.0
    spread = 2.0 / (9.0 * freedom)
    normal = (math.cbrt(chi_square / freedom) - 1.0 + spread) / math.sqrt(spread)
    return 0.5 * math.erfc(normal / math.sqrt(2.0))


def pairs(
    names: Sequence[str], found: Agreement, columns: Sequence[str]
) -> list[tuple[str, str, str, float]]:
    """For each unknown its name, the two beliefs that differ most in it, and by how many sd; worst first."""
    rows = [(column, *found.farthest(i)) for i, column in enumerate(columns)]
    return sorted(
        ((column, names[i], names[j], size) for column, i, j, size in rows), key=lambda row: -row[3]
    )
