"""D-optimal design: which excitations, how often, tell most about the parameters in a given time.

Information matrices of log-parameters add up over clips, and what an excitation tells depends on the truth,
which nobody knows. So the expectation over a few draws of the prior is maximised,

    mean over draws of log det(P + sum_i n_i M_i),   sum_i n_i T_i <= T,

by greedy choice and exchange (Fedorov 1972). P is the prior's precision, M_i the information of one go at
excitation i, T_i its time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.parameters import ParameterSpace

#: An exchange must raise the criterion by this much, or it could go round in circles.
_BETTER = 1e-9


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


def best_counts(information: FloatArray, seconds: FloatArray, prior: FloatArray, limit: float) -> IntArray:
    """How often to do each of n excitations, shape (n,); zeros where none fits.

    Args:
        information: Of one go at each, by draw, shape (draws, n, d, d).
        seconds: That each takes, shape (n,).
        prior: Precision, shape (d, d).
        limit: All together take no longer [s].
    """
    counts = _filled(np.zeros(len(seconds), dtype=np.int64), information, seconds, prior, limit)
    while True:
        value = _value(counts, information, prior)
        options = [
            _filled(other, information, seconds, prior, limit)
            for other in _exchanged(counts)
            if other @ seconds <= limit + 1e-9
        ]
        values = [_value(other, information, prior) for other in options]
        if not values or max(values) <= value + _BETTER:
            return counts
        counts = options[int(np.argmax(values))]


def _value(counts: IntArray, information: FloatArray, prior: FloatArray) -> float:
    return criterion(np.einsum("n,enij->eij", counts.astype(float), information), prior)


def _filled(
    counts: IntArray, information: FloatArray, seconds: FloatArray, prior: FloatArray, limit: float
) -> IntArray:
    """Add what gains most per second for as long as anything fits."""
    ones = np.eye(len(seconds), dtype=np.int64)
    while True:
        fits = np.flatnonzero(counts @ seconds + seconds <= limit + 1e-9)
        if not fits.size:
            return counts
        now = _value(counts, information, prior)
        gains = [(_value(counts + ones[i], information, prior) - now) / seconds[i] for i in fits]
        counts = counts + ones[fits[int(np.argmax(gains))]]


def _exchanged(counts: IntArray) -> list[IntArray]:
    """All ways to do one excitation once less and another once more."""
    ones = np.eye(len(counts), dtype=np.int64)
    return [counts - ones[i] + ones[j] for i in np.flatnonzero(counts) for j in range(len(counts)) if i != j]


def spread_out(counts: IntArray) -> list[int]:
    """An order in which equal excitations are far apart: indices, each as often as it counts."""
    places = [((k + 0.5) / count, i) for i, count in enumerate(counts) for k in range(count)]
    return [i for _, i in sorted(places)]


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
