"""Estimates while samples come in, from any source: lines 5 to 8 of Algorithm 1, with its ring buffer D."""

from __future__ import annotations

from collections import deque

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.corrections import corrected
from amhe_cli.core.log import Log, Samples, Window
from amhe_cli.core.resample import differentiated, longest_bridge, resample
from amhe_cli.core.signals import DERIVED, Series, Signal
from amhe_cli.estimation.online.workers import News, Trouble, Worker
from amhe_cli.system.system import System

#: Time before a window's start [s] that is on its grid, since first states are smoothed.
BEFORE = 0.2
#: A signal's period is the median over so many of its last stamps, so that a pause hardly changes it.
_STAMPS = 100


class Buffer:
    """The samples of the last moments, which it cuts into windows.

    Args:
        signals: What is kept; samples of other signals are passed over.
        window: Length of a window [s].
        dt: Step of the clock: the time step of the estimator's model [s].
        max_gap: Longest silence that is filled [s], as in logs: slow signals may be silent for longer, and
            commands that are sent on change last until the next.
        before: Time before a window's start that is kept [s].
    """

    def __init__(
        self, signals: tuple[Signal, ...], window: float, dt: float, max_gap: float, before: float = BEFORE
    ) -> None:
        self._signals = signals
        self._signal_of = {signal.key(q): signal for signal in signals for q in signal.quantities}
        self._names = {signal.name for signal in signals}
        self._steps, self._dt, self._max_gap, self._before = round(window / dt), dt, max_gap, before
        self._kept: dict[str, deque[tuple[FloatArray, FloatArray]]] = {}
        self._stamps: dict[str, FloatArray] = {}

    @property
    def newest(self) -> float:
        """Time of the newest sample [s]; minus infinity before the first."""
        return max((float(parts[-1][0][-1]) for parts in self._kept.values()), default=-np.inf)

    def append(self, samples: Samples) -> None:
        """Take in the next samples, each quantity in the order of time; what is too old falls out.

        The last sample before a window stays, however old it is: a command may still be in force.
        """
        for key, (times, values) in samples.items():
            if key in self._signal_of and times.size:
                self._kept.setdefault(key, deque()).append((times, values))
                before = self._stamps.get(key, times[:0])
                self._stamps[key] = np.concatenate((before, times))[-_STAMPS:]
        oldest = self.newest - self._steps * self._dt - self._before
        for parts in self._kept.values():
            while len(parts) > 1 and parts[1][0][0] <= oldest:
                parts.popleft()

    def window(self, end: float) -> Window | None:
        """The newest window, its last instant at `end` [s]; None while there are not enough samples."""
        before = round(self._before / self._dt) - 1
        grid = end + self._dt * np.arange(-self._steps - before, 1, dtype=np.float64)
        begun = {self._signal_of[key].name for key in self._kept}
        late = any(parts[0][0][0] > grid[before] + 1e-6 for parts in self._kept.values())
        if late or begun != self._names:
            return None
        series = {key: self._series(key, grid) for key in self._signal_of if self._source(key) in self._kept}
        series = corrected(series, self._signals, self._dt, begun=None)
        log = Log(self._dt, series, "the running system", round(1e9 * float(grid[0])))
        return Window(log, before, self._steps)

    def _source(self, key: str) -> str:
        """The samples that a series is made of: of a velocity that nobody gives, those of its position."""
        name, _, quantity = key.rpartition(".")
        return f"{name}.{DERIVED[quantity]}" if key not in self._kept and quantity in DERIVED else key

    def _series(self, key: str, grid: FloatArray) -> Series:
        source = self._source(key)
        times, values = (np.concatenate(arrays) for arrays in zip(*self._kept[source], strict=True))
        hold = self._signal_of[key].is_input  # also of what logs interpolate: the next message is unknown
        bridge, derived = longest_bridge(self._stamps[source], self._max_gap, hold), source != key
        if derived:
            values = differentiated(times, values, source.rpartition(".")[2], bridge)
        columns = tuple(f"{key}.{i}" for i in range(values.shape[1]))
        rotation = key.endswith(".orientation")
        return resample(
            times, values, columns, grid, bridge=bridge, hold=hold, rotation=rotation, derived=derived
        )


class Tracker:
    """Hands the newest window to the estimator whenever an update is due, and collects its estimates.

    An estimator that is late, hangs or has died costs updates and nothing else: its last estimate stays.

    Args:
        system: The system that is estimated, with window and update period in its settings.
        worker: Runs the estimator.
    """

    def __init__(self, system: System, worker: Worker) -> None:
        settings, dt = system.settings, system.model.opt.timestep
        window = settings.mhe.window
        before = window if system.match == "effort" else BEFORE  # motion is smoothed over that, too
        self._buffer = Buffer(system.signals, window, dt, settings.logs.max_gap, before)
        self._worker, self._period = worker, settings.mhe.update_period
        self._due = -np.inf
        self._late = False

    def feed(self, samples: Samples, now: float | None = None, begin: bool = True) -> tuple[News, ...]:
        """Take in the next samples; never waits for the estimator.

        Args:
            samples: Samples since the last call, of the system's signals and perhaps of others.
            now: Time at which a new window ends [s]; None: that of the newest sample.
            begin: Whether an update may begin now; False where the computer is needed for something else.

        Returns:
            Estimates that take effect now, and troubles of the estimator, since the last call.
        """
        self._buffer.append(samples)
        now = self._buffer.newest if now is None else now
        news = self._worker.poll(now)
        self._late |= any(isinstance(each, Trouble) for each in news)  # why it is late has been reported
        if now < self._due - 1e-6:
            return news
        return news + (self._begin(now) if begin else self._skip(now))

    def _skip(self, now: float) -> tuple[Trouble, ...]:
        """Let an update wait; one that waits for a whole period is left out."""
        if np.isinf(self._due):
            self._due = now
        if now < self._due + self._period - 1e-6 or not self._worker.ready:
            return ()
        self._due = now
        return (Trouble(now, "the estimator gave way to the planner: an update was left out"),)

    def _begin(self, now: float) -> tuple[Trouble, ...]:
        """Begin the update that is due; where the one before still runs, report that, once."""
        if self._late and not self._worker.ready:
            return ()
        window = self._buffer.window(now)
        if window is None:
            return ()
        if not self._worker.ready:
            self._late = True
            return (Trouble(now, "the estimator is late: the last good belief stays"),)
        self._worker.submit(window, now)
        self._due, self._late = now + self._period, False
        return ()

    def close(self) -> None:
        """Stop the estimator."""
        self._worker.close()
