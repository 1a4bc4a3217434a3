"""Small statistics that several methods share."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, namespace_of

#: Half-width of a central 90 % interval of a normal distribution, in standard deviations.
Z90 = 1.6448536269514722
#: Turns of an active set, for each value, after which rounding goes to and fro.
_TURNS = 10


def pseudo_huber(squared: FloatArray, delta: float) -> FloatArray:
    """Robust loss of squared whitened residuals: s for small s, 2 delta sqrt(s) for large.

    Twice the usual pseudo-Huber loss, 2 delta^2 (sqrt(1 + s / delta^2) - 1), so that it equals the
    square near zero. `delta` is in standard deviations.
    """
    root = namespace_of(squared).sqrt(1.0 + squared / delta**2)
    return 2.0 * squared / (1.0 + root)  # the same, without cancellation


def pseudo_huber_weight(squared: FloatArray, delta: float) -> FloatArray:
    """Derivative of `pseudo_huber` by s: the weight of iteratively reweighted least squares."""
    return 1.0 / np.sqrt(1.0 + squared / delta**2)


def trimmed_mean(values: FloatArray, trim: float) -> FloatArray:
    """Mean over the last axis without its worst (largest) share `trim`; inf only if it must stay.

    Args:
        values: Costs, shape (..., C); inf marks a failed one.
        trim: Share of the C values to drop, in [0, 1).
    """
    count = values.shape[-1]
    keep = max(1, count - int(np.floor(trim * count)))
    if keep < count:
        values = np.partition(values, keep - 1, axis=-1)[..., :keep]
    return values.mean(axis=-1)


def log_rank_weights(rank: FloatArray, count: FloatArray) -> FloatArray:
    """Weights ln(count + 1/2) - ln(rank) of CMA-ES, not yet normalised; none beyond the count.

    Args:
        rank: Rank of each sample, from 1 for the best; shape (...).
        count: How many share the weight, shape (...).
    """
    return np.where(rank <= count, np.log(count + 0.5) - np.log(np.maximum(rank, 1.0)), 0.0)


def sd_of_one(square: float, freedom: float) -> float:
    """Distance in sd of a single number that is as unlikely as a chi-square value.

    By the cube root, which is about normal (Wilson and Hilferty 1931, "The distribution of chi-square").

    Args:
        square: The chi-square value.
        freedom: Its degrees of freedom, which need not be whole.
    """
    cube, of_one = 2.0 / (9.0 * freedom), 2.0 / 9.0
    normal = ((square / freedom) ** (1.0 / 3.0) - 1.0 + cube) / np.sqrt(cube)
    return float(max(1.0 - of_one + np.sqrt(of_one) * normal, 0.0) ** 1.5)


def root(covariance: FloatArray) -> FloatArray:
    """The symmetric root of a covariance (d, d)."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def positive(matrix: FloatArray) -> FloatArray:
    """A symmetric matrix (d, d) without its negative eigenvalues."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def part_of(whole: FloatArray, part: FloatArray) -> FloatArray:
    """A part of a covariance (d, d), cut where it exceeds the whole in any direction."""
    lower = np.linalg.cholesky(whole)
    values, vectors = np.linalg.eigh(np.linalg.solve(lower, np.linalg.solve(lower, part).T))
    along = lower @ vectors
    return (along * np.clip(values, 0.0, 1.0)) @ along.T


def mean_within(
    mean: FloatArray, covariance: FloatArray, bounds: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Where a Gaussian's density is highest within bounds, shape (d,).

    A primal active set (Nocedal and Wright 2006, algorithm 16.3): values that stand on their bounds are held
    there as long as the density falls inwards, and the others follow.
    """
    lower, upper = bounds
    found = np.clip(mean, lower, upper)
    held = found != mean
    for _ in range(_TURNS * len(mean)):
        wanted = mean.copy()
        if held.any():
            follow = np.linalg.solve(covariance[np.ix_(held, held)], (found - mean)[held])
            wanted = mean + covariance[:, held] @ follow
            wanted[held] = found[held]
        step = wanted - found
        room = np.where(step > 0.0, upper - found, np.where(step < 0.0, lower - found, np.inf))
        share = np.divide(room, step, out=np.ones_like(step), where=step != 0.0)
        share[held] = 1.0
        blocking = int(share.argmin())
        if share[blocking] < 1.0:
            found = np.clip(found + max(share[blocking], 0.0) * step, lower, upper)
            found[blocking] = (lower if step[blocking] < 0.0 else upper)[blocking]
            held[blocking] = True
            continue
        found = wanted
        inwards = np.where(found <= lower, -1.0, 1.0) * np.linalg.solve(covariance, found - mean)
        leaving = np.where(held, inwards, -np.inf)
        if leaving.max() <= 0.0:
            break
        held[int(leaving.argmax())] = False
    return found


