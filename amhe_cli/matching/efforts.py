"""Windows of logs as the arrays of an engine that follows the measured motion, and the efforts to compare.

Measured efforts pass a low-pass, symmetric in time, that leaves the band of the motion as it is, and are
taken at its rate: neighbours do not repeat each other. Errors of the motion count as noise of the efforts.
Where a joint turns over or is slow, its dry friction is not known so well: that is noise, too. Where nothing
says which way it acts, the joint is not compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.log import Log, Window
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.engine.inverse import effort_variance
from amhe_cli.engine.rollout import Along
from amhe_cli.engine.states import home
from amhe_cli.matching.motion import MeasuredMotion, motion_of
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System

#: Samples in 1 / band of the motion: products of its velocities reach twice as far, and Nyquist doubles that.
_RATE = 6.0
#: Half the length of the low-pass, in samples that it leaves.
_REACH = 4
#: A joint turns over at a time that is known so well [s].
_TURN = 0.01
#: Speed, as a share of its rms, over which dry friction sets in: gradually, and of every joint in another way
#: (of published arms over 0.1 to 0.4 rad/s).
_SLOW = 0.05
#: A joint rests at speeds up to so many sd of their errors.
_RESTS = 3.0
#: Sd of the share of dry friction from which on nothing says which way it acts.
_UNKNOWN = 0.5
#: Noise that an effort has at least, as a share of its range.
_LEAST = 1e-4
#: Logs whose paths are kept for the next call.
_KEPT = 16


@dataclass(frozen=True, slots=True, eq=False)
class EffortPath:
    """A log's motion at the instants at which its efforts are compared, T of them.

    Args:
        rows: Rows of the log, shape (T,).
        motion: The motion of the log.
        at: Which of the motion's instants they are, shape (T,).
        dry: Share of dry friction that acts, shape (T, nv).
        known: Whether it is known which way it acts, shape (T, nv).
        variance: Variance of the efforts that errors of the motion and of that share make, shape (T, nv).
        every: Rows of the log from one instant to the next.
    """

    rows: IntArray
    motion: MeasuredMotion
    at: IntArray
    dry: FloatArray
    known: BoolArray
    variance: FloatArray
    every: int


def path_of(system: System, log: Log) -> EffortPath:
    """The path of a log; see `motion_of` for its errors."""
    return _path(_Key(system), log)


class _Key:
    """A system, by the numbers that a path depends on."""

    def __init__(self, system: System) -> None:
        model, space, self.system = system.model, system.edits.space, system
        fields = ("body_mass", "body_ipos", "body_inertia", "dof_armature", "dof_damping", "dof_frictionloss")
        numbers = b"".join(getattr(model, name).tobytes() for name in fields)
        priors = tuple(space.nominal), tuple(space.prior_sd)  # of dry friction
        self._value = numbers, priors, system.edits.fields, tuple(c.key for c in system.channels)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._value == other._value

    def __hash__(self) -> int:
        return hash(self._value)


@lru_cache(maxsize=_KEPT)
def _path(key: _Key, log: Log) -> EffortPath:
    system = key.system
    model, motion = system.model, motion_of(system, log)
    step = max(1, int(1.0 / (_RATE * max(float(motion.band.max()), 1e-9) * motion.step)))
    step = min(step, max(1, len(motion.rows) // (4 * _REACH)))
    sd, speed = np.maximum(motion.sd[1], 1e-9), np.abs(motion.qvel)
    moves = speed > _RESTS * sd
    usual = np.sqrt((speed**2 * moves).sum(axis=0) / np.maximum(moves.sum(axis=0), 1))
    doubt = np.sqrt(sd**2 + (_TURN * motion.qacc) ** 2 + (_SLOW * usual) ** 2)
    # the mean of the sign of a speed of which that is the sd, by a tanh that is nearly so
    dry, sure = (np.tanh(np.sqrt(2.0 / np.pi) * motion.qvel / of) for of in (sd, doubt))
    at, acts, unsure = [], [], []
    for stretch in np.unique(motion.stretch):
        own = np.flatnonzero(motion.stretch == stretch)
        places = np.arange(_REACH * step, own.size - _REACH * step, step)
        at.append(own[places])
        acts.append(lowpassed(dry[own], places, step))
        unsure.append(lowpassed(1.0 - np.abs(sure[own]), places, step))
    rows, dry, unsure = map(np.concatenate, (at, acts, unsure))
    friction = _dry_friction(system)
    variance = effort_variance(model, motion.qpos[rows], motion.qvel[rows], motion.qacc[rows], motion.sd)
    variance += (friction * unsure) ** 2
    known = (unsure < _UNKNOWN) | (friction == 0.0)
    every = step * round(motion.step / log.dt)
    return EffortPath(motion.rows[rows], motion, rows, dry, known, variance, every)


def _dry_friction(system: System) -> FloatArray:
    """Dry friction of each joint, no less than one prior sd of what is free makes it, shape (nv,)."""
    space, now = system.edits.space, system.model.dof_frictionloss
    scale = np.where(space.log, space.nominal, 1.0) * np.array(space.prior_sd)
    written = system.edits.written(np.array(space.nominal) + np.diag(scale)).get("dof_frictionloss")
    return now if written is None else np.abs(written).max(axis=0, initial=0.0)


@cache
def kernel_of(step: int) -> FloatArray:
    """Weights of a low-pass, 2 reach step + 1 of them, up to half the rate of one sample in `step`."""
    if step == 1:
        return np.eye(1, 2 * _REACH + 1, _REACH)[0]
    age = np.arange(-_REACH * step, _REACH * step + 1)
    weights = np.sinc(age / step) * np.cos(0.5 * np.pi * age / (_REACH * step + 1)) ** 2
    return weights / weights.sum()


def lowpassed(values: FloatArray, rows: IntArray, step: int) -> FloatArray:
    """Values (n, k) after the low-pass, at rows (m,) at least its reach from either end, shape (m, k)."""
    kernel = kernel_of(step)
    spans = np.lib.stride_tricks.sliding_window_view(values, kernel.size, axis=0)
    return spans[rows - kernel.size // 2] @ kernel


def along_of(system: System, windows: Sequence[Window]) -> tuple[Along, list[tuple[EffortPath, IntArray]]]:
    """The motion of windows, padded to the longest, and which instants of its log's path each has."""
    places = []
    for window in windows:
        path = path_of(system, window.log)
        first, last = np.searchsorted(path.rows, (window.start + 1, window.stop + 1))
        places.append((path, np.arange(first, last)))
    most = max(max(own.size for _, own in places), 1)
    rest, home_input = home(system.model, system.keyframe, system.input_spec)
    nv, count = system.model.nv, len(windows)
    qpos = np.tile(rest, (count, most, 1))
    moved = np.zeros((3, count, most, nv))
    inputs = np.tile(home_input, (count, most, 1)) if system.inputs else None
    for i, (window, (path, own)) in enumerate(zip(windows, places, strict=True)):
        at, span = path.at[own], slice(0, own.size)
        qpos[i, span] = path.motion.qpos[at]
        moved[:, i, span] = path.motion.qvel[at], path.motion.qacc[at], path.dry[own]
        for source in system.inputs if inputs is not None else ():
            assert inputs is not None
            inputs[i, span, list(source.columns)] = window.log[source.key].values[path.rows[own]]
    keys = tuple((window.log, window.start, window.length, system.model.nv) for window in windows)
    qvel, qacc, dry = moved
    return Along(qpos, qvel, qacc, dry, inputs, keys), places


