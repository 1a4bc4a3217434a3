"""Files of a probe: its log, and the commands that a robot's own program can play."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Samples
from amhe_cli.core.signals import Signal
from amhe_cli.logs import LogWriter
from amhe_cli.logs.convert import Columns, joined, write_csv
from amhe_cli.logs.messages.writer import write_samples

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
    path: Path,
    signals: Sequence[Signal],
    samples: Samples,
    about: Mapping[str, str],
    start: float,
) -> None:
    """Write samples as the signals' system reads them: a table (.csv) or messages (.mcap).

    Args:
        path: The file.
        signals: The signals.
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
