"""Corrections that signals define for their samples, on a log's clock: when they count, and smoothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.series import Series
from amhe_cli.core.signals import Signal

#: Rounding of times [s] that does not count.
_SLACK = 1e-6


def corrected(
    series: Mapping[str, Series], signals: Iterable[Signal], dt: float, begun: float | None = 0.0
) -> dict[str, Series]:
    """Series with gaps where their signal is not active, and smooth where it says so.

    Args:
        series: `signal.quantity` -> Series.
        signals: The signals.
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
