"""From predictions to readings, and back: signals as their sensors show them, in the log's own frame.

See `system.calibration` for the equation. It acts on what an engine predicts, where that lies, and on the
first states that a log gives; engines know nothing of it.
"""

from __future__ import annotations

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import AnyArray, FloatArray, namespace_of
from amhe_cli.engine.rollout import Starts
from amhe_cli.matching.starts import tangent_of, unmeasured
from amhe_cli.system.description.data import Channel
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.calibration import Reading
from amhe_cli.system.system import System


def reading_of(channel: Channel, reading: Reading | None, numbers: FloatArray, true: AnyArray) -> AnyArray:
    """Sensor reading of true values.

    Args:
        reading: Its reading; None: it shows the truth.
        numbers: Numbers of the calibration under p candidates, shape (p, n).
        true: Values of the model, shape (p, ..., columns), numpy's or on a device.
    """
    if reading is None:
        return true
    xp = namespace_of(true)

    def wide(values: FloatArray) -> AnyArray:
        """Numbers (p, k) or (p, 1) beside the values."""
        return xp.asarray(values.reshape(len(values), *([1] * (true.ndim - 2)), -1))

    if reading.frame:
        frame = numbers[:, list(reading.frame)]
        turn = xp.broadcast_to(wide(rotations.conjugate(_turn(frame))), (*true.shape[:-1], 4))
        if channel.kind == "rotation":
            return rotations.multiply(turn, true)
        true = rotations.rotate(turn, true - wide(frame[:, :3]) if reading.origin else true)
    if reading.scale:
        true = wide(numbers[:, list(reading.scale)]) * true
    if reading.sign != 1.0:
        true = reading.sign * true
    return true + wide(numbers[:, list(reading.bias)]) if reading.bias else true


def true_of(channel: Channel, reading: Reading, numbers: FloatArray, shown: FloatArray) -> FloatArray:
    """True values (p, c, columns) behind readings (c, columns) of a state: the inverse of `reading_of`."""
    true = np.repeat(shown[None], len(numbers), axis=0)
    if reading.bias:
        true = true - numbers[:, None, list(reading.bias)]
    if reading.scale:
        true = true / numbers[:, None, list(reading.scale)]
    if not reading.frame:
        return true
    frame = numbers[:, None, list(reading.frame)]
    turn = np.broadcast_to(_turn(frame), (*true.shape[:-1], 4))
    if channel.kind == "rotation":
        return rotations.multiply(turn, true)
    true = rotations.rotate(turn, true)
    return true + frame[..., :3] if reading.origin else true


def state_errors(system: System, theta: FloatArray, starts: Starts) -> FloatArray | None:
    """Errors of recorded first states that are due to calibration and gaps.

    Args:
        theta: Parameters of p candidates, shape (p, d).
        starts: First states of c clips, as recorded.

    Returns:
        Errors in units of their sd, shape (p, c, nx); None where no parameter changes the first states.
    """
    readings, model = system.calibration.readings, system.model
    channels = [c for c in system.channels if c.sets_state and c.key in readings]
    widened = gaps(model) if "tendon_range" in system.edits.fields else []
    if not channels and not widened:
        return None
    delta = np.zeros((len(theta), len(starts.lengths), 2 * model.nv))
    numbers = system.edits.numbers(theta)
    for channel in channels:
        shown = (starts.qpos if channel.source == "qpos" else starts.qvel)[:, list(channel.columns)]
        true = true_of(channel, readings[channel.key], numbers, shown)
        difference = (
            rotations.difference(true, np.broadcast_to(shown, true.shape))
            if (channel.kind == "rotation")
            else true - shown
        )
        delta[..., tangent_of(system, channel)] = difference
    if widened:
        half = system.edits.written(theta)["tendon_range"][:, :, 1]
        for gap, beside, measured in unmeasured(system, widened):
            away = starts.qpos[:, model.jnt_qposadr[beside]] - starts.qpos[:, model.jnt_qposadr[measured]]
            wider = half[:, gap.tendon] - model.tendon_range[gap.tendon, 1]
            delta[..., model.jnt_dofadr[beside]] = wider[:, None] * np.sign(away)
    return delta[..., starts.first_index] / starts.first_sd


def averaged(reading: Reading, numbers: FloatArray, dt: float, values: AnyArray) -> AnyArray:
    """The mean over a sensor's memory, newest first: a low-pass of first order at its band.

    Args:
        reading: The reading; it has a band.
        numbers: Numbers of the calibration under p candidates, shape (p, n).
        dt: Time between two values [s].
        values: Shape (p, c, s, memory, k).
    """
    assert reading.band is not None
    xp = namespace_of(values)
    age = dt * np.arange(values.shape[3])
    weights = np.exp(-2.0 * np.pi * numbers[:, reading.band, None] * age)
    weights /= weights.sum(axis=1, keepdims=True)
    return xp.einsum("pm,pcsmk->pcsk", xp.asarray(weights), values)


def remembered(reading: Reading | None, dt: float) -> int:
    """Number of a model's steps that a sensor averages over."""
    return 1 if reading is None or reading.band is None else max(1, int(np.ceil(reading.memory / dt)))


def _turn(frame: FloatArray) -> FloatArray:
    """Quaternions of frames (..., 6) of x, y, z, roll, pitch, yaw: turned about x, then y, then z."""
    return rotations.of_rpy(frame[..., 3:])
