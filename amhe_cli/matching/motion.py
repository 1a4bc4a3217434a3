"""The motion of a log: smooth positions, velocities and accelerations of a model's joints and free bodies.

Positions alone give it: a velocity that a robot reports was filtered there, and lags. `core.spectrum` says
how they are smoothed, and how wrong the result is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.core.spectrum import Smooth, smooth
from amhe_cli.engine.states import home
from amhe_cli.matching.starts import tangent_of
from amhe_cli.system.description.data import Channel
from amhe_cli.system.model.elements import set_followers
from amhe_cli.system.system import System

#: Fewest samples of a stretch that is smoothed.
_FEWEST = 32
#: Rows at either end of a stretch, in 1 / band, where the motion is bent.
_ENDS = 1.0
#: Largest share of a stretch that its ends may take.
_MOST = 0.15
#: Motions that are kept for the next call.
_KEPT = 16


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredMotion:
    """The motion along a log, at T of its rows; one that is not in a stretch of measurements is not there.

    Args:
        rows: Rows of the log, shape (T,), evenly spaced within each stretch.
        stretch: Number of the stretch that each is in, shape (T,).
        qpos, qvel, qacc: The motion, shape (T, nq), (T, nv) and (T, nv), in MuJoCo's coordinates.
        sd: Sd of the errors of position, velocity and acceleration, shape (3, nv); 0 of what no signal gives.
        band: Frequency above which the noise is larger than the motion [Hz], shape (nv,); 0 likewise, and of
            what stands.
        step: Time from one row to the next [s].
    """

    rows: IntArray
    stretch: IntArray
    qpos: FloatArray
    qvel: FloatArray
    qacc: FloatArray
    sd: FloatArray
    band: FloatArray
    step: float

    def within(self, start: int, stop: int) -> slice:
        """The instants whose rows are from `start` to `stop`, both included."""
        return slice(*np.searchsorted(self.rows, (start, stop + 1)).tolist())


def motion_of(system: System, log: Log) -> MeasuredMotion:
    """The motion of a log that was read for a system.

    Args:
        system: The system: its signals say which positions are measured. Joints that follow a measured one
            move along; what nothing measures stands where the system has it at home.

    Raises:
        LogError: No stretch of the log, where all positions are measured, is long enough.
    """
    channels = tuple(c for c in system.channels if c.source == "qpos")
    return _motion(_Measured(system, channels, log))


def velocity_lag(system: System, log: Log) -> tuple[float, float] | None:
    """By how much measured velocities of joints are behind their positions, and its sd [s]; None: none are.

    A velocity v(t - lag) is about v - lag a: the lag is a regression on the accelerations.
    """
    channels = [c for c in system.channels if c.source == "qvel" and not c.slope]
    channels = [c for c in channels if c.quantity == "velocity" and not log[c.key].derived]
    if not channels:
        return None
    motion, left, bends = motion_of(system, log), [], []
    for channel in channels:
        columns = list(channel.columns)
        left.append((log[channel.key].values[motion.rows] - motion.qvel[:, columns]).ravel())
        bends.append(motion.qacc[:, columns].ravel())
    error, acceleration = np.concatenate(left), np.concatenate(bends)
    over = float((acceleration**2).sum())
    late = -float((acceleration * error).sum()) / max(over, 1e-300)
    # residuals repeat within the band of the motion
    repeats = max(1.0, 1.0 / (2.0 * motion.step * max(float(motion.band.max()), 1e-9)))
    rest = float((error + late * acceleration).std())
    return late, rest * float(np.sqrt(repeats / max(over, 1e-300)))


@dataclass(frozen=True, eq=False)
class _Measured:
    """What a motion depends on: logs that share the measured series are equal, whatever their commands."""

    system: System
    channels: tuple[Channel, ...]
    log: Log

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Measured) and self._parts == other._parts

    def __hash__(self) -> int:
        return hash(self._parts)

    @cached_property
    def _parts(self) -> tuple[object, ...]:
        system, series = self.system, tuple(self.log[channel.key] for channel in self.channels)
        at_home = home(system.model, system.keyframe, system.input_spec)[0].tobytes()
        return self.channels, at_home, self.log.dt, series


@lru_cache(maxsize=_KEPT)
def _motion(measured: _Measured) -> MeasuredMotion:
    system, channels, log = measured.system, measured.channels, measured.log
    model = system.model
    spacing = max((_spacing(log[c.key]) for c in channels), default=1)
    parts, smoothed = [], []
    for rows in _stretches(log, [c.key for c in channels], spacing):
        qpos = np.tile(home(model, system.keyframe, system.input_spec)[0], (rows.size, 1))
        moved, sd, band = np.zeros((2, rows.size, model.nv)), np.zeros((3, model.nv)), np.zeros(model.nv)
        for channel in channels:
            values, dofs = log[channel.key].values[rows], tangent_of(system, channel)
            turning = channel.kind == "rotation"
            found = (_turning if turning else smooth)(values, spacing * log.dt)
            qpos[:, list(channel.columns)] = found.values
            moved[:, :, dofs] = found.first, found.second
            sd[:, dofs], band[dofs] = found.sd, found.band
        columns = {column for channel in channels for column in channel.columns}
        for change in moved:  # a follower's velocity and acceleration are its leader's, times the slope
            set_followers(model, qpos, change, columns)
        own = band[band > 0.0]
        bent = min(int(_ENDS / (own.min() * spacing * log.dt)) if own.size else 0, int(_MOST * rows.size))
        inner = slice(bent, rows.size - bent)
        parts.append((rows[inner], qpos[inner], *moved[:, inner]))
        smoothed.append((sd, band, rows.size))
    if not parts:
        raise LogError(
            f"{log.source}: no {_FEWEST} positions follow each other without a gap: they give no motion"
        )
    weights = np.array([count for *_, count in smoothed], dtype=np.float64)
    sd, band = (np.average([one[k] for one in smoothed], axis=0, weights=weights) for k in range(2))
    stretch = np.repeat(np.arange(len(parts)), [part[0].size for part in parts])
    rows, qpos, qvel, qacc = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return MeasuredMotion(rows, stretch, qpos, qvel, qacc, sd, band, spacing * log.dt)


def _spacing(series: Series) -> int:
    """Rows from one measurement to the next."""
    rows = np.flatnonzero(series.sampled & series.valid)
    return max(1, round(float(np.median(np.diff(rows))))) if rows.size > 1 else 1


def _stretches(log: Log, keys: list[str], spacing: int) -> Iterator[IntArray]:
    """Rows of each stretch in which all series are valid, `spacing` apart."""
    valid = log.usable(tuple(keys))
    edges = np.flatnonzero(np.diff(valid, prepend=False, append=False)).reshape(-1, 2)
    for first, last in edges:
        rows = np.arange(first, last, spacing)
        if rows.size >= _FEWEST:
            yield rows


def _turning(quaternions: FloatArray, dt: float) -> Smooth:
    """Smooth orientations (n, 4); angular velocities and accelerations (n, 3) are in the body's own frame."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    found = smooth(quaternions * np.cumprod([1.0, *flips])[:, None], dt)
    # u' = u (0, w / 2): the part of u' along u changes its length only, and is no rotation
    length = np.linalg.norm(found.values, axis=1, keepdims=True)
    unit = found.values / length
    first, second = found.first / length, found.second / length
    back = rotations.conjugate(unit)
    shrinking = (unit * first).sum(axis=1, keepdims=True)
    omega = 2.0 * rotations.multiply(back, first)[:, 1:]
    alpha = 2.0 * rotations.multiply(back, second)[:, 1:] - 2.0 * shrinking * omega
    # an error of the rotation is twice that of the quaternion, whose columns have about the same
    sd = 2.0 * np.sqrt((found.sd**2).mean(axis=1))[:, None] * np.ones(3)
    return Smooth(unit, omega, alpha, sd, np.full(3, found.band.max()), 2.0 * found.noise[:3])
