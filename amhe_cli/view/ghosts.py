"""Ghosts: clips of logs rolled out from their first states, under several values of the parameters.

Where efforts are matched nothing is rolled out: a ghost is the efforts that the measured motion needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray, IntArray, to_host
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.rollout import Engine, Starts
from amhe_cli.engine.states import collides, home
from amhe_cli.estimation.offline.clips import ClipPool, validation_length
from amhe_cli.matching.cost import MatchingCost, RolledOut
from amhe_cli.matching.readings import reading_of, state_errors
from amhe_cli.matching.starts import first_states
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System
from amhe_cli.view.scene import Geom, Scene, scene_of

#: Values of the parameters as z (d,), or those at a time of the log [s].
Candidate = FloatArray | Callable[[float], FloatArray]

#: Most frames of a second; what lies between them is interpolated.
RATE = 50.0
#: Bytes of all frames: a page of them is below 5 MB.
_BYTES = 3_200_000
#: Share of that for clips; the rest is for the logs as wholes.
_CLIPS = 0.65
#: Pairs of bodies that usually touch, at most.
_TOUCHING = 4
#: Most steps of all clips that are rolled out.
_STEPS = 36_000
#: Most clips.
_TAKES = 150


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Bodies and measured quantities over time, at equal steps.

    Args:
        step: Time between two frames [s].
        poses: Positions [m] and quaternions of the bodies, shape (n, b, 7).
        values: The columns that are plotted, shape (n, k); NaN where there is none.
        forces: Forces between touching bodies, see `Scene.forces`, shape (n, m, 6); None: unknown.
    """

    step: float
    poses: FloatArray
    values: FloatArray
    forces: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What a log measured.

    Args:
        name: Name of the log.
        track: Its states; in a gap the last one before it stays.
        gaps: Times at which a gap begins and ends [s], shape (m, 2).
        curves: Further numbers over its time.
        events: Times that one may want to jump to [s], shape (e,).
    """

    name: str
    track: Track
    gaps: FloatArray
    curves: Sequence[TimeCurve] = ()
    events: Sequence[float] | FloatArray = ()


@dataclass(frozen=True, slots=True, eq=False)
class Take:
    """One clip: what was measured, and what each candidate predicts from the first state on.

    Args:
        recording: Row of its recording.
        window: Its part of the log.
        rows: Its instants that are shown, from its start.
        held_out: Whether it was left out of the fit; None: nothing was fitted.
        costs: Cost of each candidate; infinite where its rollout diverged.
        measured: The states that were measured.
        ghosts: The states that each candidate predicts; None where its rollout diverged.
    """

    recording: int
    window: Window
    rows: IntArray
    held_out: bool | None
    costs: tuple[float, ...]
    measured: Track
    ghosts: tuple[Track | None, ...]

    @property
    def ends(self) -> tuple[float, float]:
        """Times of its first and last instant [s]."""
        return self.window.start * self.window.log.dt, self.window.stop * self.window.log.dt


@dataclass(frozen=True, slots=True)
class Plotted:
    """One column that is plotted: its channel, its own name, its unit and the sd of its noise."""

    channel: str
    name: str
    unit: str
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Viewing:
    """Logs with ghosts.

    Args:
        scene: What is drawn.
        columns: What is plotted.
        candidates: Names of the candidates, the last the best.
        recordings: The logs.
        takes: The clips: those that were held out first, then by the last candidate's cost, largest first.
        left_out: Clips that would be too many.
        logs: What each recording was made of.
        engine: What computes predictions.
    """

    scene: Scene
    columns: tuple[Plotted, ...]
    candidates: tuple[str, ...]
    recordings: tuple[Recording, ...]
    takes: tuple[Take, ...]
    left_out: int
    logs: tuple[MeasuredLog, ...] = ()
    engine: Engine | None = None

    def again(self, take: Take, theta: FloatArray) -> tuple[Track | None, float]:
        """The ghost of a clip under other values of the parameters (d,), and its cost.

        Raises:
            ConfigError: A value is not within its bounds.
        """
        measured, space = self.logs[take.recording], self.scene.system.space
        assert self.engine is not None, "nothing was recorded"
        (one,) = _predicted(measured.scene.system, [take.window], space.z_of(theta), self.engine)
        return one.ghost(measured, take.rows, take.measured), one.cost


def viewing(
    system: System,
    parts: Sequence[tuple[Window, bool | None]],
    candidates: Mapping[str, Candidate],
    engine: Engine,
    most: int = _STEPS,
    more: Sequence[Geom] = (),
) -> Viewing:
    """Logs, and their clips rolled out under each candidate.

    Args:
        parts: Parts of the logs, and whether each was held out; None: nothing was fitted.
        candidates: Name of a candidate -> its values; the best one last.
        engine: The system's engine.
        most: Most steps of all clips; of more clips some from all over the logs are taken.
        more: Geoms that do not move, drawn beside the model's own.

    Raises:
        LogError: A log has no instant at which all of the state was measured.
    """
    scene, logs = scene_of(system, more), list({id(part.log): part.log for part, _ in parts}.values())
    settings = system.settings.clips
    length = validation_length(settings)
    cut = [(w, held) for part, held in parts for w in ClipPool(system, [part], settings).cut(length)]
    kept = cut[:: max(1, -(-sum(w.length for w, _ in cut) // most), -(-len(cut) // _TAKES))]
    columns = tuple(columns_of(system, logs[0]))
    frame = 14 * len(scene.bodies) + 2 * len(columns) + 12 * _TOUCHING * collides(system.model)
    seconds = (1 + len(candidates)) * sum(w.duration for w, _ in kept)
    rate = min(RATE, _CLIPS * _BYTES / max(frame * seconds, 1e-9))
    coarse = min(RATE, (1.0 - _CLIPS) * _BYTES / max(frame * sum(log.duration for log in logs), 1e-9))
    values = list(candidates.values())
    recordings, takes, read = [], [], []
    for number, log in enumerate(logs):
        end = values[-1](log.duration) if callable(values[-1]) else values[-1]
        measured = MeasuredLog(scene, log, end)
        read.append(measured)
        recordings.append(Recording(Path(log.source).name, measured.track(coarse), measured.gaps))
        own = [(w, held) for w, held in kept if w.log is log]
        takes += takes_of(measured, number, own, values, engine, rate) if own else ()
    takes.sort(key=lambda take: (take.held_out is not True, -take.costs[-1]))
    return Viewing(
        scene, columns, tuple(candidates), tuple(recordings), tuple(takes), len(cut) - len(kept),
        tuple(read), engine,
    )  # fmt: skip


def columns_of(system: System, log: Log) -> Iterator[Plotted]:
    """What is plotted of a system's logs."""
    for channel in _shown(system):
        names = ("x", "y", "z") if channel.kind == "rotation" else log[channel.key].columns
        for i, name in enumerate(names):
            yield Plotted(channel.key, name, channel.units[i % len(channel.units)], channel.noise or 0.0)