def measured_effort(
    channel: Channel, window: Window, path: EffortPath, own: IntArray
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """What one column of a series measured at m instants of a path: values, which count, and their sd, (m,).

    Args:
        channel: The channel of that column.
        path, own: The log's path, and which of its instants lie in the window.
    """
    values, whole, sds = _filtered(path, window.log, channel.series)
    (dof,), column = channel.columns, channel.part
    assert column is not None, "the channel is one column"
    noise = sds[column] if channel.noise is None else channel.noise
    sd = np.sqrt(noise**2 * (kernel_of(path.every) ** 2).sum() + path.variance[own, dof])
    return values[own, column], whole[own] & path.known[own, dof], sd


@lru_cache(maxsize=4 * _KEPT)
def _filtered(path: EffortPath, log: Log, key: str) -> tuple[FloatArray, BoolArray, FloatArray]:
    """A series after the low-pass along a path (T, k), where it is known (T,), and its noise sd (k,)."""
    series, half = log[key], _REACH * path.every
    total = len(series.valid)
    rows = np.clip(path.rows, half, total - half - 1)
    gaps = np.concatenate(([0], np.cumsum(~series.valid)))
    known = (rows == path.rows) & (gaps[rows + half + 1] == gaps[rows - half])
    values = series.values[series.sampled & series.valid]
    noise = np.array([white_noise_sd(column[:, None]) for column in values.T])
    noise = np.maximum(noise, _LEAST * np.ptp(values, axis=0) + 1e-12)
    return lowpassed(series.values, rows, path.every), known, noise
