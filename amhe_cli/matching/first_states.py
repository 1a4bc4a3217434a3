"""The state that a rollout starts from: as recorded at a window's first instant, or smoothed about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Series, Window
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
        columns = list(channel.columns)
        for i, window in enumerate(windows):
            if channel.source == "qpos":
                qpos[i, columns] = _position(channel, window, smoothing)
            else:
                qvel[i, columns] = _velocity(channel, window)
    return qpos, qvel


def _position(channel: Channel, window: Window, reach: float) -> FloatArray:
    """Of one channel at a window's start, shape (columns,)."""
    recorded = _recorded(channel, window)
    fitted = _parabola(window, channel.key, reach)
    if fitted is None:
        return recorded
    if channel.kind == "rotation":
        return rotations.multiply(recorded, rotations.exp(fitted[0]))
    return fitted[0]


def _velocity(channel: Channel, window: Window) -> FloatArray:
    """Likewise; a slope where the channel says so: what was estimated on the way lags what it follows."""
    recorded = _recorded(channel, window)
    fitted = _parabola(window, channel.integral, channel.slope) if channel.slope else None
    return recorded if fitted is None else fitted[1]


def _recorded(channel: Channel, window: Window) -> FloatArray:
    log, start = window.log, window.start
    series = log[channel.key]
    if not series.valid[start]:
        raise LogError(
            f"{log.source}: {channel.key} was not measured at {start * log.dt:.3f} s, where a window starts"
        )
    return series.values[start]


def _parabola(window: Window, key: str, reach: float) -> FloatArray | None:
    """Value, slope and half the bend at the start, of a parabola through a series, shape (3, columns).

    In the unit of the series, per s and per s^2; of orientations the rotation vector from the recorded one,
    in the body's own frame. None: too few samples.
    """
    log, start = window.log, window.start
    series = log[key]
    rows = _samples(series, start, round(reach / log.dt))
    if rows.size < _DEGREE + 2 or not rows[0] < start < rows[-1]:
        return None
    values = series.values[rows]
    if key.endswith(".orientation"):
        values = rotations.difference(values, np.broadcast_to(series.values[start], values.shape))
    powers = np.vander((rows - start) * log.dt, _DEGREE + 1, increasing=True)
    fitted: FloatArray = np.asarray(np.linalg.lstsq(powers, values, rcond=None)[0], dtype=np.float64)
    return fitted


def _samples(series: Series, start: int, reach: int) -> np.ndarray:
    """Rows of real measurements about an instant, with no gap among them."""
    first = max(start - reach, 0)
    span = slice(first, start + reach + 1)
    if not series.valid[span].all():
        return np.empty(0, dtype=np.int64)
    return first + np.flatnonzero(series.sampled[span])