def _shown(system: System) -> list[Channel]:
    return [channel for channel in system.channels if channel.compared]


class MeasuredLog:
    """States of a log at any of its rows, as true states under z (d,)."""

    def __init__(self, scene: Scene, log: Log, z: FloatArray) -> None:
        system = scene.system
        self.scene, self.log, self.z = scene, log, z
        self.keys = tuple(c.key for c in system.channels if c.sets_state)
        self.keys += system.keys if system.model.nmocap else ()
        self.usable = log.usable(self.keys)
        first = int(np.argmax(self.usable))
        newest = np.maximum.accumulate(np.where(self.usable, np.arange(log.steps, dtype=np.int32), -1))
        self._known = np.maximum(newest, first)  # for each row the newest one with a whole state
        rest = Window(log, first, log.steps - 1 - first if system.model.nmocap else 1)
        self._starts = starts_of(system, [rest], 0.0)  # refuses a log that never has a whole state
        self._first = first
        self._home = home(system.model, system.keyframe, system.input_spec)[0]
        self.zero = {
            c.key: log[c.key].values[int(np.argmax(log[c.key].valid))]
            for c in _shown(system)
            if c.kind == "rotation"
        }

    @property
    def gaps(self) -> FloatArray:
        """Times at which a gap begins and ends [s], shape (m, 2)."""
        edges = np.flatnonzero(np.diff(np.concatenate(([True], self.usable, [True])).astype(int)))
        return np.array(edges.reshape(-1, 2) * self.log.dt, dtype=np.float64)

    def track(self, rate: float) -> Track:
        """All of the log."""
        every = _stride(rate, self.log.dt)
        return self.at(np.arange(0, self.log.steps, every))

    def at(self, rows: IntArray) -> Track:
        """The states at some rows, shape (n,), which lie equally far apart."""
        system, log = self.scene.system, self.log
        single, back = np.unique(self._known[rows], return_inverse=True)
        qpos, qvel = first_states(system, [Window(log, int(row), 1) for row in single], self._home, 0.0)
        starts = replace(self._starts, qpos=qpos, qvel=qvel, lengths=np.ones(len(single), dtype=np.int64))
        theta = self.theta(self.z)
        true = starts.states(system.model, 1, state_errors(system, theta, starts))[0][0]
        driven = self._starts.inputs[0, self._starts.history :]
        inputs = driven[np.clip(single - self._first, 0, len(driven) - 1)] if system.model.nmocap else None
        step = log.dt * float(rows[1] - rows[0]) if len(rows) > 1 else log.dt
        return Track(step, self.scene.poses(true, inputs)[back], self._values(rows))

    def theta(self, z: FloatArray) -> FloatArray:
        """Values of the parameters on this log, shape (1, d)."""
        system = self.scene.system
        theta = system.space.theta_of(system.space.clip(z))[None]
        return values_on(self.log, system.edits.space, system.space, theta)

    def _values(self, rows: IntArray) -> FloatArray:
        found = []
        for channel in _shown(self.scene.system):
            series = self.log[channel.key]
            values = np.where(series.valid[rows, None], series.values[rows], np.nan)
            if channel.kind == "rotation":
                values = continued(rotations.difference(values, self.zeros(channel, len(rows))))
            found.append(values)
        return np.concatenate(found, axis=1) if found else np.empty((len(rows), 0))

    def zeros(self, channel: Channel, count: int) -> FloatArray:
        """The orientation from which a channel is counted, shape (count, 4)."""
        return np.broadcast_to(self.zero[channel.key], (count, 4))


