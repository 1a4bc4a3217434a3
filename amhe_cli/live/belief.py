"""What the controller believes while it works: the truth, something fixed, or the newest estimate."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.live.buffer import Buffer
from amhe_cli.live.episode import BeliefSource, Cycle, News
from amhe_cli.live.samples import Sampler
from amhe_cli.live.workers import Worker


class FixedBelief:
    """The same all the time, or what a function of the target tells: mode `true`.

    Args:
        tell: Gives the parameters by name.
    """

    def __init__(self, tell: Callable[[], dict[str, float]]) -> None:
        self._tell = tell

    def at(self, time: float) -> dict[str, float]:
        """See `BeliefSource`."""
        return self._tell()

    def saw(self, cycle: Cycle) -> tuple[News, ...]:
        """See `BeliefSource`."""
        return ()

    def close(self) -> None:
        """See `BeliefSource`."""


class AdaptiveBelief:
    """The moving-horizon estimator beside the controller: newest window out, newest belief in.

    Parameters change only between two plans. An estimator that is late, hangs or has died leaves the last
    good belief in force.

    Args:
        start: Parameters by name before the first estimate.
        buffer: Of states and commands.
        sampler: That fills it.
        worker: That runs the estimator.
        period: Between two updates, dt_update [s].
    """

    def __init__(
        self, start: Mapping[str, float], buffer: Buffer, sampler: Sampler, worker: Worker, period: float
    ) -> None:
        self._belief = dict(start)
        self._buffer, self._sampler, self._worker, self._period = buffer, sampler, worker, period
        self._due = 0.0
        self._late = False

    def at(self, time: float) -> dict[str, float]:
        """See `BeliefSource`: line 9 of Algorithm 1."""
        return dict(self._belief)

    def saw(self, cycle: Cycle) -> tuple[News, ...]:
        """See `BeliefSource`: lines 5 to 8 of Algorithm 1."""
        now = cycle.estimate.time
        self._buffer.append(self._sampler.take(cycle))
        news = self._worker.poll(now)
        for one in news:
            if one.estimate is not None:
                names = one.estimate.belief.names
                self._belief |= dict(zip(names, map(float, one.estimate.theta), strict=True))
        if now >= self._due - 1e-6:
            news += self._begin(now)
        return news

    def _begin(self, now: float) -> tuple[News, ...]:
        """Start the update that is due; where the one before is not done by then, say so, once."""
        if self._late and not self._worker.ready:
            return ()
        window = self._buffer.window(now)
        if window is None:
            return ()
        if not self._worker.ready:
            self._late = True
            return (News(now, None, "the estimator is late: the last good belief stays"),)
        self._worker.submit(window, now)
        self._due, self._late = now + self._period, False
        return ()

    def close(self) -> None:
        """See `BeliefSource`."""
        self._worker.close()


class SharedBelief:
    """A source whose estimates somebody else hears of too.

    Args:
        source: The source.
        tell: Called with each new estimate.
    """

    def __init__(self, source: BeliefSource, tell: Callable[[Estimate], None]) -> None:
        self._source, self._tell = source, tell

    def at(self, time: float) -> dict[str, float]:
        """See `BeliefSource`."""
        return self._source.at(time)

    def saw(self, cycle: Cycle) -> tuple[News, ...]:
        """See `BeliefSource`."""
        news = self._source.saw(cycle)
        for one in news:
            if one.estimate is not None:
                self._tell(one.estimate)
        return news

    def close(self) -> None:
        """See `BeliefSource`."""
        self._source.close()
