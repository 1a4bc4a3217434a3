"""Samples of signals as ROS messages: the inverse of what `decode` reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.samples import Samples
from amhe_cli.core.signals import Signal
from amhe_cli.logs.messages.writer import LogWriter


def write_samples(
    log: LogWriter, signals: Sequence[Signal], samples: Samples, stamp: Callable[[float], int]
) -> None:
    """Write one message for each time at which a signal was sampled, in the order of time.

    Args:
        log: The log to write to, open.
        signals: Signals to write, where there are samples of them; see `message_type`.
        samples: Samples of these signals, and perhaps of others.
        stamp: Turns a time [s] into a stamp [ns].

    Raises:
        ConfigError: A signal is of a message type that is not written here.
    """
    for time, signal, values in sorted(_messages(signals, samples), key=lambda message: message[0]):
        _WRITERS[message_type(signal)](log, signal, stamp(time), values)


def message_type(signal: Signal) -> str:
    """Name of the message that carries a signal, without its package: its own type, or the usual one.

    Raises:
        ConfigError: A signal is of a message type that is not written here.
    """
    name = (signal.type or _usual(signal)).split("/")[-1]
    if name not in _WRITERS or signal.fields:
        raise ConfigError(
            f"signal {signal.name!r} is of type {signal.type}; what can be written: {', '.join(_WRITERS)}"
        )
    return name


def _usual(signal: Signal) -> str:
    """The message that carries the quantities of a signal."""
    has = set(signal.quantities)
    if "value" in has:
        return "Float64MultiArray"
    if signal.names:
        return "JointState"
    if has & {"force", "torque"}:
        return "WrenchStamped"
    if "linear_acceleration" in has:
        return "Imu"
    return "PoseStamped" if has == {"position"} else "Odometry"


def _messages(
    signals: Sequence[Signal], samples: Samples
) -> Iterator[tuple[float, Signal, dict[str, FloatArray]]]:
    """Time [s], signal and its values, one signal after the other."""
    for signal in signals:
        known = {q: samples[signal.key(q)] for q in signal.quantities if signal.key(q) in samples}
        times = next(iter(known.values()))[0].tolist() if known else []
        for row, time in enumerate(times):
            yield time, signal, {quantity: values[row] for quantity, (_, values) in known.items()}


_ZERO, _UPRIGHT = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
_WRITERS: Mapping[str, Callable[[LogWriter, Signal, int, Mapping[str, FloatArray]], None]] = {
    "JointState": lambda log, signal, stamp_ns, values: log.joint_state(
        signal.topic, stamp_ns, signal.names, **values
    ),
    "Odometry": lambda log, signal, stamp_ns, values: log.odometry(
        signal.topic, stamp_ns, **{"position": _ZERO, "orientation": _UPRIGHT, **values},
        child_frame=signal.child_frame or signal.name,
    ),
    "PoseStamped": lambda log, signal, stamp_ns, values: log.pose(
        signal.topic, stamp_ns, values.get("position", _ZERO), values.get("orientation", np.zeros(4))
    ),
    "WrenchStamped": lambda log, signal, stamp_ns, values: log.wrench(
        signal.topic, stamp_ns, values.get("force", _ZERO), values.get("torque", _ZERO)
    ),
    "Imu": lambda log, signal, stamp_ns, values: log.imu(
        signal.topic, stamp_ns, values.get("orientation"), values.get("angular_velocity", _ZERO),
        values.get("linear_acceleration", _ZERO), frame=signal.child_frame or "imu",
    ),
    "Float64MultiArray": lambda log, signal, stamp_ns, values: log.numbers(
        signal.topic, stamp_ns, np.concatenate(list(values.values()))
    ),
}  # fmt: skip
