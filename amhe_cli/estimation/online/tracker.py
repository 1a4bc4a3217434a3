"""Estimates while samples come in: lines 5 to 8 of Algorithm 1, for any source of samples."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.log import Samples
from amhe_cli.estimation.online.buffer import BEFORE, Buffer
from amhe_cli.estimation.online.workers import News, Trouble, Worker
from amhe_cli.system.system import System


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
