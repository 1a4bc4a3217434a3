"""Values that are physically impossible, and velocities in another frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import messages
from amhe_cli.logs.messages.decode import SignalSamples

#: A quaternion whose norm is off by more than this is not a rotation but damage or no data.
_NORM = 0.05
#: No SI quantity of a robot is larger.
_ABSURD = 1e9
#: A velocity that is off by less [m/s] may be noise.
_TWIST_ERROR = 0.05
#: Half of the time [s] over which positions are compared with a velocity.
_TWIST_SPAN = 0.01


def checked(samples: SignalSamples, signal: Signal, warn: Callable[[str], None]) -> SignalSamples:
    """Replace impossible values by NaN, count them, and normalise quaternions.

    A pose without a rotation was not measured: motion capture that loses its markers sends zeros. Its
    position is dropped too, unless no message of the topic has a rotation at all.
    """
    values = dict(samples.values)
    for quantity, block in samples.values.items():
        plain = quantity == "value" and not signal.is_input  # a number of any unit, which drives nothing
        ends = (float(end.reduce(block, axis=None, initial=0.0)) for end in (np.fmax, np.fmin))
        if plain or not any(abs(end) > _ABSURD for end in ends):  # as in most logs: nothing is copied
            continue
        with np.errstate(invalid="ignore"):
            absurd = np.any(np.abs(block) > _ABSURD, axis=1)
        warn(f"{messages(int(absurd.sum()))} with impossible {quantity} dropped")
        values[quantity] = np.where(absurd[:, None], np.nan, block)
    if "orientation" in values:
        _check_rotation(values, signal, warn)
    return replace(samples, values=values)


def _check_rotation(values: dict[str, FloatArray], signal: Signal, warn: Callable[[str], None]) -> None:
    quaternions = values["orientation"]
    lost = ~(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) <= _NORM)
    if lost.all() and "orientation" not in signal.quantities:
        return
    values["orientation"] = np.where(
        lost[:, None], np.nan, rotations.normalised(np.where(lost[:, None], 1.0, quaternions))
    )
    if lost.any() and not lost.all():
        warn(f"{messages(int(lost.sum()))} without a valid quaternion (zero, NaN, not of unit norm) dropped")
    if "position" in values and lost.any():
        for quantity, block in values.items():
            values[quantity] = np.where(lost[:, None], np.nan, block)


def twist_looks_global(times: FloatArray, samples: SignalSamples, turned: FloatArray) -> bool:
    """Whether an odometry's velocity fits its positions only if it is *not* turned out of the child frame.

    Args:
        times: Stamps [s], shape (m,).
        samples: The samples, with position and linear_velocity as logged, shape (m, 3).
        turned: The velocity turned into the world as ROS defines it, shape (m, 3).
    """
    if not samples.twist_in_child:
        return False
    position, logged = samples.values["position"], samples.values["linear_velocity"]
    known = np.isfinite(position).all(axis=1) & np.isfinite(turned).all(axis=1)
    times, position, turned, logged = times[known], position[known], turned[known], logged[known]
    if times.size < 10:
        return False
    half = min(int(np.ceil(_TWIST_SPAN / np.median(np.diff(times)))), (times.size - 1) // 2)
    early, middle, late = (slice(i, times.size - 2 * half + i) for i in (0, half, 2 * half))
    moved = (position[late] - position[early]) / (times[late] - times[early])[:, None]
    as_ros_says, as_logged = (
        float(np.median(np.linalg.norm(moved - one[middle], axis=1))) for one in (turned, logged)
    )
    return as_ros_says > _TWIST_ERROR and as_logged < 0.3 * as_ros_says
