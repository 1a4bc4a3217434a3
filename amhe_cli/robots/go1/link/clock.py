"""Time: on our own clock, and on that of a machine whose clock we see only in what it sends."""

from __future__ import annotations

import math
import time

#: The robot's clock begins again after so many ticks.
_TICKS = 2**32


def ticks_ahead(tick: int, before: int) -> int:
    """Ticks from one state to another, past the clock's own end; negative: the first is the older one."""
    return (tick - before + _TICKS // 2) % _TICKS - _TICKS // 2


class Clock:
    """A clock in seconds that is the same for every process of this computer, and is never set.

    Args:
        slow: How many seconds of the wall clock one of ours takes. An emulated robot may run slowed down;
            then every process that talks to it uses the same slower clock.
    """

    def __init__(self, slow: float = 1.0) -> None:
        self.slow = slow

    def now(self) -> float:
        """Present time [s]."""
        return time.monotonic() / self.slow

    def sleep_until(self, then: float) -> None:
        """Sleep until a time on this clock [s]; not at all if it has passed."""
        time.sleep(max(0.0, (then - self.now()) * self.slow))


class ClockMap:
    """Offset of another machine's clock from ours.

    A message cannot arrive before it was sent, and some are hardly delayed: the least difference of arrival
    and stamp is the offset. It is estimated continually, since clocks drift.

    Args:
        window: A delay is forgotten after one or two of these [s].
    """

    def __init__(self, window: float = 2.0) -> None:
        self._window = window
        self._until = -math.inf
        self._last = self._least = math.inf

    def ahead(self, stamp: float, arrival: float) -> float:
        """How far a stamp is ahead of those before it [s]; 0 before the first, negative: it came late."""
        least = min(self._least, self._last)
        return least - (arrival - stamp) if math.isfinite(least) else 0.0

    def see(self, stamp: float, arrival: float) -> float:
        """Take in a message; its stamp on our clock [s], late by the shortest delay of a message so far."""
        if arrival > self._until:
            self._last = self._least if arrival < self._until + self._window else math.inf
            self._least, self._until = math.inf, arrival + self._window
        self._least = min(self._least, arrival - stamp)
        return stamp + min(self._least, self._last)
