"""A played-back trajectory as a log, in the messages that the system's own signals are read from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter
from amhe_cli.system.system import System

#: Quantity -> values of one message.
_Values = Mapping[str, FloatArray]
_Write = Callable[[LogWriter, Signal, int, _Values], None]


def write_log(path: Path, system: System, log: Log, metadata: Mapping[str, str]) -> None:
    """Write what `log` sampled of every signal.

    Raises:
        ConfigError: A signal is of a message type that is not written here.
    """
    played = [s for s in system.signals if all(s.key(q) in log.series for q in s.quantities)]
    writers = [(signal, _writer(signal)) for signal in played]
    with LogWriter(path, metadata) as file:
        for row in range(log.steps):
            for signal, write in writers:
                if log[signal.key(signal.quantities[0])].sampled[row]:
                    values = {q: log[signal.key(q)].values[row] for q in signal.quantities}
                    # a stamp of zero would be none
                    write(file, signal, round(1e9 * (row + 1) * log.dt), values)


def check_writable(system: System) -> None:
    """Refuse a system whose log could not be written, before any work is done.

    Raises:
        ConfigError: See `write_log`.
    """
    for signal in system.signals:
        _writer(signal)


def _writer(signal: Signal) -> _Write:
    kind = (signal.type or _usual(signal)).split("/")[-1]
    if kind not in _WRITERS or signal.fields:
        raise ConfigError(
            f"signal {signal.name!r} is of type {signal.type}; a probe can be logged as {', '.join(_WRITERS)}"
        )
    return _WRITERS[kind]


def _usual(signal: Signal) -> str:
    if signal.names:
        return "JointState"
    return "Odometry" if "orientation" in signal.quantities else "Float64MultiArray"


def _joint_state(file: LogWriter, signal: Signal, stamp: int, values: _Values) -> None:
    file.joint_state(signal.topic, stamp, signal.names, **values)


def _odometry(file: LogWriter, signal: Signal, stamp: int, values: _Values) -> None:
    pose, twist = (_NOWHERE, _UPRIGHT), (_NOWHERE, _NOWHERE)
    quantities = ("position", "orientation", "linear_velocity", "angular_velocity")
    file.odometry(
        signal.topic, stamp, *(values.get(q, d) for q, d in zip(quantities, pose + twist, strict=True))
    )


def _pose(file: LogWriter, signal: Signal, stamp: int, values: _Values) -> None:
    file.pose(signal.topic, stamp, values["position"], values["orientation"])


def _imu(file: LogWriter, signal: Signal, stamp: int, values: _Values) -> None:
    rate, force = (values.get(q, _NOWHERE) for q in ("angular_velocity", "linear_acceleration"))
    file.imu(signal.topic, stamp, values.get("orientation"), rate, force)


def _numbers(file: LogWriter, signal: Signal, stamp: int, values: _Values) -> None:
    file.numbers(signal.topic, stamp, np.concatenate(list(values.values())))


_NOWHERE = np.zeros(3)
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
_WRITERS: Mapping[str, _Write] = {
    "JointState": _joint_state,
    "Odometry": _odometry,
    "PoseStamped": _pose,
    "Imu": _imu,
    "Float64MultiArray": _numbers,
}