@dataclass(frozen=True, slots=True, eq=False)
class _Efforts:
    """Efforts that a candidate needs along the motion of a clip, shape (n, k), at rows of the clip (n,)."""

    rows: IntArray
    values: FloatArray
    cost: float

    def ghost(self, _: MeasuredLog, rows: IntArray, own: Track) -> Track | None:
        """The efforts at some instants of the clip, beside the motion that was measured."""
        if not math.isfinite(self.cost):
            return None
        open_ends = {"left": np.nan, "right": np.nan}
        columns = [np.interp(rows, self.rows, column, **open_ends) for column in self.values.T]
        return Track(own.step, own.poses, np.stack(columns, axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class _Rollout:
    """Row i of rollouts from some starts, and its cost; the model if its contact forces are shown."""

    rolled: RolledOut
    starts: Starts
    i: int
    cost: float
    model: mujoco.MjModel | None = None

    def ghost(self, measured: MeasuredLog, rows: IntArray, own: Track) -> Track | None:
        """The clip at some of its instants, with the forces of its model; None where it diverged."""
        rolled, i = self.rolled, self.i
        if not rolled.rollouts.completed[i]:
            return None
        system, theta, some = measured.scene.system, rolled.theta[None], self.starts.of(np.array([i]))
        qpos, qvel = (state[0] for state in some.states(system.model, 1, state_errors(system, theta, some)))
        states = {
            "qpos": np.concatenate((qpos, rolled.rollouts.qpos[i]))[rows],
            "qvel": np.concatenate((qvel, rolled.rollouts.qvel[i]))[rows],
        }
        if (sensors := rolled.rollouts.sensordata) is not None:
            states["sensordata"] = np.concatenate((np.full((1, sensors.shape[-1]), np.nan), sensors[i]))[rows]
        driven = rolled.inputs[i][np.minimum(rows, len(rolled.inputs[i]) - 1)]
        numbers, found = system.edits.numbers(theta), []
        for channel in _shown(system):
            true = states[channel.source][None][..., list(channel.columns)]
            shown = reading_of(channel, system.calibration.readings.get(channel.key), numbers, true)[0]
            if channel.kind == "rotation":
                first = sum(values.shape[1] for values in found)
                turned = rotations.difference(shown, measured.zeros(channel, len(rows)))
                shown = continued(turned, own.values[0, first : first + 3])
            found.append(shown)
        values = np.concatenate(found, axis=1) if found else np.empty((len(rows), 0))
        scene, model = measured.scene, self.model
        poses = scene.poses(states["qpos"], driven if system.model.nmocap else None)
        forces = None if model is None else scene.forces(model, states["qpos"], states["qvel"], driven)
        return Track(own.step, poses, values, forces)


def _predicted(
    system: System, windows: Sequence[Window], candidate: Candidate, engine: Engine, forces: bool = False
) -> Iterator[_Rollout | _Efforts]:
    """Clips of one log under a candidate, each with the values where the clip starts."""
    if callable(candidate):
        for window in windows:
            z = candidate(window.start * window.log.dt)
            yield from _predicted(system, [window], z, engine, forces)
        return
    cost = MatchingCost(system, windows, engine, system.settings.cost)
    if system.match == "effort":
        yield from _needed(cost, candidate)
        return
    (rolled,) = cost.rolled_out(candidate, None)  # one log: its clips are rolled out together
    costs = cost.clip_costs(cost.residuals_of(rolled))[0]
    model = system.edits.apply(system.model, rolled.theta) if forces else None
    for i in range(len(windows)):
        yield _Rollout(rolled, cost.clips.starts, i, float(costs[i]), model)


def _needed(cost: MatchingCost, z: FloatArray) -> Iterator[_Efforts]:
    """What the motion of clips of one log needs under z (d,); NaN in columns that are compared nowhere."""
    predicted, channels = cost.predict(z[None]), _shown(cost.system)
    log, costs = cost.clips.windows[0].log, cost.clip_costs(cost.residuals(z[None]))[0]
    names = [part.key for channel in channels for part in channel.parts(log[channel.key].columns)]
    known = {
        one.channel.key: to_host(of[0]) for one, of in zip(cost.clips.observed, predicted.values, strict=True)
    }
    for i, of_log in enumerate(costs):
        rows = cost.clips.observed[0].rows[i] + 1
        own = rows[: 1 + int(np.count_nonzero(np.diff(rows) > 0))]  # the rest pads it
        none = np.full(len(own), np.nan)
        columns = [known[name][i, : len(own), 0] if name in known else none for name in names]
        yield _Efforts(own, np.stack(columns, axis=1), float(of_log))


def takes_of(
    measured: MeasuredLog,
    recording: int,
    windows: Sequence[tuple[Window, bool | None]],
    candidates: Sequence[Candidate],
    engine: Engine,
    rate: float,
) -> Iterator[Take]:
    """Clips of one log, with ghosts.

    Args:
        measured: The log.
        recording: Row of its recording.
        windows: The clips, and whether each was held out.
        engine: The system's engine.
        rate: Frames of a second.
    """
    system, dt, clips = measured.scene.system, measured.log.dt, [window for window, _ in windows]
    touching = [one is candidates[-1] and collides(system.model) for one in candidates]
    every = [
        _predicted(system, clips, one, engine, forces)
        for one, forces in zip(candidates, touching, strict=True)
    ]
    for (window, held_out), *predictions in zip(windows, *every, strict=True):
        rows = np.arange(0, window.length + 1, min(_stride(rate, dt), window.length))
        own = measured.at(window.start + rows)
        ghosts = tuple(one.ghost(measured, rows, own) for one in predictions)
        yield Take(recording, window, rows, held_out, tuple(one.cost for one in predictions), own, ghosts)


def continued(vectors: FloatArray, near: FloatArray | None = None) -> FloatArray:
    """Rotation vectors (n, 3) with as many whole turns added as keep them together.

    Args:
        vectors: The vectors [rad]; NaN where there is none.
        near: What the first one lies near, shape (3,).
    """
    found = np.array(vectors)
    last = np.zeros(3) if near is None or np.isnan(near).any() else near
    for k, vector in enumerate(found):
        if (angle := float(np.linalg.norm(vector))) > 1e-9:
            axis = vector / angle
            found[k] = axis * (angle + 2.0 * np.pi * np.round((axis @ last - angle) / (2.0 * np.pi)))
        if np.isfinite(vector).all():
            last = found[k]
    return found


def _stride(rate: float, dt: float) -> int:
    return max(1, math.ceil(1.0 / (rate * dt) - 1e-9))
