"""Windows of logs, laid out as the arrays that a batch of rollouts needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.rollout import Starts, Wanted
from amhe_cli.engine.states import home
from amhe_cli.matching.efforts import along_of, measured_effort
from amhe_cli.matching.readings import remembered
from amhe_cli.matching.starts import first_index, first_sds, first_states
from amhe_cli.system.description.data import Channel, Input
from amhe_cli.system.system import System


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Measurements of one channel on c clips, at most s on each.

    Args:
        rows: Row (instant - 1) of each sample in a rollout, shape (c, s); padded with 0.
        memory: Steps that the sensor averages over, the sample's own the last.
        measured: The measurements, shape (c, s, columns).
        mask: False on padding, shape (c, s).
        noise: Sd of one column [SI]; shape (c, s, 1) where it differs from sample to sample.
    """

    channel: Channel
    rows: IntArray
    memory: int
    measured: FloatArray
    mask: BoolArray
    noise: float | FloatArray

    def of(self, clips: IntArray) -> Observed:
        """The measurements on some of the clips."""
        noise = self.noise[clips] if isinstance(self.noise, np.ndarray) else self.noise
        rows, measured, mask = (array[clips] for array in (self.rows, self.measured, self.mask))
        return replace(self, rows=rows, measured=measured, mask=mask, noise=noise)

    @property
    def wanted(self) -> Wanted:
        """Request to an engine for the samples' predictions, newest first, shape (c, s * memory)."""
        if self.channel.source == "effort":  # an engine that follows the motion has no other instants
            rows = np.broadcast_to(np.arange(self.rows.shape[1]), self.rows.shape)
            return Wanted("effort", rows, self.channel.columns)
        ages = np.arange(self.memory)
        rows = np.maximum(self.rows[..., None] - ages, 0).reshape(len(self.rows), -1)
        return Wanted(self.channel.source, rows, self.channel.columns)

    @property
    def width(self) -> int:
        """Residuals of one sample: 3 for a rotation, else one for each column."""
        return 3 if self.channel.kind == "rotation" else len(self.channel.columns)


@dataclass(frozen=True, slots=True, eq=False)
class Clips:
    """c windows as arrays.

    Args:
        starts: First states and inputs of the windows, for an engine.
        observed: What the compared channels measured.
        counts: Number of scalar measurements in each clip, shape (c,); at least 1.
    """

    windows: tuple[Window, ...]
    starts: Starts
    observed: tuple[Observed, ...]
    counts: FloatArray

    def of(self, clips: IntArray) -> Clips:
        """Some of the clips."""
        observed = tuple(o.of(clips) for o in self.observed)
        windows = tuple(self.windows[i] for i in clips)
        return Clips(windows, self.starts.of(clips), observed, self.counts[clips])


def prepare(
    system: System, windows: Sequence[Window], noise_scale: Mapping[str, float], smoothing: float = 0.0
) -> Clips:
    """Lay out windows of a system's logs.

    Args:
        windows: The windows; a series that a window's log has differentiated is no measurement of it.
        noise_scale: Channel -> factor on its declared noise sd.
        smoothing: First positions are smoothed over this time [s], see `first_states`.

    Raises:
        LogError: A window starts where the state was not measured.
    """
    compared, starts = [c for c in system.channels if c.compared], starts_of(system, windows, smoothing)
    if system.match == "effort":
        starts, observed = _following(system, compared, windows, noise_scale, starts)
    else:
        memory = {c.key: remembered(system.calibration.readings.get(c.key), system.dt) for c in compared}
        observed = [_observed(c, windows, noise_scale.get(c.key, 1.0), memory[c.key]) for c in compared]
    observed = tuple(o for o in observed if o.mask.any())
    return Clips(
        windows=tuple(windows),
        starts=starts,
        observed=observed,
        counts=np.maximum(sum(o.mask.sum(axis=1) * o.width for o in observed), 1.0),
    )


def starts_of(system: System, windows: Sequence[Window], smoothing: float) -> Starts:
    """First states and inputs of windows; see `prepare`."""
    lengths = np.array([w.length for w in windows])
    home_qpos, home_input = home(system.model, system.keyframe, system.input_spec)
    qpos, qvel = first_states(system, windows, home_qpos, smoothing)
    history = _history(system)
    return Starts(
        qpos=qpos,
        qvel=qvel,
        inputs=_inputs(system, windows, home_input, history, int(lengths.max())),
        history=history,
        lengths=lengths,
        first_index=first_index(system),
        first_sd=first_sds(system, [w.log for w in windows]),
    )


