"""Simulated logs: a system's model is driven by given controls, and measured with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.engine.bounds import Bounds, Broken, joint_at_limit
from amhe_cli.engine.rollout import Engine
from amhe_cli.engine.states import home
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System

#: Time between two messages of measurements [s].
MEASURED = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """Plays controls on a system's model from its home state.

    Args:
        system: System with the signals to log.
        engine: Rollouts of its model, or of another plant.
        dt: Time step of that model [s].
        period: Time between two commands [s].
        bounds: What the plant must not do, beside reaching the limits of its joints.
    """

    system: System
    engine: Engine
    dt: float
    period: float
    bounds: Bounds | None = None

    def times(self, seconds: float) -> FloatArray:
        """Instants at which controls may change [s], shape (n,)."""
        return self.period * np.arange(round(seconds / self.period), dtype=np.float64)

    def play(self, theta: FloatArray, controls: FloatArray, rng: np.random.Generator) -> list[Log | Broken]:
        """Logs of p plants; of a plant that diverges or does what it must not, why there is none.

        Args:
            theta: Parameters of the plants, shape (p, d).
            controls: Input vectors of the plants at `times`, shape (p, n, nu).
            rng: Source of the sensors' noise.
        """
        system, last = self.system, controls.shape[1] - 1
        steps = round((last + 1) * self.period / self.dt)  # of any length: a plant's may not divide the 20 ms
        playing = np.minimum((np.arange(steps) * self.dt / self.period + 1e-9).astype(np.int64), last)
        inputs = controls[:, playing]
        acting = self._late(theta, inputs)
        qpos, _ = home(system.model, system.keyframe, system.input_spec)
        count = len(inputs)
        start = np.tile(qpos, (count, 1)), np.zeros((count, system.model.nv))
        rollouts = self.engine.rollout(theta, *start, acting, np.full(count, steps))
        sources = {"qpos": rollouts.qpos, "qvel": rollouts.qvel, "sensordata": rollouts.sensordata}
        # the first instant has no sensor data: the logs begin with the second, row 0 of the rollouts
        measured = np.arange(0, steps - 1, max(1, round(MEASURED / self.dt)))
        commanded = np.append(0, np.flatnonzero(np.diff(playing)))
        logs: list[Log | Broken] = []
        for i in range(count):
            series = {
                c.key: _measured(c, sources[c.source][i, :-1], measured, rng)  # pyright: ignore[reportOptionalSubscript]
                for c in system.channels
            }
            for source in system.inputs:
                series[source.key] = _sampled(inputs[i, 1:, list(source.columns)].T, commanded)
            broken = (
                None
                if rollouts.completed[i]
                else Broken("the simulation diverges", advice="give the model a smaller time step")
            )
            broken = broken or joint_at_limit(system.model, rollouts.qpos[i])
            if broken is None and self.bounds is not None:
                broken = self.bounds.broken(theta[i], rollouts.qpos[i], rollouts.qvel[i], acting[i])
            logs.append(broken or Log(self.dt, series, "a simulated probe"))
        return logs

    def _late(self, theta: FloatArray, inputs: FloatArray) -> FloatArray:
        """Inputs (p, steps, nu) when they act: after the delay of each; a part of a step is interpolated."""
        steps = np.arange(inputs.shape[1])[:, None]
        delays = np.broadcast_to(self.system.edits.delays(theta), (len(theta), inputs.shape[2]))
        whole, part = np.divmod(delays[:, None] / self.dt, 1.0)
        rows = np.maximum(steps - whole.astype(np.int64), 0)
        now, before = (np.take_along_axis(inputs, np.maximum(rows - k, 0), axis=1) for k in (0, 1))
        return (1.0 - part) * now + part * before


def _measured(channel: Channel, states: FloatArray, rows: IntArray, rng: np.random.Generator) -> Series:
    """Measurements of a channel, with its declared noise; row k is the state after input k."""
    values, noise = states[:, list(channel.columns)], channel.noise or 0.0
    if channel.kind == "rotation":
        turns = rotations.exp(noise * rng.standard_normal((len(values), 3)))
        return _sampled(rotations.multiply(values, turns), rows)
    return _sampled(values + noise * rng.standard_normal(values.shape), rows)


def _sampled(values: FloatArray, rows: IntArray) -> Series:
    sampled = np.zeros(len(values), dtype=bool)
    sampled[rows] = True
    columns = tuple(str(i) for i in range(values.shape[1]))
    return Series(values, np.ones(len(values), dtype=bool), sampled, columns)
