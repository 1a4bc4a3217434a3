"""How wrong a recorded first state may be: the prior of the errors that the estimators fit with each clip."""

from __future__ import annotations

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Log, Series
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.system.system import Channel, System

#: Noise of a velocity fitted to 7 positions a time h apart, in units of their noise / h: 1 / sqrt(28).
_FITTED = 28.0**-0.5


def first_errors(system: System, log: Log) -> tuple[IntArray, FloatArray]:
    """Which tangent coordinates of the first state (positions, velocities: 2 nv) a log measured.

    Returns:
        Their indices and error sd [SI], each shape (nx,).
    """
    model = system.model
    sd = np.zeros(2 * model.nv)
    for channel in system.channels:
        if not channel.sets_state:
            continue
        dofs = _tangent(system, channel)
        sd[dofs] = _error(channel, system, log)
    index = np.flatnonzero(sd > 0.0)
    return index, sd[index]


def _tangent(system: System, channel: Channel) -> list[int]:
    """Tangent coordinates (positions 0 .. nv, velocities nv .. 2 nv) that a state channel measures."""
    model = system.model
    if channel.source == "qvel":
        return [model.nv + c for c in channel.columns]
    dofs: list[int] = []
    for joint in range(model.njnt):
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        end_q = int(model.jnt_qposadr[joint + 1]) if joint + 1 < model.njnt else model.nq
        inside = [c - q for c in channel.columns if q <= c < end_q]
        if channel.kind == "rotation" and inside:
            first = v + min(inside)
            dofs += [first, first + 1, first + 2]
        else:
            dofs += [v + i for i in inside]
    return dofs


def _error(channel: Channel, system: System, log: Log) -> float:
    """Error sd of a state channel: as declared, else judged by the series itself."""
    series = log[channel.key]
    below = next((c for c in system.channels if c.key == channel.integral), None)
    if below is None or not (channel.source == "qvel" and series.derived):
        return channel.noise or white_noise_sd(series.values[_rows(series)])
    return max(channel.noise or 0.0, _slope_error(series, log, below))


def _slope_error(series: Series, log: Log, below: Channel) -> float:
    """Error sd of a velocity that was differentiated: noise, and what smoothing makes of impacts and stops.

    The smooth velocity is held against the plain central difference: where they differ by more than the
    latter's noise, the smooth one is wrong.
    """
    positions = log[below.key]
    rows = _rows(positions)
    if rows.size < 5:
        return 0.0
    step = float(np.median(np.diff(rows))) * log.dt
    even = np.abs(rows[2:] - rows[:-2] - 2.0 * step / log.dt) < 0.5
    before, after = positions.values[rows[:-2][even]], positions.values[rows[2:][even]]
    turning = below.kind == "rotation"
    change = rotations.difference(after, before) if turning else after - before
    wrong = series.values[rows[1:-1][even]] - change / (2.0 * step)
    noise = (below.noise or white_noise_sd(positions.values[rows])) / step
    bias = max(float((wrong**2).mean()) - 0.5 * noise**2, 0.0) if wrong.size else 0.0
    return float(np.sqrt(bias + 2.0 * (_FITTED * noise) ** 2))


def _rows(series: Series) -> IntArray:
    return np.flatnonzero(series.sampled & series.valid)