def _following(
    system: System,
    compared: Sequence[Channel],
    windows: Sequence[Window],
    noise_scale: Mapping[str, float],
    starts: Starts,
) -> tuple[Starts, list[Observed]]:
    """Starts with the windows' motion, and each joint's effort along it."""
    along, places = along_of(system, windows)
    count, most = along.qvel.shape[:2]
    rows = np.zeros((count, most), dtype=np.int64)
    for i, (window, (path, instants)) in enumerate(zip(windows, places, strict=True)):
        rows[i, : instants.size] = path.rows[instants] - window.start - 1
    observed = []
    for channel in compared:
        names = windows[0].log[channel.key].columns
        for part in channel.parts(names):
            values, sd = np.zeros((count, most, 1)), np.ones((count, most, 1))
            mask = np.zeros((count, most), dtype=bool)
            for i, (window, (path, instants)) in enumerate(zip(windows, places, strict=True)):
                span = i, slice(0, instants.size)
                values[(*span, 0)], mask[span], sd[(*span, 0)] = measured_effort(part, window, path, instants)
            scale = noise_scale.get(part.key, 1.0)
            observed.append(Observed(part, rows, 1, values, mask, scale * sd))
    return replace(starts, along=along), observed


def _history(system: System) -> int:
    """Steps before a window's start that its longest command delay reaches back."""
    longest = system.edits.longest_delay
    return int(np.ceil(longest / system.model.opt.timestep)) + 1 if longest else 0


def _inputs(
    system: System, windows: Sequence[Window], home_input: FloatArray, history: int, horizon: int
) -> FloatArray:
    """Input vectors of each window and of `history` steps before it.

    Before the log began its first row is repeated, after the window's end its last.
    """
    inputs = np.tile(home_input, (len(windows), history + horizon, 1))
    for i, window in enumerate(windows):
        rows = np.clip(np.arange(window.start - history, window.start + horizon), 0, window.stop - 1)
        for source in system.inputs:
            inputs[i][:, list(source.columns)] = driving(source, window.log)[rows]
    return inputs


def driving(source: Input, log: Log) -> FloatArray:
    """Values of an input over a log, shape (T, columns): in the model's frame, or as a force's moment."""
    values = log[source.key].values
    if source.frame:
        origin, turn = np.array(source.frame[:3]), rotations.of_rpy(np.array(source.frame[3:]))
        if values.shape[1] == 4:
            return rotations.multiply(np.broadcast_to(turn, values.shape), values)
        return rotations.rotate(turn, values) + origin
    if source.arm is not None:
        point, centre = source.arm
        arm = log[point].values - (log[centre].values if centre is not None else 0.0)
        return np.cross(arm, values)
    return values


def _observed(channel: Channel, windows: Sequence[Window], scale: float, memory: int) -> Observed:
    """Gather a channel's real samples after each window's first instant, padded to the longest.

    Samples that remember more than the window are left out, and so are differentiated ones: they are no
    second measurement.
    """
    kept = []
    for window in windows:
        series = window.log[channel.key]
        inside = slice(window.start + 1, window.stop + 1)
        real = (series.sampled & series.valid)[inside][memory - 1 :]
        kept.append(memory - 1 + np.flatnonzero(real & (not series.derived)))
    samples = max((f.size for f in kept), default=0)
    rows = np.zeros((len(windows), samples), dtype=np.int64)
    mask = np.zeros((len(windows), samples), dtype=bool)
    measured = np.zeros((len(windows), samples, len(channel.columns)))
    if channel.kind == "rotation":
        measured[..., 0] = 1.0
    for i, (window, steps) in enumerate(zip(windows, kept, strict=True)):
        rows[i, : steps.size], mask[i, : steps.size] = steps, True
        measured[i, : steps.size] = window.log[channel.key].values[window.start + 1 + steps]
    return Observed(channel, rows, memory, measured, mask, scale * (channel.noise or 1.0))