def white_noise_sd(values: FloatArray) -> float:
    """Noise sd of a smooth signal sampled in rows (n, k), from its third differences.

    A robust (median) estimate that a few jumps do not disturb; 0 for fewer than five rows.
    """
    if len(values) < 5:
        return 0.0
    third = np.diff(values, 3, axis=0) / np.sqrt(20.0)  # 1, -3, 3, -1: variance 20
    return float(np.median(np.abs(third)) / 0.6745)


def autocorrelation_time(series: FloatArray, valid: BoolArray | None = None) -> float:
    """Integrated autocorrelation time of residuals, in samples, at least 1.

    Averages the autocovariance over rows, and sums it to its first insignificant lag (after the initial
    positive sequence of Geyer 1992): n samples are worth n / time independent ones.

    Args:
        series: Residuals, shape (rows, samples), consecutive samples along the last axis.
        valid: Mask of the same shape; samples outside it are left out.
    """
    mask = np.ones_like(series, dtype=bool) if valid is None else valid.astype(bool)
    x = np.where(mask, series, 0.0)
    samples = series.shape[-1]
    if samples < 4 or not mask.any():
        return 1.0
    size = 2 * samples
    spectrum = np.fft.rfft(x, size, axis=-1)
    pairs = np.fft.rfft(mask.astype(float), size, axis=-1)
    covariance = np.fft.irfft((np.abs(spectrum) ** 2).sum(axis=0), size)[:samples]
    count = np.fft.irfft((np.abs(pairs) ** 2).sum(axis=0), size)[:samples]
    covariance = covariance / np.maximum(count, 1.0)
    if covariance[0] <= 0.0:
        return 1.0
    rho = covariance[1 : samples // 2] / covariance[0]
    noise = 2.0 / np.sqrt(max(mask.sum(), 1))  # what white residuals would show by chance
    insignificant = np.flatnonzero(rho <= noise)
    rho = rho[: insignificant[0]] if insignificant.size else rho
    return float(1.0 + 2.0 * rho.sum())


def among(count: int, z: float) -> float:
    """Sd that one of `count` normal numbers exceeds as seldom as a single number exceeds `z` (Bonferroni)."""
    normal = NormalDist()
    return -normal.inv_cdf(normal.cdf(-z) / max(count, 1))


def correlation(covariance: FloatArray) -> FloatArray:
    """Correlation matrix of a covariance matrix, shape (d, d); rows of zero variance are zero."""
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0.0, 1.0 / np.where(sd > 0.0, sd, 1.0), 0.0)
    return covariance * np.outer(scale, scale)


def quantiles(values: FloatArray) -> dict[str, float]:
    """Median and 99 % quantile of durations (n,) [ms], leaving out NaN; NaN where no duration is left."""
    values = values[np.isfinite(values)]
    if not values.size:
        return {"p50": float("nan"), "p99": float("nan")}
    return {"p50": round(float(np.median(values)), 3), "p99": round(float(np.quantile(values, 0.99)), 3)}
