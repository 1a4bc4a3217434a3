"""How many rollouts there is time for before a plan is due, on this computer and at this load."""

from __future__ import annotations

import time
from collections.abc import Callable

#: Rollouts of a cycle that are made in any case: the mean, the best plan so far, the bare reference, and one
#: with noise.
LEAST = 4
#: Share of the newest measurement in what is remembered.
_NEWEST = 0.2
#: Share of the time left that the next rollouts may take: where they turn out slower there is still some.
_SHARE = 0.6


class RolloutPace:
    """Measures rollouts, and what comes after them, and divides the time that is left.

    Args:
        clock: Present time [s], on the clock of all deadlines.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self._rollout = self._rest = 0.0
        self._since = 0.0

    def next(self, done: int, wanted: int, deadline: float | None) -> int:
        """How many of the wanted rollouts to make next, after so many are done; 0: no more.

        Args:
            done, wanted: Numbers of rollouts.
            deadline: When the plan is due, by `clock`; None: there is time for all of them.
        """
        self._since = self.clock()
        if deadline is None:
            return wanted - done
        if done < LEAST:
            return min(LEAST, wanted) - done
        left = deadline - self._since - self._rest
        if left < self._rollout:
            return 0
        return int(min(wanted - done, max(1.0, _SHARE * left / max(self._rollout, 1e-6))))

    def rolled_out(self, count: int) -> None:
        """So many rollouts have been made since `next`."""
        now = self.clock()
        self._rollout = remembered(self._rollout, (now - self._since) / count)
        self._since = now

    def planned(self) -> None:
        """The plan is finished, and handed over next."""
        self._rest = remembered(self._rest, self.clock() - self._since)


def remembered(old: float, new: float) -> float:
    """A duration to expect [s]: a longer one counts at once, a shorter one bit by bit."""
    return max(new, (1.0 - _NEWEST) * old + _NEWEST * new)
