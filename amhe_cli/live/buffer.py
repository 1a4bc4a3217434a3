"""The ring buffer D of Algorithm 1: the newest states and commands of a live run, cut into windows."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log, Series, Window
from amhe_cli.core.resample import resample
from amhe_cli.core.signals import Signal
from amhe_cli.live.samples import CycleSamples
from amhe_cli.robots.go1.kinematics import JOINTS

#: Kept before a window's start [s]: a command lasts until the next, and first states are smoothed.
_BEFORE = 0.2
#: Quantity of a body's signal -> field of `Body`.
_FIELDS = {
    "position": "position",
    "orientation": "orientation",
    "linear_velocity": "velocity",
    "angular_velocity": "rate",
}


class Buffer:
    """Samples of the last moments.

    Args:
        signals: Of `go1_push`: 'joints', 'trunk', 'box' and 'command'.
        window: Length of a window [s].
        dt: Step of the clock: the time step of the estimator's model [s].
        bridge: Longest silence that is filled [s].
    """

    def __init__(self, signals: tuple[Signal, ...], window: float, dt: float, bridge: float) -> None:
        self._signals = {signal.name: signal for signal in signals}
        self._steps, self._dt, self._bridge = round(window / dt), dt, bridge
        self._joints, self._command = _order(self._signals["joints"]), _order(self._signals["command"])
        self._kept: dict[str, deque[tuple[FloatArray, FloatArray]]] = {}

    def append(self, samples: CycleSamples) -> None:
        """Take in what one cycle brought; what is too old falls out."""
        newest = 0.0
        for key, times, values in self._quantities(samples):
            if times.size:
                self._kept.setdefault(key, deque()).append((times, values))
                newest = max(newest, float(times[-1]))
        oldest = newest - self._steps * self._dt - _BEFORE
        for chunks in self._kept.values():
            while len(chunks) > 1 and chunks[1][0][0] <= oldest:
                chunks.popleft()

    def window(self, end: float) -> Window | None:
        """The newest window, its last instant at `end` [s]; None while there is not enough."""
        before = round(_BEFORE / self._dt) - 1
        grid = end + self._dt * np.arange(-self._steps - before, 1, dtype=np.float64)
        start = grid[before]
        if not self._kept or any(chunks[0][0][0] > start + 1e-6 for chunks in self._kept.values()):
            return None
        series = {key: self._series(key, grid) for key in self._kept}
        log = Log(self._dt, series, "the running system", round(1e9 * float(grid[0])))
        return Window(log, before, self._steps)

    def _series(self, key: str, grid: FloatArray) -> Series:
        times = np.concatenate([t for t, _ in self._kept[key]])
        values = np.concatenate([v for _, v in self._kept[key]])
        name, quantity = key.split(".")
        columns = tuple(f"{key}.{i}" for i in range(values.shape[1]))
        return resample(
            times, values, columns, grid,
            bridge=self._bridge, hold=self._signals[name].is_input, rotation=quantity == "orientation",
        )  # fmt: skip

    def _quantities(self, samples: CycleSamples) -> Iterator[tuple[str, FloatArray, FloatArray]]:
        """Every series of the signals: key, times (n,), values (n, k) in the signal's own column order."""
        joints, command = self._signals["joints"], self._signals["command"]
        yield joints.key("position"), samples.sensor_times, samples.joints[:, self._joints]
        yield joints.key("velocity"), samples.sensor_times, samples.joint_rates[:, self._joints]
        for name, body in samples.bodies.items():
            for quantity in self._signals[name].quantities:
                yield self._signals[name].key(quantity), samples.pose_times, getattr(body, _FIELDS[quantity])
        yield command.key(command.quantities[0]), samples.command_times, samples.commands[:, self._command]


def _order(signal: Signal) -> list[int]:
    """Columns of the robot's joints in the order of a signal's own names."""
    return [JOINTS.index(name) for name in signal.names]
