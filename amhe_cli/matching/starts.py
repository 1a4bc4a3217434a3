"""The state that a window's rollouts start from, and how wrong that state may be.

The state is the recorded one at the window's first instant, or one smoothed about it. The sd of its error
is the prior of the first-state errors that the estimators fit along with the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log, Window
from amhe_cli.core.signals import Series
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.system.description.data import Channel
from amhe_cli.system.model.elements import set_followers
from amhe_cli.system.model.gaps import Gap, gaps, loose_ends, set_gaps
from amhe_cli.system.system import System

#: Smoothing fits parabolas: motion between two contacts bends, and hardly more.
_DEGREE = 2
#: Noise of a velocity fitted to 7 positions a time h apart, in units of their noise / h: 1 / sqrt(28).
_FITTED = 28.0**-0.5
#: Sd of a state that is known exactly.
_TINY = 1e-9


def first_states(
    system: System, windows: Sequence[Window], home: FloatArray, smoothing: float
) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities at the start of each of c windows.

    Args:
        system: The system; its state channels say which signals give which part of the state.
        home: Positions of everything that no signal gives, shape (nq,).
        smoothing: Positions are fitted to the measurements within this time [s] before and after the
            start; 0 takes them as recorded.

    Returns:
        qpos, shape (c, nq), and qvel, shape (c, nv).

    Raises:
        LogError: A window starts where the state was not measured.
    """
    qpos = np.tile(home, (len(windows), 1))
    qvel = np.zeros((len(windows), system.model.nv))
    measured: set[int] = set()
    for channel in system.channels:
        if not channel.sets_state:
            continue
        columns, recorded = list(channel.columns), _recorded(channel, windows)
        if channel.source == "qpos":
            measured.update(columns)
            qpos[:, columns] = _positions(channel, windows, recorded, smoothing)
        else:
            qvel[:, columns] = _velocities(channel, windows, recorded)
    set_followers(system.model, qpos, qvel, measured)
    set_gaps(system.model, qpos, qvel, measured)
    return qpos, qvel


def _positions(channel: Channel, windows: Sequence[Window], recorded: FloatArray, reach: float) -> FloatArray:
    """Position or orientation of one channel at the windows' starts, shape (c, columns)."""
    positions = recorded.copy()
    for i, window in enumerate(windows if reach else ()):
        if (fitted := _parabola(window, channel.key, reach)) is not None:
            turned = channel.kind == "rotation"
            positions[i] = rotations.multiply(recorded[i], rotations.exp(fitted[0])) if turned else fitted[0]
    return positions


def _velocities(channel: Channel, windows: Sequence[Window], recorded: FloatArray) -> FloatArray:
    """Velocity of one channel at the windows' starts, shape (c, columns).

    It is the slope of the positions where the channel demands that: a velocity that was filtered on the
    robot lags the motion.
    """
    velocities = recorded.copy()
    for i, window in enumerate(windows if channel.slope else ()):
        if (fitted := _parabola(window, channel.integral, channel.slope)) is not None:
            velocities[i] = fitted[1]
    return velocities


def _recorded(channel: Channel, windows: Sequence[Window]) -> FloatArray:
    """Recorded values of one channel at the windows' starts, shape (c, columns)."""
    values = np.empty((len(windows), len(channel.columns)))
    by_log: dict[int, list[int]] = {}
    for i, window in enumerate(windows):
        by_log.setdefault(id(window.log), []).append(i)
    for rows in by_log.values():
        log, starts = windows[rows[0]].log, np.array([windows[i].start for i in rows])
        series = log[channel.key]
        if not (valid := series.valid[starts]).all():
            raise LogError(
                f"{log.source}: {channel.key} was not measured at {starts[np.argmin(valid)] * log.dt:.3f} s, "
                "where a window starts"
            )
        values[rows] = series.values[starts]
    return values


def _parabola(window: Window, key: str, reach: float) -> FloatArray | None:
    """Value, slope and half the second derivative of a series at a window's start, from a fitted parabola.

    Returns:
        Shape (3, columns), in the unit of the series, per s and per s^2. For an orientation the series is
        the rotation vector from the recorded orientation, in the body's own frame. None where too few
        samples lie within `reach` [s] of the start.
    """
    log, start = window.log, window.start
    series = log[key]
    rows = _samples_about(series, start, round(reach / log.dt))
    if rows.size < _DEGREE + 2 or not rows[0] < start < rows[-1]:
        return None
    values = series.values[rows]
    if key.endswith(".orientation"):
        values = rotations.difference(values, np.broadcast_to(series.values[start], values.shape))
    powers = np.vander((rows - start) * log.dt, _DEGREE + 1, increasing=True)
    fitted: FloatArray = np.asarray(np.linalg.lstsq(powers, values, rcond=None)[0], dtype=np.float64)
    return fitted


