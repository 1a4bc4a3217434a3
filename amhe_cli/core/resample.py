"""From samples at their own stamps to rows of one uniform clock. Gaps are never bridged.

Velocities that a log lacks are the slopes of parabolas fitted to each sample's neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.signals import Series

#: A topic may stay silent for this many of its own median periods.
_PERIODS = 5.0
#: A clock has at most so many rows.
_MOST_ROWS = 10_000_000
#: A clock of so few rows is never refused.
_FEW_ROWS = 1_000_000
#: A longer clock has at most so many rows for each sample.
_ROWS_PER_SAMPLE = 1000


def longest_bridge(times: FloatArray, max_gap: float, hold: bool = False) -> float:
    """Longest silence [s] of a topic with these stamps (n,) [s] that is not a gap.

    Commands (`hold`) that are sent on change, and not streamed, stay in force until the next.
    """
    period = float(np.median(np.diff(times))) if times.size > 1 else np.inf
    if hold and (times.size < 3 or period > max_gap):
        return np.inf
    return max(max_gap, _PERIODS * period) if times.size > 1 else max_gap


def common_rows(stamps_ns: Sequence[tuple[IntArray, bool]], step: float) -> tuple[int, float, int]:
    """Rows of one uniform clock at which all signals are known.

    Row 0 is the first instant at which every signal has begun, in phase with the first sample of the state
    that begins last.

    Args:
        stamps_ns: Stamps [ns] of each signal, and whether it is an input.
        step: Step of the clock [ns].

    Returns:
        A stamp of the phase [ns]; row 0, relative to it [ns], since a stamp in float64 would be off by
        hundreds of nanoseconds; and the number of rows.
    """
    states = [stamps for stamps, is_input in stamps_ns if not is_input] or [stamps for stamps, _ in stamps_ns]
    begun = max(int(stamps[0]) for stamps, _ in stamps_ns)
    phase = max(int(stamps[0]) for stamps in states)
    last = max(int(stamps[-1]) for stamps in states)
    begin = float(np.ceil((begun - phase) / step - 1e-6)) * step
    return phase, begin, int(np.floor((last - phase - begin) / step + 1e-6)) + 1


def too_many(rows: int, samples: int, dt: float) -> str | None:
    """Why a clock of so many rows is refused: a wrong stamp or unit makes it long; None if it is not.

    Args:
        rows: Rows of the clock.
        samples: Samples of the signal that has the most.
        dt: Step of the clock [s].
    """
    if rows <= max(_FEW_ROWS, min(_MOST_ROWS, _ROWS_PER_SAMPLE * samples)):
        return None
    return f"{rows * dt:.0f} s at steps of {dt:g} s are {rows} rows for {samples} samples"


def resample(
    times: FloatArray,
    values: FloatArray,
    columns: tuple[str, ...],
    grid: FloatArray,
    *,
    bridge: float,
    hold: bool = False,
    rotation: bool = False,
    derived: bool = False,
) -> Series:
    """Bring one quantity onto the clock.

    Args:
        times: Stamps [s], strictly increasing, shape (n,).
        values: Samples, shape (n, k); NaN where a message lacks the value.
        columns: Names of the columns.
        grid: Instants of the clock [s], uniform, shape (T,).
        bridge: Longest silence [s] that is filled.
        hold: Keep each sample until the next (commands), instead of interpolating.
        rotation: The samples are unit quaternions: interpolate along the arc.
        derived: The samples were differentiated from another quantity.
    """
    out = np.zeros((grid.size, values.shape[1]))
    valid = np.ones(grid.size, dtype=bool)
    sampled = np.ones(grid.size, dtype=bool)
    fewest = np.inf
    for group in alike(np.isfinite(values)):
        present = np.isfinite(values[:, group[0]])
        stamps = times[present]
        whole = present.all() and len(group) == values.shape[1]
        samples = values if whole else values[present][:, group]
        filled, bridged = _fill(stamps, samples, grid, bridge, hold, rotation)
        if whole:
            out = filled
        else:
            out[:, group] = filled
        valid &= bridged
        if stamps.size < fewest:  # columns that come in messages of their own: the rarest ones decide
            fewest = stamps.size
            sampled = _nearest(stamps, grid)
    if not valid.all():
        out = np.where(valid[:, None], out, 0.0)
    sampled &= valid
    for made in (out, valid, sampled):  # `out` may be a part of `values`, which are copied if they can change
        made.setflags(write=False)
    return Series(out, valid, sampled, columns, derived)


def alike(finite: BoolArray) -> list[list[int]]:
    """Columns (n, k) grouped by the messages in which they are present."""
    if finite.all():
        return [list(range(finite.shape[1]))]
    groups: dict[bytes, list[int]] = {}
    for column in range(finite.shape[1]):
        groups.setdefault(np.packbits(finite[:, column]).tobytes(), []).append(column)
    return list(groups.values())


def _fill(
    times: FloatArray, values: FloatArray, grid: FloatArray, bridge: float, hold: bool, rotation: bool
) -> tuple[FloatArray, BoolArray]:
    """Values (T, k) on the grid, and where they may be believed (T,)."""
    if times.size == 0:
        return np.zeros((grid.size, values.shape[1])), np.zeros(grid.size, dtype=bool)
    # rounding of stamps: 1 us, or a thousandth of a step if that is less
    slack = min(1e-6, 1e-3 * float(grid[1] - grid[0])) if grid.size > 1 else 1e-6
    first = int(np.searchsorted(times, grid[0] - slack)) if grid.size else 0
    rows = slice(first, first + grid.size)
    if times[rows].size == grid.size and (np.abs(times[rows] - grid) <= slack).all():
        # recorded at each of the clock's instants: nothing is copied
        return values[rows], np.ones(grid.size, dtype=bool)
    before = np.searchsorted(times, grid + slack, side="right") - 1
    left, right = np.clip(before, 0, None), np.clip(before + 1, None, times.size - 1)
    since, until = grid - times[left], times[right] - grid
    if hold:
        return values[left], (before >= 0) & (since <= bridge)
    exact = (np.abs(since) <= slack) | (np.abs(until) <= slack)
    if exact.all():  # recorded at the clock's own instants and between them: nothing to interpolate
        return values[np.where(np.abs(since) <= slack, left, right)], exact
    inside = (before >= 0) & (before + 1 < times.size) & (times[right] - times[left] <= bridge)
    span = np.where(right > left, times[right] - times[left], 1.0)
    share = np.clip(since / span, 0.0, 1.0)
    low, filled = values[left], values[right]
    if rotation:
        return rotations.slerp(low, filled, share), exact | inside
    filled -= low  # in place: an hour of log takes hundreds of megabytes
    filled *= share[:, None]
    filled += low
    return filled, exact | inside


def _nearest(times: FloatArray, grid: FloatArray) -> BoolArray:
    """Steps of the grid that are nearest to a sample, shape (T,)."""
    marks = np.zeros(grid.size, dtype=bool)
    if grid.size == 0:
        return marks
    step = grid[1] - grid[0] if grid.size > 1 else 1.0
    steps = np.rint((times - grid[0]) / step)
    steps = steps[(steps >= 0) & (steps < grid.size)].astype(np.int64)
    marks[steps] = True
    return marks


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
