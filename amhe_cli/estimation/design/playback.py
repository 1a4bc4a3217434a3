"""Simulated logs: a system's model is driven by given controls, and measured with noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Log, Series
from amhe_cli.engine.rollout import Engine
from amhe_cli.engine.states import home
from amhe_cli.system.system import Channel, System

#: Time between two messages of measurements, and between two commands [s].
MEASURED, COMMANDED = 0.01, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Playback:
    """Plays controls on a system's model from its home state.

    Args:
        system: System with the signals to log.
        engine: Rollouts of its model, or of another plant.
        dt: Time step of that model [s].
    """

    system: System
    engine: Engine
    dt: float

    def times(self, seconds: float) -> FloatArray:
        """Instants at which controls may change [s], shape (n,)."""
        return COMMANDED * np.arange(round(seconds / COMMANDED), dtype=np.float64)

    def play(self, theta: FloatArray, controls: FloatArray, rng: np.random.Generator) -> list[Log | None]:
        """Logs of p plants; None for a plant that diverges or leaves its joints' limits.

        Args:
            theta: Parameters of the plants, shape (p, d).
            controls: Input vectors of the plants at `times`, shape (p, n, nu).
            rng: Source of the sensors' noise.
        """
        system, last = self.system, controls.shape[1] - 1
        steps = round((last + 1) * COMMANDED / self.dt)  # of any length: a plant's may not divide the 20 ms
        playing = np.minimum((np.arange(steps) * self.dt / COMMANDED + 1e-9).astype(np.int64), last)
        inputs = controls[:, playing]
        qpos, _ = home(system.model, system.keyframe, system.input_spec)
        count = len(inputs)
        start = np.tile(qpos, (count, 1)), np.zeros((count, system.model.nv))
        rollouts = self.engine.rollout(theta, *start, inputs, np.full(count, steps))
        sources = {"qpos": rollouts.qpos, "qvel": rollouts.qvel, "sensordata": rollouts.sensordata}
        # the first instant has no sensor data: the logs begin with the second, row 0 of the rollouts
        measured = np.arange(0, steps - 1, max(1, round(MEASURED / self.dt)))
        commanded = np.append(0, np.flatnonzero(np.diff(playing)))
        logs: list[Log | None] = []
        for i in range(count):
            series = {
                c.key: _measured(c, sources[c.source][i, :-1], measured, rng)  # pyright: ignore[reportOptionalSubscript]
                for c in system.channels
            }
            for source in system.inputs:
                series[source.key] = _sampled(inputs[i, 1:, list(source.columns)].T, commanded)
            sound = rollouts.completed[i] and _within_limits(system, rollouts.qpos[i])
            logs.append(Log(self.dt, series, "a simulated probe") if sound else None)
        return logs


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


def _within_limits(system: System, qpos: FloatArray) -> bool:
    """Whether no limited hinge or slide touches its limits in states (n, nq)."""
    model = system.model
    joints = np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2))  # neither free nor ball
    values = qpos[:, model.jnt_qposadr[joints]]
    return bool((values > model.jnt_range[joints, 0]).all() and (values < model.jnt_range[joints, 1]).all())
