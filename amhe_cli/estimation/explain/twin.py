"""Logs as the model itself would have made them: what is left of such a motion is the method's own error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.core.statistics import white_noise_sd
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.system import System


def twins(system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator) -> list[Window]:
    """The parts of logs in simulation, with the noise of their positions; those that diverge are left out.

    Args:
        system: The system.
        parts: Parts of its logs: each begins in its measured state, and goes on under its commands.
        z: Values of the unknowns, shape (d,).
        rng: Generator of the noise.
    """
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


def _measured(system: System, part: Window, qpos: FloatArray, rng: np.random.Generator) -> Log:
    """A log whose positions, from the first instant of a part to its last, are these (n, nq), and noise."""
    log, rows = part.log, slice(part.start, part.stop + 1)
    inside = np.zeros(log.steps, dtype=bool)
    inside[rows] = True
    series = dict(log.series)
    for channel in system.channels:
        if channel.source != "qpos":
            continue
        own = series[channel.key]
        real = np.flatnonzero(own.sampled & own.valid & inside)
        sd = channel.noise or white_noise_sd(own.values[real])
        true = qpos[real - part.start][:, list(channel.columns)]
        noisy = true + (0.5 if channel.kind == "rotation" else 1.0) * sd * rng.standard_normal(true.shape)
        values = np.array(own.values)
        for k, column in enumerate(noisy.T):
            values[rows, k] = np.interp(np.arange(part.start, part.stop + 1), real, column)
        series[channel.key] = replace(own, values=values, valid=own.valid & inside)
    return replace(log, series=series)
