"""Samples without spikes and repeats, which their bus makes; and what signals define: gaps, smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.signals import QUANTITIES, Series, Signal

if TYPE_CHECKING:
    from amhe_cli.core.settings import LogSettings


#: Quantities of a motion. A force may act for one sample: only these can be impossible for one.
_MOTION = ("position", "orientation", "velocity", "linear_velocity", "angular_velocity")
#: Samples on either side that a spike is measured by.
_NEIGHBOURS = 10
#: A spike leaps this many times as far as the larger steps about it.
_LEAP = 8.0
#: The quantile of the steps about a sample that is such a larger step: another spike is in 2 of 18.
_LARGE = 0.85
#: A spike is at least this share of the range of its signal.
_VISIBLE = 0.03
#: Values that changed more seldom say nothing about when they are updated.
_CHANGES = 50
#: Share of the updates that may come early, by jitter of the bus.
_EARLY = 0.05
#: Share of the changes that exceed the resolution, where it is the updates that are rare.
_COARSE = 0.3


def cleaned(
    signal: Signal, quantity: str, values: FloatArray, times: FloatArray, settings: LogSettings
) -> tuple[FloatArray, list[str]]:
    """The samples without spikes and repeats, as the settings want it.

    Args:
        signal: The signal; commands are taken as they are.
        values: Samples (n, k); NaN where a message lacks the value.
        times: Their times [s], shape (n,).
        settings: `logs.spikes` and `logs.repeats`.

    Returns:
        The samples, NaN in the rows that are left out, or the same array; and sentences about them.
    """
    notes: list[str] = []
    if signal.held or len(values) < 2 * _NEIGHBOURS:
        return values, notes
    fresh, every = updates(values) if settings.repeats == "drop" else (np.ones(len(values), dtype=bool), 1)
    if every > 1:
        notes.append(
            f"{quantity} is updated in every {ordinal(every)} message: {int((~fresh).sum())} repeats are no "
            "data (`logs.repeats=keep` takes them)"
        )
    rows = np.flatnonzero(fresh)
    if settings.spikes == "drop" and quantity in _MOTION:
        wraps = signal.wraps and quantity == "position"
        factor = signal.factors.get(quantity, 1.0)
        at, sizes = spikes(values[rows] * factor, wraps=wraps, turns=quantity == "orientation")
        if at.size:
            most = int(np.argmax(sizes))
            unit = "" if quantity == "orientation" else f" {QUANTITIES[quantity].split(' or ')[-1]}"
            notes.append(
                f"{at.size} sample{'s' if at.size > 1 else ''} of {quantity} left out, the largest "
                f"{sizes[most]:.3g}{unit} at {times[rows[at[most]]] - times[0]:.2f} s: no motion leaps there "
                "and back at once (`logs.spikes=keep` keeps them)"
            )
            fresh[rows[at]] = False
    return (values, notes) if fresh.all() else (np.where(fresh[:, None], values, np.nan), notes)


def spikes(values: FloatArray, *, wraps: bool = False, turns: bool = False) -> tuple[IntArray, FloatArray]:
    """Rows that no motion explains, and how far they are off.

    A Hampel filter on second differences: a sample is a spike if it is off what both its sides lead to, to
    one side and by many times the steps about it. A sample at an impact fits one of its sides.

    Args:
        values: Samples (n, k), NaN where there is none.
        wraps: They are angles [rad] that may jump by a turn.
        turns: They are unit quaternions, of which q and -q are the same.

    Returns:
        Rows (m,), in which any column is a spike, and the largest deviation in each (m,) [as the values].
    """
    if turns:
        dots = np.einsum("nk,nk->n", np.nan_to_num(values[1:]), np.nan_to_num(values[:-1]))
        values = values * np.cumprod(np.append(1.0, np.where(dots < 0.0, -1.0, 1.0)))[:, None]
    sizes = np.zeros(len(values))
    for column in values.T:
        present = np.flatnonzero(np.isfinite(column))
        at, size = _of_column(column[present], wraps)
        np.maximum.at(sizes, present[at], size)
    rows = np.flatnonzero(sizes)
    return rows, sizes[rows]


def _of_column(values: FloatArray, wraps: bool) -> tuple[IntArray, FloatArray]:
    """Spikes of one column (n,), without gaps: rows and sizes."""
    if values.size < 2 * _NEIGHBOURS:
        return np.zeros(0, dtype=np.int64), np.zeros(0)
    steps = np.diff(values)
    if wraps:
        steps -= 2.0 * np.pi * np.round(steps / (2.0 * np.pi))
    speed = np.abs(steps)
    left, right = steps[1:-2] - steps[:-3], steps[3:] - steps[2:-1]  # of samples 2 .. n - 3
    off = np.where(left * right < 0.0, 0.0, np.minimum(np.abs(left), np.abs(right)))
    low, high = np.quantile(values, (0.01, 0.99)) if not wraps else (0.0, 2.0 * np.pi)
    least = max(_VISIBLE * float(high - low), _LEAP * resolution(values))
    about = _LEAP * np.maximum(speed[:-3], speed[3:])
    found, sizes = list[int](), list[float]()
    for row in (np.flatnonzero((off > about) & (off > least)) + 2).tolist():
        first = min(max(row - _NEIGHBOURS, 0), speed.size - 2 * _NEIGHBOURS + 1)
        near = slice(first, row - 1), slice(row + 1, first + 2 * _NEIGHBOURS)
        if off[row - 2] > _LEAP * np.quantile(np.concatenate([speed[part] for part in near]), _LARGE):
            found.append(row)
            sizes.append(float(off[row - 2]))
    return np.array(found, dtype=np.int64), np.array(sizes)


def updates(values: FloatArray) -> tuple[BoolArray, int]:
    """Which rows are news, and after how many rows the next is: a bus repeats what a sensor has not renewed.

    Samples that change by the resolution alone are a slow motion, and all of them are news.

    Args:
        values: Samples (n, k).

    Returns:
        Mask (n,), and the usual number of rows from one update to the next, 1 where no value is repeated.
    """
    all_news = np.ones(len(values), dtype=bool), 1
    moved = (values[1:] != values[:-1]) & np.isfinite(values[1:])
    news = np.flatnonzero(moved.any(axis=1)) + 1
    runs = np.diff(news)
    if runs.size < _CHANGES or np.quantile(runs, _EARLY, method="lower") < 2:
        return all_news
    sizes = np.abs(np.diff(values, axis=0))
    beyond = [sizes[:, k] > 1.5 * resolution(values[:, k]) for k in range(values.shape[1])]
    if np.mean(np.any(beyond, axis=0)[news - 1]) < _COARSE:
        return all_news
    every = int(np.median(runs))
    rows = np.arange(len(values))
    last = news[np.maximum(np.searchsorted(news, rows, side="right") - 1, 0)]
    fresh: BoolArray = (rows - last) % every == 0  # one that comes back the same is news too, when it is due
    return fresh, every


def resolution(values: FloatArray) -> float:
    """The step of a quantised signal (n,), of which its changes are multiples; 0 where it has none."""
    steps = np.abs(np.diff(values[np.isfinite(values)]))
    steps = steps[steps > 1e-6 * steps.max(initial=0.0)]  # less is the arithmetic's
    for share in (0.05, 0.0) if steps.size else ():  # a fast signal seldom changes by one step
        multiples = steps / (step := float(np.quantile(steps, share)))
        if np.mean(np.abs(multiples - np.round(multiples)) < 0.1) > 0.9:
            return step
    return 0.0


def ordinal(number: int) -> str:
    """'2nd', '3rd', '4th'."""
    ending = {1: "st", 2: "nd", 3: "rd"}.get(number % 10 if number // 10 % 10 != 1 else 0, "th")
    return f"{number}{ending}"


#: Rounding of times [s] that does not count.
_SLACK = 1e-6


def corrected(
    series: Mapping[str, Series], signals: Iterable[Signal], dt: float, begun: float | None = 0.0
) -> dict[str, Series]:
    """Series with gaps where their signal is not active, and smooth where it says so.

    Args:
        series: `signal.quantity` -> Series.
        dt: Step of the clock [s].
        begun: Time of row 0 from the log's start [s]; None: a running system, whose times have no start.
    """
    mended = dict(series)
    for signal in signals:
        for key in (signal.key(quantity) for quantity in signal.quantities):
            if key not in series:
                continue
            now = mended[key]
            if signal.active or signal.switch:
                on = now.valid & _active(signal, series, now.valid.size, dt, begun)
                now = replace(now, valid=on, sampled=now.sampled & on)
            if half := round(signal.smooth / dt):
                now = replace(now, values=_smoothed(now, half, key.endswith(".orientation")))
            mended[key] = now
    return mended


def _active(
    signal: Signal, series: Mapping[str, Series], rows: int, dt: float, begun: float | None
) -> BoolArray:
    on = np.ones(rows, dtype=bool)
    if signal.active and begun is not None:
        time = begun + dt * np.arange(rows)
        inside = [(first - _SLACK <= time) & (time <= last + _SLACK) for first, last in signal.active]
        on = np.any(inside, axis=0)
    if signal.switch:
        key, value = signal.switch
        on = on & series[key].valid & np.isclose(series[key].values[:, 0], value)
    return on


def _smoothed(series: Series, half: int, turning: bool) -> FloatArray:
    """Values of the parabola fitted to `half` rows on either side, fewer at the ends of each stretch."""
    values = np.array(series.values)
    edges = np.flatnonzero(np.diff(series.valid, prepend=False, append=False)).reshape(-1, 2)
    for first, last in edges:
        stretch = values[first:last]
        if turning:
            flips = np.where((stretch[1:] * stretch[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
            stretch = stretch * np.cumprod([1.0, *flips])[:, None]
        smooth = stretch.copy()
        for row in {*range(min(half, len(stretch))), *range(max(len(stretch) - half, 0), len(stretch))}:
            reach = min(half, row, len(stretch) - 1 - row)
            smooth[row] = _kernel(reach) @ stretch[row - reach : row + reach + 1]
        if len(stretch) > 2 * half:
            inner = [np.convolve(column, _kernel(half), "valid") for column in stretch.T]
            smooth[half : len(stretch) - half] = np.transpose(inner)
        values[first:last] = rotations.normalised(smooth) if turning else smooth
    return values


def _kernel(half: int) -> FloatArray:
    """Weights of 2 half + 1 rows whose sum is the value of their parabola in the middle."""
    if half < 2:  # three rows lie on a parabola
        return np.eye(1, 2 * half + 1, half)[0]
    powers = np.vander(np.arange(-half, half + 1, dtype=np.float64), 3, increasing=True)
    weights: FloatArray = np.linalg.pinv(powers)[0]
    return weights
