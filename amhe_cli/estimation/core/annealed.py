"""Draws from a posterior, by annealing draws of its prior.

Sequential Monte Carlo (Del Moral, Doucet and Jasra 2006): draws of the prior p are moved to the posterior p L
through p L^b, with b from 0 to 1 as fast as half of the draws stay effective. At each b the draws are
resampled, and moved by Metropolis steps until they have forgotten where they stood. They come from all of the
prior, and only ever get narrower: bent ridges and second minima are found. All draws are evaluated at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray

#: Share of the draws that stays effective from one b to the next.
KEPT = 0.5
#: Most values of b; a likelihood that needs more is not followed to its end.
STAGES = 200
#: Draws have forgotten where they stood once their correlation with it is below the first number at any b,
#: below the second at b = 1; Metropolis steps until then, at most.
FORGOTTEN, STEPS = (0.7, 0.3), (20, 100)
#: Draws with a larger correlation than this do not move: the likelihood jitters by more than it bends.
STUCK = 0.95
#: Share of the draws of a Gaussian that must be accepted for more of them.
GAUSSIAN = 0.3
#: Scale of steps along differences of two draws, over 1 / sqrt(dimension) (ter Braak 2006), at most.
LONGEST = 2.38 * np.sqrt(2.0)

#: Logarithm of the likelihood at points z (n, d), shape (n,), up to a constant; -inf where it is zero.
LogLikelihood = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class Draws:
    """Draws of one weight each.

    Args:
        z: The draws, shape (n, d).
        effective: Number of independent draws that they are worth; few where they could not move.
        evaluations: Number of points at which the likelihood was evaluated.
    """

    z: FloatArray
    effective: float
    evaluations: int


def draw(
    likelihood: LogLikelihood,
    covariance: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    count: int,
    rng: np.random.Generator,
) -> Draws:
    """Draw from the posterior of a prior N(0, covariance) within bounds.

    Args:
        likelihood: Logarithm of the likelihood.
        covariance: Covariance of the prior, shape (d, d).
        bounds: Lower and upper bounds, each (d,).
        count: Number of draws, n.
        rng: Generator of the random numbers.
    """
    precision, evaluations = np.linalg.inv(covariance), 0

    def both(z: FloatArray) -> FloatArray:
        """Logarithms of prior and likelihood, shape (2, n)."""
        nonlocal evaluations
        inside = np.all((z >= bounds[0]) & (z <= bounds[1]), axis=1)
        values = np.full((2, len(z)), -np.inf)
        values[0, inside] = -0.5 * np.einsum("ni,ij,nj->n", z[inside], precision, z[inside])
        if inside.any():
            values[1, inside] = likelihood(z[inside])
        evaluations += int(inside.sum())
        return values

    z, reached = _of_prior(covariance, bounds, count, rng), 0.0
    logs = both(z)
    for _ in range(STAGES):
        if not np.isfinite(logs[1]).any():
            break
        reached, weight = _next(logs[1], reached)
        kept = _resampled(weight, rng)
        last = reached == 1.0
        z, logs, memory = _moved(both, z[kept], logs[:, kept], reached, FORGOTTEN[last], STEPS[last], rng)
        if last or memory > STUCK:
            return Draws(z, count * (1.0 - memory**2), evaluations)
    return Draws(z, 0.0, evaluations)


def _of_prior(
    covariance: FloatArray, bounds: tuple[FloatArray, FloatArray], count: int, rng: np.random.Generator
) -> FloatArray:
    """Draws of the prior within the bounds."""
    factor, z = np.linalg.cholesky(covariance), np.full((count, len(covariance)), np.inf)
    for _ in range(1000):
        outside = ~np.all((z >= bounds[0]) & (z <= bounds[1]), axis=1)
        if not outside.any():
            break
        z[outside] = rng.standard_normal((outside.sum(), len(factor))) @ factor.T
    return np.clip(z, *bounds)


def _next(logs: FloatArray, reached: float) -> tuple[float, FloatArray]:
    """The next b, and the normalised weights (n,) of the draws there, from their log-likelihoods (n,)."""

    def weighted(b: float) -> tuple[FloatArray, bool]:
        weight = np.exp((b - reached) * (logs - logs.max()))
        weight /= weight.sum()
        return weight, bool(1.0 / (weight**2).sum() >= KEPT * len(logs))

    low, high = reached, 1.0
    weight, enough = weighted(high)
    for _ in range(0 if enough else 50):
        middle = 0.5 * (low + high)
        tried, enough = weighted(middle)
        if enough:
            low = middle
        else:
            high, weight = middle, tried
    return high, weight


def _resampled(weight: FloatArray, rng: np.random.Generator) -> IntArray:
    """Rows of the draws that replace weighted ones (n,): systematic resampling."""
    places = (np.arange(len(weight)) + rng.uniform()) / len(weight)
    return np.minimum(np.searchsorted(np.cumsum(weight), places), len(weight) - 1)


def _moved(
    both: Callable[[FloatArray], FloatArray],
    z: FloatArray,
    logs: FloatArray,
    reached: float,
    forgotten: float,
    steps: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, float]:
    """Metropolis steps under p L^b.

    Draws of the Gaussian with the mean and the covariance of all forget at once, and are tried as long as
    many of them are accepted; else steps go along differences of two draws, which follow a bent ridge.

    Returns:
        The draws, their logarithms, and their largest correlation with where they stood.
    """
    began, (count, d), memory = z, z.shape, 1.0
    middle, spread = z.mean(axis=0), np.cov(z.T).reshape(d, d)
    factor = np.linalg.cholesky(spread + 1e-12 * np.eye(d))

    def gaussian(z: FloatArray) -> FloatArray:
        return -0.5 * (np.linalg.solve(factor, (z - middle).T) ** 2).sum(axis=0)

    straight = True
    for _ in range(steps):
        if straight:
            tried = middle + rng.standard_normal((count, d)) @ factor.T
            back = gaussian(z) - gaussian(tried)
        else:
            one, other = began[rng.integers(count, size=(2, count))]
            tried, back = z + rng.uniform(0.0, LONGEST / np.sqrt(d), (count, 1)) * (one - other), 0.0
        there = both(tried)
        gained = there[0] - logs[0] + reached * (there[1] - logs[1]) + back
        taken = np.log(rng.uniform(size=count)) < gained
        z, logs = np.where(taken[:, None], tried, z), np.where(taken, there, logs)
        straight = straight and bool(taken.mean() > GAUSSIAN)
        memory = _memory(began, z)
        if memory < forgotten:
            break
    return z, logs, memory


def _memory(began: FloatArray, z: FloatArray) -> float:
    """Largest correlation of a coordinate of the draws (n, d) with where it began; 1 of one that stands."""
    one, other = began - began.mean(axis=0), z - z.mean(axis=0)
    size = np.sqrt((one**2).sum(axis=0) * (other**2).sum(axis=0))
    return float(np.max(np.where(size > 0.0, (one * other).sum(axis=0) / np.maximum(size, 1e-300), 1.0)))
