"""The measured motion of several logs, what drove the model along it, and a filter for forces.

Forces along the motion go through a filter without phase. Its Gaussian has the motion's own band: what the
motion lost to smoothing, commands lose too. Its exponential is a low pass of second order from the motion's
usual frequency on: the noise of accelerations grows with the square of the frequency, and becomes white.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.each_log import values_on
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.rollout import delayed
from amhe_cli.engine.states import controls, filters, first_activations, home
from amhe_cli.matching.motion import motion_of
from amhe_cli.matching.windows import driving
from amhe_cli.system.system import System

#: Sd of the Gaussian that passes a band of 1 Hz at -3 dB [s], and where it ends, in its sd.
_WIDTH, _ENDS = 0.1325, 4.0
#: The filter's band as a share of the motion's, at least 1 Hz.
_SHARE, _LOWEST = 0.7, 1.0
#: No more instants than about these are looked at, over all logs; and rows in an sd of the filter, at least.
MOST, _FINE = 2000, 1.5
#: Instants of a piece, where there are more of them than are looked at.
_PIECE = 150
#: Fewer instants of a stretch tell nothing.
_FEW = 30


@dataclass(frozen=True, slots=True, eq=False)
class DrivenMotion:
    """Stretches of measured motion, one after the other.

    Args:
        qpos, qvel, qacc: The motion, shape (n, nq), (n, nv), (n, nv).
        inputs: What drove the model at those instants, shape (n, nu).
        act: Activations of the actuators, shape (n, na).
        time: Time in the log [s], shape (n,).
        log: Number of the log, shape (n,).
        stretches: Unbroken stretches of rows.
        dofs: Degrees of freedom that were measured.
        period: Time between two rows [s].
        band: Band of the filter [Hz].
        usual: Usual frequency of the motion [rad/s].
    """

    qpos: FloatArray
    qvel: FloatArray
    qacc: FloatArray
    inputs: FloatArray
    act: FloatArray
    time: FloatArray
    log: IntArray
    stretches: tuple[slice, ...]
    dofs: tuple[int, ...]
    period: float
    band: float
    usual: float

    @property
    def reach(self) -> int:
        """Rows that the filter reaches to either side, but for a few per cent."""
        return int(np.ceil((2.0 * _WIDTH / self.band + 3.0 / self.usual) / self.period))

    def filtered(self, values: FloatArray) -> FloatArray:
        """Forces (n, ...) through the filter, each stretch for itself."""
        half = max(1, round(_ENDS * max(_WIDTH / self.band, 1.0 / self.usual) / self.period))
        time = np.arange(-half, half + 1) * self.period
        gauss = np.exp(-0.5 * (time * self.band / _WIDTH) ** 2)
        kernel = np.convolve(gauss / gauss.sum(), np.exp(-self.usual * np.abs(time)))
        kernel /= kernel.sum()
        found = np.array(values, dtype=np.float64)
        for stretch in self.stretches:
            found[stretch] = _convolved(found[stretch], kernel)
        return found


def _convolved(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """Values (n, ...) under a symmetric kernel; at the ends it is cut, and normalised."""
    flat = values.reshape(len(values), -1)
    size = 2 ** int(np.ceil(np.log2(len(flat) + kernel.size)))
    shape, half = np.fft.rfft(kernel, size)[:, None], kernel.size // 2

    def through(one: FloatArray) -> FloatArray:
        found = np.fft.irfft(np.fft.rfft(one, size, axis=0) * shape, size, axis=0)
        return np.asarray(found[half : half + len(one)])

    return (through(flat) / through(np.ones((len(flat), 1)))).reshape(values.shape)


def motion_in(
    system: System, parts: Sequence[Window], theta: FloatArray, most: int = MOST
) -> DrivenMotion | None:
    """The motion in some parts of logs, as far as they have it; None where they have none.

    Args:
        parts: Parts of its logs.
        theta: Unknowns of the search, shape (d,): they say how late commands act.
        most: No more instants than about these.
    """
    logs, found, bands = list(dict.fromkeys(part.log for part in parts)), [], []
    known = np.ones(system.model.nv, dtype=bool)
    total = sum(part.length for part in parts)
    for part in parts:
        try:
            measured = motion_of(system, part.log)
        except LogError:
            continue
        whole = measured.within(part.start, part.stop)
        driven = _driven(system, part.log, theta, round(measured.step / system.dt))
        for number in np.unique(measured.stretch[whole]):
            rows = np.arange(len(measured.rows))[whole]
            found.append((measured, rows[measured.stretch[rows] == number], driven, part.log))
        known &= measured.sd[0] > 0.0
        # what stands has none
        bands.append(np.where(measured.band > 0.0, measured.band, 0.5 / measured.step))
    if not found:
        return None
    dofs = tuple(map(int, np.flatnonzero(known)))
    band = max(_LOWEST, _SHARE * float(np.median(bands, axis=0)[list(dofs)].min()))
    step = found[0][0].step
    sparse = max(1, min(int(total * system.dt / step) // most, int(_WIDTH / _FINE / band / step)))
    made, stretches, at = [], [], 0
    share = most * sparse / sum(rows.size for _, rows, *_ in found)
    pieces = [(one, piece, *rest) for one, rows, *rest in found for piece in _pieces(rows[::sparse], share)]
    for measured, rows, (inputs, act), log in pieces:
        if rows.size < _FEW:
            continue
        when = measured.rows[rows]
        state = measured.qpos[rows], measured.qvel[rows], measured.qacc[rows]
        made.append((*state, inputs[when], act[when], when * log.dt, np.full(rows.size, logs.index(log))))
        stretches.append(slice(at, at := at + rows.size))
    if not made:
        return None
    arrays = [np.concatenate(each) for each in zip(*made, strict=True)]
    speed, acceleration = (arrays[i][:, list(dofs)].std(axis=0) for i in (1, 2))
    slowest = 1.0 / (len(arrays[0]) * sparse * step)  # of a motion that stands
    usual = max(float(np.median(acceleration / np.maximum(speed, 1e-12))), slowest)
    qpos, qvel, qacc, inputs, act, time, log = arrays
    return DrivenMotion(
        qpos, qvel, qacc, inputs, act, time, log, tuple(stretches), dofs, sparse * step, band, usual
    )


def _pieces(rows: IntArray, share: float) -> Iterator[IntArray]:
    """A share of the rows of a stretch, as pieces spread evenly over it; all of them where the share is 1.

    No piece is too short to be of use: many short stretches give more than the share.
    """
    if share >= 1.0:
        yield rows
        return
    count = max(1, round(rows.size * share / _PIECE))
    size = min(max(int(rows.size * share / count), _FEW), rows.size)
    for first in np.linspace(0, rows.size - size, count).astype(int):
        yield rows[first : first + size]


def _driven(system: System, log: Log, theta: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Inputs (T, nu) as they act, averaged over so many rows, and activations (T, na) that follow them."""
    own = values_on(log, system.edits.space, system.space, theta[None])
    inputs = np.tile(home(system.model, system.keyframe, system.input_spec)[1], (log.steps, 1))
    for source in system.inputs:
        values = driving(source, log)
        inputs[:, list(source.columns)] = np.where(np.isfinite(values), values, 0.0)
    late = np.broadcast_to(system.edits.delays(own)[0] / log.dt, inputs.shape[1:])
    inputs = delayed(inputs, late)
    act = _activations(system, inputs, log.dt)
    weights = np.ones(width + 1 - width % 2)  # symmetric: an input acts about its row
    weights[[0, -1]] = 0.5 + 0.5 * (width % 2)
    return (_convolved(inputs, weights) if inputs.shape[1] and width > 1 else inputs), act


def _activations(system: System, inputs: FloatArray, dt: float) -> FloatArray:
    """Activations that follow their commands through a filter of first order, shape (n, na)."""
    model, place = system.model, controls(system.model, system.input_spec)
    if not model.na or place is None:
        return np.zeros((len(inputs), model.na))
    act = first_activations(model, np.tile(model.qpos0, (len(inputs), 1)), inputs[:, place])
    for at, _, time in filters(model):
        share, value = 1.0 - np.exp(-dt / time), act[0, at]
        for k in range(len(act)):
            act[k, at] = value = value + share * (act[k, at] - value)
    return act
