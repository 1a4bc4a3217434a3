"""The state that a rollout starts from: as recorded at a window's first instant, or smoothed about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.trajectory import Series, Window
from amhe_cli.system.system import Channel, System

#: Smoothing fits parabolas: motion between two contacts bends, and hardly more.
_DEGREE = 2


def first_states(
    system: System, windows: Sequence[Window], home: FloatArray, smoothing: float
) -> tuple[FloatArray, FloatArray]:
    """Positions (c, nq) and velocities (c, nv) at each window's start; what no signal gives is at home.

    Args:
        system: Whose signals give the state.
        windows: The windows.
        home: Positions at rest, shape (nq,).
        smoothing: Positions are fitted to what was measured within this time [s] before and after;
            0 takes them as recorded.

    Raises:
        LogError: A window starts where the state was not measured.
    """
    qpos = np.tile(home, (len(windows), 1))
    qvel = np.zeros((len(windows), system.model.nv))
    for channel in system.channels:
        if not channel.sets_state:
            continue
        target = qpos if channel.source == "qpos" else qvel
        reach = smoothing if channel.source == "qpos" else 0.0
        for i, window in enumerate(windows):
            target[i, list(channel.columns)] = _value(channel, window, reach)
    return qpos, qvel


def _value(channel: Channel, window: Window, reach: float) -> FloatArray:
    """Of one channel at a window's start, shape (columns,)."""
    log, start = window.trajectory, window.start
    series = log[channel.key]
    if not series.valid[start]:
        raise LogError(
            f"{log.source}: {channel.key} was not measured at {start * log.dt:.3f} s, where a window starts"
        )
    recorded = series.values[start]
    rows = _samples(series, start, round(reach / log.dt))
    if rows.size < _DEGREE + 2 or not rows[0] < start < rows[-1]:
        return recorded
    powers = np.vander((rows - start).astype(float), _DEGREE + 1, increasing=True)
    if channel.kind == "rotation":
        turns = rotations.difference(series.values[rows], np.broadcast_to(recorded, (rows.size, 4)))
        return rotations.multiply(recorded, rotations.exp(_middle(powers, turns)))
    return _middle(powers, series.values[rows])


def _samples(series: Series, start: int, reach: int) -> np.ndarray:
    """Rows of real measurements about an instant, with no gap among them."""
    first = max(start - reach, 0)
    span = slice(first, start + reach + 1)
    if not series.valid[span].all():
        return np.empty(0, dtype=np.int64)
    return first + np.flatnonzero(series.sampled[span])


def _middle(powers: FloatArray, values: FloatArray) -> FloatArray:
    """Value of the fitted parabolas at the instant itself, shape (columns,)."""
    return np.linalg.lstsq(powers, values, rcond=None)[0][0]
