"""Velocities where a log has only positions: a parabola fitted to each sample's neighbours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.resample import alike

#: Neighbours to each side, at least.
_NEIGHBOURS = 3
#: Half of the time that a window spans, at least [s].
_HALF_WINDOW = 0.02
#: Neighbours to each side, at most.
_MOST_NEIGHBOURS = 50
#: Samples that are differentiated at once: long logs take no more memory than what is made of them.
_ROWS = 2**15


def derivative(times: FloatArray, values: FloatArray, bridge: float) -> FloatArray:
    """Time derivative (n, k) of samples (n, k) at non-uniform stamps (n,) [s].

    Least squares over a window of 7 samples or 40 ms, whichever is longer, never across a silence longer
    than `bridge` [s]. NaN where fewer than three samples stand together.
    """
    return _slope(times, bridge, values.shape[1], lambda i, j: values[j] - values[i])


def angular_velocity(times: FloatArray, quaternions: FloatArray, bridge: float) -> FloatArray:
    """Angular velocity in the body's frame (n, 3) [rad/s] of unit quaternions (n, 4), as `derivative`."""
    return _slope(times, bridge, 3, lambda i, j: rotations.difference(quaternions[j], quaternions[i]))


def _slope(
    times: FloatArray, bridge: float, width: int, change: Callable[[IntArray, IntArray], FloatArray]
) -> FloatArray:
    """Slope at each sample i of the parabola through change(i, j), which is 0 at j = i."""
    n = times.size
    slopes = np.full((n, width), np.nan)
    if n < 3:
        return slopes
    start, stop = _segments(times, bridge)
    period = float(np.median(np.diff(times)))
    half = int(np.clip(np.ceil(_HALF_WINDOW / period), _NEIGHBOURS, _MOST_NEIGHBOURS))
    size = np.minimum(2 * half + 1, stop - start)
    first = np.clip(np.arange(n) - half, start, stop - size)
    for rows in np.array_split(np.arange(n), -(-n // _ROWS)):
        powers = np.zeros((5, rows.size))  # sums over the window of 1, t, .., t^4
        right = np.zeros((3, rows.size, width))  # and of y, t y, t^2 y
        for k in range(2 * half + 1):
            j = np.minimum(first[rows] + k, n - 1)
            weight = (k < size[rows]).astype(np.float64)
            t = (times[j] - times[rows]) / (half * period)
            y = change(rows, j)
            for power in range(5):
                powers[power] += weight
                if power < 3:
                    right[power] += weight[:, None] * y
                weight = weight * t
        slopes[rows] = _linear_term(powers, right) / (half * period)
    slopes[size < 3] = np.nan
    return slopes


def _linear_term(powers: FloatArray, right: FloatArray) -> FloatArray:
    """The b of y = a + b t + c t^2 that solves the normal equations, by Cramer's rule; shape (n, width)."""
    s0, s1, s2, s3, s4 = powers
    cofactors = np.stack((s2 * s3 - s1 * s4, s0 * s4 - s2 * s2, s1 * s2 - s0 * s3))
    determinant = s0 * (s2 * s4 - s3 * s3) - s1 * (s1 * s4 - s2 * s3) + s2 * (s1 * s3 - s2 * s2)
    with np.errstate(invalid="ignore", divide="ignore"):  # windows of fewer than three samples
        return np.einsum("in,inw->nw", cofactors, right) / determinant[:, None]


def _segments(times: FloatArray, bridge: float) -> tuple[IntArray, IntArray]:
    """Start and stop of the unbroken stretch that each sample belongs to, shape (n,)."""
    breaks = np.flatnonzero(np.diff(times) > bridge) + 1
    edges = np.concatenate(([0], breaks, [times.size]))
    stretch = np.searchsorted(breaks, np.arange(times.size), side="right")
    return edges[stretch], edges[stretch + 1]


def differentiated(times: FloatArray, values: FloatArray, source: str, bridge: float) -> FloatArray:
    """Velocities (n, k) of positions or orientations (n, k) at stamps (n,) [s]; NaN where there are none.

    Args:
        times: Stamps [s], strictly increasing.
        values: Samples of `source`; NaN where a message lacks some of them.
        source: 'position' or 'orientation'.
        bridge: Longest silence [s] that a velocity may span.
    """
    if source == "orientation":
        slopes = np.full((times.size, 3), np.nan)
        present = np.isfinite(values).all(axis=1)
        slopes[present] = angular_velocity(times[present], values[present], bridge)
        return slopes
    slopes = np.full(values.shape, np.nan)
    finite = np.isfinite(values)
    for columns in alike(finite):
        present = finite[:, columns[0]]
        slopes[np.ix_(present, np.array(columns))] = derivative(
            times[present], values[present][:, columns], bridge
        )
    return slopes
