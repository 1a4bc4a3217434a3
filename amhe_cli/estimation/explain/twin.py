"""Logs as the model itself would have made them: what is left of such a motion is the method's own error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.core.signals import Series
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.engine.inverse import forces_along
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.motion import motion_of
from amhe_cli.matching.readings import reading_of
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System


def twins(system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator) -> list[Window]:
    """The parts of logs in simulation, with the noise of their positions; those that diverge are left out.

    Args:
        parts: Parts of its logs: each begins in its measured state, and goes on under its commands.
        z: Values of the unknowns, shape (d,).
        rng: Generator of the noise.
    """
    if system.match == "effort":
        return [_followed(system, part, z, rng) for part in parts]
    engine, found = open_engine(system, sensors=False), []
    for part in parts:
        theta = values_on(part.log, system.edits.space, system.space, system.space.theta_of(z)[None])
        starts = starts_of(system, [part], system.settings.cost.smoothing)
        late = system.edits.delays(theta) / system.model.opt.timestep
        inputs = starts.inputs_under(late)
        rolled = engine.rollout(theta, starts.qpos, starts.qvel, inputs, starts.lengths)
        if rolled.completed[0]:
            qpos = np.concatenate([starts.qpos, rolled.qpos[0]])
            found.append(replace(part, log=_measured(system, part, qpos, rng)))
    return found


def _followed(system: System, part: Window, z: FloatArray, rng: np.random.Generator) -> Window:
    """A part whose motion is the smoothed one, with the efforts that it needs, and the noise of both."""
    log, motion = part.log, motion_of(system, part.log)
    theta = values_on(log, system.edits.space, system.space, system.space.theta_of(z)[None])
    model, numbers = system.edits.apply(system.model, theta[0]), system.edits.numbers(theta)
    efforts = forces_along(model, motion.qpos, motion.qvel, motion.qacc).needed
    efforts = efforts + model.dof_frictionloss * np.sign(motion.qvel)
    series = dict(log.series)
    for channel in system.channels:
        if channel.source in ("qpos", "effort"):
            true = (motion.qpos if channel.source == "qpos" else efforts)[:, list(channel.columns)]
            shown = reading_of(channel, system.calibration.readings.get(channel.key), numbers, true[None])[0]
            series[channel.key] = _noisy(channel, series[channel.key], motion.rows, shown, rng)
    return replace(part, log=replace(log, series=series))


def _measured(system: System, part: Window, qpos: FloatArray, rng: np.random.Generator) -> Log:
    """A log whose positions, from the first instant of a part to its last, are these (n, nq), and noise."""
    series, rows = dict(part.log.series), np.arange(part.start, part.stop + 1)
    for channel in system.channels:
        if channel.source == "qpos":
            own, true = series[channel.key], qpos[:, list(channel.columns)]
            series[channel.key] = _noisy(channel, own, rows, true, rng)
    return replace(part.log, series=series)


def _noisy(
    channel: Channel, own: Series, rows: IntArray, true: FloatArray, rng: np.random.Generator
) -> Series:
    """A series with these values (n, k) at rows (n,) of the log, and noise where it was sampled."""
    inside, values = np.zeros(len(own.valid), dtype=bool), np.array(own.values)
    inside[rows[0] : rows[-1] + 1] = True
    real = np.flatnonzero(own.sampled & own.valid & inside)
    every = np.arange(rows[0], rows[-1] + 1)
    for k, column in enumerate(true.T):
        sd = channel.noise or white_noise_sd(own.values[real, k : k + 1])
        half = 0.5 if channel.kind == "rotation" else 1.0  # a quaternion turns by twice its change
        noisy = np.interp(real, rows, column) + half * sd * rng.standard_normal(real.size)
        values[every, k] = np.interp(every, real, noisy)
    return replace(own, values=values, valid=own.valid & inside)