def _samples_about(series: Series, start: int, reach: int) -> IntArray:
    """Rows of the real measurements within `reach` rows of `start`; none where a gap lies among them."""
    first = max(start - reach, 0)
    span = slice(first, start + reach + 1)
    if not series.valid[span].all():
        return np.empty(0, dtype=np.int64)
    return first + np.flatnonzero(series.sampled[span])


def first_index(system: System) -> IntArray:
    """Coordinates of a first state that are measured, and those of what lies beside one in a gap.

    They are the same for all logs of a system: what one of them measured exactly has an error of no size.

    Returns:
        Indices among the 2 nv of the tangent space (nv of the positions, then nv of the velocities), (nx,);
        none where efforts are matched, as the whole motion is measured.
    """
    wrong = np.zeros(2 * system.model.nv, dtype=bool)
    for channel in system.channels if system.match != "effort" else ():
        if channel.sets_state:
            wrong[tangent_of(system, channel)] = True
    nv, dofs = system.model.nv, system.model.jnt_dofadr
    for _, beside, measured in unmeasured(system, gaps(system.model)) if wrong.any() else ():
        wrong[dofs[beside]] = True
        wrong[nv + dofs[beside]] = wrong[nv + dofs[measured]]
    return np.flatnonzero(wrong)


def first_sds(system: System, logs: Sequence[Log]) -> FloatArray:
    """Sd of the error of a first state of each of c logs [SI], (c, nx): see `first_index`."""
    index, by_log = first_index(system), {id(log): log for log in logs}
    sds = {place: _first_sd(system, log)[index] for place, log in by_log.items()}
    return np.array([sds[id(log)] for log in logs])


def _first_sd(system: System, log: Log) -> FloatArray:
    """Sd of the error of every coordinate of a first state of one log [SI], shape (2 nv,)."""
    nv, dofs = system.model.nv, system.model.jnt_dofadr
    sd = np.zeros(2 * nv)
    for channel in system.channels:
        if channel.sets_state:
            sd[tangent_of(system, channel)] = _error_sd(channel, system, log)
    for gap, beside, measured in unmeasured(system, gaps(system.model)):
        sd[dofs[beside]] = gap.slack(system.model)
        sd[nv + dofs[beside]] = sd[nv + dofs[measured]]
    return np.maximum(sd, _TINY)  # shifts of the first state are said in these units: see `readings`


def differentiated(system: System, log: Log) -> BoolArray:
    """Mask of the coordinates of `first_index` that are differentiated velocities, shape (nx,)."""
    flags = np.zeros(2 * system.model.nv, dtype=bool)
    for channel in system.channels:
        if channel.sets_state and log[channel.key].derived:
            flags[tangent_of(system, channel)] = True
    return flags[first_index(system)]


def tangent_of(system: System, channel: Channel) -> list[int]:
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


def unmeasured(system: System, among: Sequence[Gap]) -> list[tuple[Gap, int, int]]:
    """Gaps of which one joint is measured and one is not: the gap, that joint's row, the measured one's."""
    measured = {c for channel in system.channels if channel.source == "qpos" for c in channel.columns}
    return loose_ends(system.model, among, measured)


def _error_sd(channel: Channel, system: System, log: Log) -> float:
    """Error sd of a state channel: the declared noise, else what the series itself shows."""
    series = log[channel.key]
    positions = next((c for c in system.channels if c.key == channel.integral), None)
    if positions is None or not (channel.source == "qvel" and series.derived):
        return channel.noise or white_noise_sd(series.values[_measured(series)])
    return max(channel.noise or 0.0, _slope_error(series, log, positions))


def _slope_error(velocity: Series, log: Log, channel: Channel) -> float:
    """Error sd of a velocity that was differentiated from the positions of `channel`.

    It has two parts: noise, and what smoothing makes of impacts and stops. For the latter the smooth
    velocity is compared with the plain central difference: where they differ by more than the noise of the
    difference, the smooth one is wrong.
    """
    positions = log[channel.key]
    rows = _measured(positions)
    if rows.size < 5:
        return 0.0
    step = float(np.median(np.diff(rows))) * log.dt
    even = np.abs(rows[2:] - rows[:-2] - 2.0 * step / log.dt) < 0.5
    before, after = positions.values[rows[:-2][even]], positions.values[rows[2:][even]]
    turning = channel.kind == "rotation"
    change = rotations.difference(after, before) if turning else after - before
    wrong = velocity.values[rows[1:-1][even]] - change / (2.0 * step)
    noise = (channel.noise or white_noise_sd(positions.values[rows])) / step
    bias = max(float((wrong**2).mean()) - 0.5 * noise**2, 0.0) if wrong.size else 0.0
    return float(np.sqrt(bias + 2.0 * (_FITTED * noise) ** 2))


def _measured(series: Series) -> IntArray:
    """Rows that hold a real, valid measurement."""
    return np.flatnonzero(series.sampled & series.valid)
