"""What is added to the posterior's covariance beyond noise, without bending what is known together.

Every widening is a covariance of its own. An error of the model whose effect is known moves the whole
estimate along one vector v, and adds v v'. Of other errors only the size is known, in some directions: each
parameter, and each combination that the logs determine much better than its factors. Such a direction gets
the variance that it lacks, and the rest of the estimate follows as the posterior says: a mass that is known
to be proportional to a thrust stays so, however uncertain both become.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.statistics import correlation, root
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.offline.posterior import Disagreement, FinalFit
from amhe_cli.estimation.offline.verdicts import SURPRISE, TOGETHER

#: Upper quartile of a normal distribution, in sd.
QUARTILE = 0.6745


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Linear functions n'z whose variances are judged: each parameter, then what is known only together.

    Args:
        rows: One n in each row, shape (m, d); none for parameters that the logs do not depend on.
        known: Variance of each n'z under the posterior, shape (m,).
        follow: Column i is the vector along which an error of direction i moves the estimate, 1 along the
            direction itself, shape (d, m).
    """

    rows: FloatArray
    known: FloatArray
    follow: FloatArray


def directions(covariance: FloatArray, active: BoolArray) -> Directions:
    """Parameters, and the eigenvectors of the correlation matrix with eigenvalues below 1 - TOGETHER.

    An error of a parameter takes no step along these eigenvectors (a partial one where the eigenvalue is in
    the upper half of that range, so that nothing jumps): other parameters follow it as far as that demands.

    Args:
        covariance: Posterior covariance of z, shape (d, d).
        active: Parameters that the logs depend on, shape (d,).
    """
    scale = np.sqrt(covariance.diagonal())
    matrix = np.where(np.outer(active, active), correlation(covariance), np.eye(active.size))
    values, vectors = np.linalg.eigh(matrix)
    together = vectors[:, values < 1.0 - TOGETHER]
    free = (vectors * np.clip(2.0 * values / (1.0 - TOGETHER) - 1.0, 0.0, 1.0)) @ vectors.T
    alone = (free / free.diagonal() / scale)[:, active]
    rows = np.concatenate((np.eye(active.size)[active], together.T / scale))
    return Directions(
        rows, variances(rows, covariance), scale[:, None] * np.concatenate((alone, together), 1)
    )


def variances(rows: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variance of n'z for each of m directions n, shape (m,)."""
    return np.einsum("mi,ij,mj->m", rows, covariance, rows)


def contradicted(rows: FloatArray, differences: Iterable[Disagreement]) -> FloatArray:
    """Variance of n'z that contradictions between parts of the data show, shape (m,).

    Where parts disagree by more than chance, none is known to be right: half the largest difference (or its
    own `share`) is added as a standard deviation, as random-effects models do.
    """
    most = np.zeros(len(rows))
    for difference in differences:
        chance = SURPRISE**2 * variances(rows, difference.covariance)
        most = np.maximum(most, difference.share**2 * ((rows @ difference.value) ** 2 - chance))
    return most


def scattered(rows: FloatArray, steps: FloatArray, covariance: FloatArray) -> FloatArray:
    """Variance of n'z that the clip bootstrap shows beyond a posterior covariance, shape (m,).

    Its own scatter, up to half of the variance, is left out, and so are the resamples that miss the clips
    with most of the information: the spread is that of the middle half.

    Args:
        rows: The n of each n'z, shape (m, d).
        steps: Estimates from resampled clips, shape (b, d); NaN: none.
        covariance: What noise explains, shape (d, d).
    """
    low, high = np.quantile(steps @ rows.T, (0.25, 0.75), axis=0)
    spread = (high - low) / (2.0 * QUARTILE)
    return np.nan_to_num(np.maximum(spread**2 - 1.5 * variances(rows, covariance), 0.0))


def beyond_chance(covariance: FloatArray, shift: FloatArray) -> FloatArray:
    """A shift of the estimate (d,) as far as it leaves the posterior: 0 within SURPRISE sd."""
    square = max(float(shift @ np.linalg.solve(covariance, shift)), SURPRISE**2)
    return np.sqrt(1.0 - SURPRISE**2 / square) * shift


def repeated(fit: FinalFit, prior: FloatArray) -> FloatArray:
    """The covariance that the model's own errors add, shape (d, d).

    Noise averages out over clips. What the model gets wrong does not: it returns with each motion like it. So
    what repeats within a clip, the autocorrelation of its residuals, counts once for all clips, and not once
    for each: n clips of autocorrelation time t are one of time 1 + n (t - 1). White residuals add nothing.
    """
    shared = information(fit.slopes, repeats=float(fit.weight.sum()))
    once = prior + np.einsum("c,cij->ij", fit.weight, shared.matrix)
    each = prior + fit.posterior.hessian - fit.posterior.prior
    return np.linalg.inv(once) - np.linalg.inv(each)


def of_one_cause(one: FloatArray, other: FloatArray) -> FloatArray:
    """The covariance (d, d) of the sum of two errors that have the same cause, from theirs.

    Their signs are not known: they are taken to agree, as far as the symmetric roots do.
    """
    both = root(one) + root(other)
    return both @ both


def in_directions(found: Directions, wanted: FloatArray, added: FloatArray) -> FloatArray:
    """The covariance that adds a variance (m,), or more, to each direction; shape (d, d).

    Directions whose variance grows most come first, since they widen others as well.

    Args:
        found: The directions.
        wanted: What each must get, shape (m,).
        added: Covariance that has been added already, shape (d, d): only what lacks is added to it.
    """
    for i in np.argsort(-wanted / found.known):
        lacking = float(wanted[i] - found.rows[i] @ added @ found.rows[i])
        added = added + max(lacking, 0.0) * np.outer(found.follow[:, i], found.follow[:, i])
    return added


def along_vectors(covariance: FloatArray, errors: Iterable[FloatArray]) -> FloatArray:
    """The covariance of errors of the estimate along known vectors v (d,), shape (d, d).

    The longest, in sd of the posterior, adds v v'. Others add what those before them do not cover: of two
    changes that move the estimate to and fro on one line, the larger counts.

    Args:
        covariance: Posterior covariance of z, shape (d, d).
        errors: The vectors, one sd long each.
    """
    added = np.zeros_like(covariance)

    def square(v: FloatArray) -> float:
        return float(v @ np.linalg.solve(covariance + added, v))

    for v in sorted((v for v in errors if v.any()), key=square, reverse=True):
        own, left = float(v @ np.linalg.solve(covariance, v)), square(v)
        added = added + max(1.0 + 1.0 / own - 1.0 / left, 0.0) * np.outer(v, v)
    return added
