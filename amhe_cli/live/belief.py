"""The belief that the controller plans with: the truth, fixed parameters, or the newest estimate."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.workers import News
from amhe_cli.live.episode import Cycle


class FixedBelief:
    """The same parameters all the time, or those of a plant as they are at the moment.

    Args:
        parameters: Returns the parameters by name.
    """

    def __init__(self, parameters: Callable[[], dict[str, float]]) -> None:
        self._parameters = parameters

    def at(self, time: float) -> dict[str, float]:
        """See `BeliefSource`."""
        return self._parameters()

    def learn(self, cycle: Cycle) -> tuple[News, ...]:
        """See `BeliefSource`."""
        return ()

    def close(self) -> None:
        """See `BeliefSource`."""


class AdaptiveBelief:
    """The newest estimate; it changes only between two plans.

    Args:
        start: Parameters by name before the first estimate.
        tracker: Tracker that estimates them.
    """

    def __init__(self, start: Mapping[str, float], tracker: Tracker) -> None:
        self._belief, self._tracker = dict(start), tracker

    def at(self, time: float) -> dict[str, float]:
        """See `BeliefSource`: line 9 of Algorithm 1."""
        return dict(self._belief)

    def learn(self, cycle: Cycle) -> tuple[News, ...]:
        """See `BeliefSource`."""
        news = self._tracker.feed(cycle.samples, cycle.time, begin=not cycle.hurried)
        for estimate in news:
            if isinstance(estimate, Estimate):
                self._belief |= zip(estimate.belief.names, estimate.theta.tolist(), strict=True)
        return news

    def close(self) -> None:
        """See `BeliefSource`."""
        self._tracker.close()
