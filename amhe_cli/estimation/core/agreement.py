"""Estimates that share a prior: do they agree, and what do they say together?

Parts of one log, logs of one data set and beliefs of several runs are compared by one formula. Each estimate
is m_i, with covariance C_i, and was pulled towards the same prior, of precision P: the prior weighs G_i in
it, so that an error of the prior moves it by G_i. Two estimates differ by what their own noise N_i makes of
them, and by as much as the prior, whose own error has the covariance S, pulls one of them more:

    D = N_i + N_j + (G_i - G_j) S (G_i - G_j)'

Where neither says anything, G_i = G_j = 1, and nothing differs. For beliefs, G_i = C_i P, S = P^-1 and
N_i = C_i - C_i P C_i, so that D = C_i + C_j - C_i P C_j - C_j P C_i.

Pooled beliefs are N(m_i, C_i), with a part S_i of C_i that is shared: it comes from the model. Beliefs weigh
by C_i^-1, the prior counts once, and the pooled covariance takes all S_i as one error. Without S_i the pooled
precision is sum_i C_i^-1 - (k - 1) P. In the comparison S_i counts as each run's own: in other motions the
model may err otherwise, and that is no contradiction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import among, mean_within, positive, root

#: Share of a direction's variance below which it is rounding: both beliefs have it from the prior.
_ROUNDING = 1e-6


#: Sd of a difference, in prior sd, below which it is rounding: neither estimate says anything.
_UNFELT = 1e-9
#: Eigenvalue of a correlation matrix below which a combination is rounding.
_SINGULAR = 1e-13

#: Standard deviations beyond which a difference is no chance.
SURPRISE = 3.0


def difference(
    noise: tuple[FloatArray, FloatArray], pull: tuple[FloatArray, FloatArray], prior_error: FloatArray
) -> FloatArray:
    """Covariance D of the difference of two estimates that agree, shape (d, d); equation above.

    Args:
        noise: Covariance of each that is its own, (d, d) each.
        pull: Weight G of the prior in each, (d, d) each.
        prior_error: Covariance S of the error of the prior, shape (d, d).
    """
    apart = pull[0] - pull[1]
    return noise[0] + noise[1] + apart @ prior_error @ apart.T


def beyond_chance(difference: FloatArray, covariance: FloatArray, comparisons: int = 1) -> FloatArray:
    """The part of a difference (d,) that chance does not explain, shape (d,); it never jumps.

    In coordinates that are independent under chance, and as near to the parameters as such can be (the
    symmetric root of the correlation; Kessy, Lewin and Strimmer 2018), what exceeds SURPRISE sd is kept. So a
    parameter that changes is found among many that do not, and a well-known combination among unknown
    factors.

    Args:
        covariance: What chance gives it, shape (d, d).
        comparisons: How many such differences are judged; of many, some are large by chance.
    """
    sd = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    felt = sd > _UNFELT
    kept = np.zeros_like(difference)
    if not felt.any():
        return kept
    correlation = covariance[np.ix_(felt, felt)] / np.outer(sd[felt], sd[felt])
    values, vectors = np.linalg.eigh(correlation)
    regular = values > _SINGULAR
    roots = np.sqrt(np.where(regular, values, 1.0))
    white = (vectors * (regular / roots)) @ vectors.T @ (difference[felt] / sd[felt])
    limit = among(comparisons * int(regular.sum()), SURPRISE)
    excess = np.sign(white) * np.sqrt(np.maximum(white**2 - limit**2, 0.0))
    kept[felt] = sd[felt] * ((vectors * (regular * roots)) @ vectors.T @ excess)
    return kept


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
    regular = values > _ROUNDING
    along = vectors[:, regular].T @ (np.concatenate([means[i] - means[0] for i in rest]) / scale)
    chi_square, freedom = float((along**2 / values[regular]).sum()), int(regular.sum())
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
    of_noise = covariances - systematic
    # what each belief has from the prior, as far as its own part and not the model's decides it
    seen = (weights @ (of_noise @ prior @ of_noise) @ weights).sum(axis=0)
    values, vectors = np.linalg.eigh(weights.sum(axis=0) - seen + prior)
    # a belief may be wider than its prior, where its run was not explained: then the prior is what remains
    inverse = (vectors / np.maximum(values, np.linalg.eigvalsh(prior).min())) @ vectors.T
    mean = inverse @ (np.einsum("kij,kj->i", weights, means) - (seen - prior) @ prior_mean)
    independent = inverse @ positive((weights @ of_noise @ weights).sum(axis=0) - seen + prior) @ inverse
    # one error of the model moves each belief by the root of its part
    moved = inverse @ (weights @ np.array([root(part) for part in systematic])).sum(axis=0)
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
    names: Sequence[str], compared: Agreement, columns: Sequence[str]
) -> list[tuple[str, str, str, float]]:
    """For each unknown its name, the two beliefs that differ most in it, and by how many sd; worst first."""
    rows = [(column, *compared.farthest(i)) for i, column in enumerate(columns)]
    return sorted(
        ((column, names[i], names[j], size) for column, i, j, size in rows), key=lambda row: -row[3]
    )
