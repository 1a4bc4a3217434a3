"""Velocities where a log has only positions: a parabola fitted to each sample's neighbours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray

#: Neighbours to each side, at least; and half of the time [s] that a window spans, at least.
_NEIGHBOURS = 3
_HALF_WINDOW = 0.02
_MOST_NEIGHBOURS = 50


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
    index = np.arange(n)
    moments = np.zeros((n, 3, 3))
    right = np.zeros((n, 3, width))
    for k in range(2 * half + 1):
        j = np.minimum(first + k, n - 1)
        inside = (k < size).astype(np.float64)
        t = (times[j] - times) / (half * period)
        powers = np.stack((np.ones(n), t, t * t), axis=1)
        moments += inside[:, None, None] * powers[:, :, None] * powers[:, None, :]
        right += inside[:, None, None] * powers[:, :, None] * change(index, j)[:, None, :]
    enough = size >= 3
    slopes[enough] = np.linalg.solve(moments[enough], right[enough])[:, 1] / (half * period)
    return slopes


def _segments(times: FloatArray, bridge: float) -> tuple[IntArray, IntArray]:
    """Start and stop of the unbroken stretch that each sample belongs to, shape (n,)."""
    breaks = np.flatnonzero(np.diff(times) > bridge) + 1
    edges = np.concatenate(([0], breaks, [times.size]))
    stretch = np.searchsorted(breaks, np.arange(times.size), side="right")
    return edges[stretch], edges[stretch + 1]
