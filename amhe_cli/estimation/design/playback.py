"""Simulated logs of a system that given controls drive, and the files of a probe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Log, Samples
from amhe_cli.core.signals import Series, Signal
from amhe_cli.engine.bounds import Bounds, Broken, joint_at_limit
from amhe_cli.engine.rollout import Engine, delayed
from amhe_cli.engine.states import home
from amhe_cli.logs import LogWriter
from amhe_cli.logs.convert import Columns, joined, write_csv
from amhe_cli.logs.messages.writer import write_samples
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
        delays = np.broadcast_to(system.edits.delays(theta) / self.dt, (len(theta), inputs.shape[2]))
        acting = np.stack([delayed(one, late) for one, late in zip(inputs, delays, strict=True)])
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


#: Topic of the commands of a system whose logs are tables.
_COMMANDS = "/joint_commands"


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """Commands to play on a robot.

    Args:
        times: Evenly spaced times [s], shape (n,).
        targets: Commands at these times, each held until the next [SI], shape (n, k).
        signals: The signals that command the robot; what they command, one after the other, is the columns.
        joints, actuators: Names of the joint and of the actuator of each column.
    """

    times: FloatArray
    targets: FloatArray
    signals: tuple[Signal, ...]
    joints: tuple[str, ...]
    actuators: tuple[str, ...]

    def write(self, folder: Path) -> None:
        """Write `excitation.csv`, `.npz` (times, joints, actuators, targets) and `.mcap` into a folder."""
        samples: Samples = {}
        for signal, first in zip(
            self.signals, np.cumsum([0, *map(len, map(_names, self.signals))]), strict=False
        ):
            values = self.targets[:, first : first + len(_names(signal))]
            samples[signal.key(signal.quantities[0])] = self.times, values
        write_log(folder / "excitation.csv", self.signals, samples, {}, 0.0)
        write_log(folder / "excitation.mcap", self.signals, samples, {}, self.times[1])
        np.savez(
            folder / "excitation.npz",
            times=self.times,
            joints=np.array(self.joints),
            actuators=np.array(self.actuators),
            targets=self.targets,
        )


def log_name(signals: Sequence[Signal]) -> str:
    """Name of the log of a probe: a table where the system reads tables."""
    return "probe.csv" if any(signal.columns for signal in signals) else "probe.mcap"


def write_log(
    path: Path, signals: Sequence[Signal], samples: Samples, about: Mapping[str, str], start: float
) -> None:
    """Write samples as the signals' system reads them: a table (.csv) or messages (.mcap).

    Args:
        path: The file.
        samples: Samples of the signals.
        about: Metadata.
        start: Time of the first sample [s].
    """
    if path.suffix == ".csv":
        parts = [
            Columns(np.round(1e9 * times).astype(np.int64), _names(signal, quantity), values)
            for signal in signals
            for quantity in signal.quantities
            if (key := signal.key(quantity)) in samples and quantity in (signal.columns or signal.quantities)
            for times, values in (samples[key],)
        ]
        write_csv(path, joined(parts), about, 0)
        return
    plain = [replace(one, topic=one.topic or _COMMANDS, columns={}) for one in signals]

    with LogWriter(path, about) as file:
        write_samples(file, plain, samples, lambda time: round(1e9 * (time + start)))


def _names(signal: Signal, quantity: str | None = None) -> tuple[str, ...]:
    """Names of the columns of a signal's quantity in a table."""
    return signal.columns.get(quantity or signal.quantities[0]) or signal.names
