"""Time: ours, and that of a machine whose clock we only see in what it sends."""

from __future__ import annotations

import math
import time


class Clock:
    """Seconds that every process of this computer counts alike.

    Args:
        slow: How many seconds of the wall clock one of ours takes. An emulated robot may run slowed down;
            then all that talks to it counts as it does.
    """

    def __init__(self, slow: float = 1.0) -> None:
        self.slow = slow

    def now(self) -> float:
        """[s]."""
        return time.monotonic() / self.slow

    def sleep_until(self, then: float) -> None:
        """Sleep until a time of ours [s]; not at all if it has passed."""
        time.sleep(max(0.0, (then - self.now()) * self.slow))

    def from_wall(self, realtime: float) -> float:
        """Ours, of a time of the computer's calendar clock [s] a moment ago."""
        return (time.monotonic() - (time.time() - realtime)) / self.slow


class ClockMap:
    """Where another machine's clock stands on ours.

    A message cannot arrive before it was sent, and some are hardly delayed: the least difference of arrival
    and stamp is the offset. It is looked for anew all the time, since clocks drift.

    Args:
        window: A delay is forgotten after one or two of these [s].
    """

    def __init__(self, window: float = 2.0) -> None:
        self._window = window
        self._until = -math.inf
        self._last = self._least = math.inf

    def see(self, stamp: float, arrival: float) -> float:
        """Take in a message; its time on our clock [s], later than it was sent by the shortest way."""
        if arrival > self._until:
            self._last = self._least if arrival < self._until + self._window else math.inf
            self._least, self._until = math.inf, arrival + self._window
        self._least = min(self._least, arrival - stamp)
        return stamp + min(self._least, self._last)
