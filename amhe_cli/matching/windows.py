"""Windows of logs, laid out as the arrays that a batch of rollouts needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Rollouts
from amhe_cli.engine.states import home
from amhe_cli.matching.starts import first_errors, first_states
from amhe_cli.system.system import Channel, System


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What one channel measured on c clips, at most `samples` times on each.

    Args:
        rows: Row of `Rollouts` (instant - 1) of each sample, shape (c, samples).
        measured: Shape (c, samples, columns).
        mask: False on padding, shape (c, samples).
        noise: sd of one column.
    """

    channel: Channel
    rows: IntArray
    measured: FloatArray
    mask: BoolArray
    noise: float

    @property
    def width(self) -> int:
        """Residuals of one sample: 3 for a rotation, else one a column."""
        return 3 if self.channel.kind == "rotation" else len(self.channel.columns)

    def pick(self, rollouts: Rollouts, count: tuple[int, int]) -> FloatArray:
        """The rollouts' prediction of every sample, shape (p, c, samples, columns)."""
        source = getattr(rollouts, self.channel.source)
        source = source.reshape(*count, *source.shape[1:])
        clip = np.arange(count[1])[:, None, None]
        return source[:, clip, self.rows[..., None], np.array(self.channel.columns)]


@dataclass(frozen=True, slots=True, eq=False)
class Clips:
    """c windows as arrays.

    Args:
        qpos, qvel: First states, shape (c, nq) and (c, nv).
        inputs: Input vectors from `history` steps before each start, shape (c, history + H, nu).
        delayed: Which of their columns a command delay shifts, shape (nu,).
        lengths: Steps of each, shape (c,).
        observed: The compared channels.
        counts: Scalar measurements in each clip, shape (c,).
        first_index: Coordinates of the tangent first state (2 nv) that were measured, shape (nx,).
        first_sd: Their noise sd, shape (nx,).
        record_bytes: What one candidate's rollouts weigh.
    """

    windows: tuple[Window, ...]
    qpos: FloatArray
    qvel: FloatArray
    inputs: FloatArray
    delayed: BoolArray
    history: int
    lengths: IntArray
    observed: tuple[Observed, ...]
    counts: FloatArray
    first_index: IntArray
    first_sd: FloatArray
    dt: float
    record_bytes: int

    def inputs_under(self, delays: FloatArray) -> FloatArray:
        """Inputs of p candidates with command delays [s] (p,), shape (p * c, H, nu).

        A fraction of a step is interpolated, so that the cost is continuous in the delay.
        """
        horizon = self.inputs.shape[1] - self.history
        prompt = self.inputs[:, self.history :]
        whole, fraction = np.divmod(np.asarray(delays) / self.dt, 1.0)
        taken = []
        for steps, part in zip(whole.astype(int), fraction, strict=True):
            if steps == 0 and part == 0.0:
                taken.append(prompt)
                continue
            late = self.history - steps
            now = self.inputs[:, late : late + horizon]
            before = self.inputs[:, late - 1 : late - 1 + horizon]
            taken.append(np.where(self.delayed, (1.0 - part) * now + part * before, prompt))
        return np.concatenate(taken)


def prepare(
    system: System, windows: Sequence[Window], noise_scale: Mapping[str, float], smoothing: float = 0.0
) -> Clips:
    """Lay out windows of `system`'s logs.

    Args:
        noise_scale: Channel -> factor on its declared noise sd.
        smoothing: See `first_states`.

    Raises:
        LogError: A window starts where the state was not measured.
    """
    lengths = np.array([w.length for w in windows])
    home_qpos, home_input = home(system.model, system.keyframe, system.input_spec)
    qpos, qvel = first_states(system, windows, home_qpos, smoothing)
    history = _history(system)
    inputs = _inputs(system, windows, home_input, history, int(lengths.max()))
    compared = [c for c in system.channels if c.compared and not _derived(c, windows)]
    observed = tuple(_observed(c, windows, noise_scale.get(c.key, 1.0)) for c in compared)
    observed = tuple(o for o in observed if o.mask.any())
    index, sd = first_errors(system, windows[0].log)
    model = system.model
    row = model.nq + model.nv + model.nsensordata + inputs.shape[2]
    return Clips(
        windows=tuple(windows),
        qpos=qpos,
        qvel=qvel,
        inputs=inputs,
        delayed=_delayed(system, inputs.shape[2]),
        history=history,
        lengths=lengths,
        observed=observed,
        counts=np.maximum(sum(o.mask.sum(axis=1) * o.width for o in observed), 1.0),
        first_index=index,
        first_sd=sd,
        dt=model.opt.timestep,
        record_bytes=8 * row * int(lengths.max()) * len(windows),
    )


def _derived(channel: Channel, windows: Sequence[Window]) -> bool:
    return all(w.log[channel.key].derived for w in windows)


def _history(system: System) -> int:
    """Steps before a window's start that its longest command delay reaches back."""
    column = system.edits.delay_column
    if column is None:
        return 0
    return int(np.ceil(system.space.parameters[column].upper / system.model.opt.timestep)) + 1


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
            inputs[i][:, list(source.columns)] = window.log[source.key].values[rows]
    return inputs


def _delayed(system: System, width: int) -> BoolArray:
    delayed = np.zeros(width, dtype=bool)
    for source in system.inputs:
        delayed[list(source.columns)] = source.delayed
    return delayed


def _observed(channel: Channel, windows: Sequence[Window], scale: float) -> Observed:
    """Gather a channel's real samples after each window's first instant, padded to the longest."""
    found = []
    for window in windows:
        series = window.log[channel.key]
        inside = slice(window.start + 1, window.stop + 1)
        found.append(np.flatnonzero(series.sampled[inside] & series.valid[inside]))
    samples = max((f.size for f in found), default=0)
    rows = np.zeros((len(windows), samples), dtype=np.int64)
    mask = np.zeros((len(windows), samples), dtype=bool)
    measured = np.zeros((len(windows), samples, len(channel.columns)))
    if channel.kind == "rotation":
        measured[..., 0] = 1.0
    for i, (window, steps) in enumerate(zip(windows, found, strict=True)):
        rows[i, : steps.size], mask[i, : steps.size] = steps, True
        measured[i, : steps.size] = window.log[channel.key].values[window.start + 1 + steps]
    return Observed(channel, rows, measured, mask, scale * (channel.noise or 1.0))
