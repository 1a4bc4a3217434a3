"""Time, interruption and progress of an identification."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace

from amhe_cli.core.errors import NOTE
from amhe_cli.estimation.core.result import Iteration

logger = logging.getLogger(__name__)

#: Time of search and conclusion [s] beyond which they say how long they take.
_LONG = 60.0
#: Called after each iteration, and before each part of the conclusion, with a record and the expected total.
OnIteration = Callable[[Iteration, int], None]


class Watch:
    """Shows progress, and divides a limited time between search and conclusion.

    How long a part will take is estimated from its number of rollouts, at the pace of the rollouts before it.

    Args:
        on_iteration: What is called with progress.
        limit: Time for search and conclusion [s]; None: no limit.
        parts: Parts of the conclusion.
    """

    def __init__(self, on_iteration: OnIteration, limit: float | None, parts: int) -> None:
        self._on_iteration, self._limit = on_iteration, limit
        self._reserve, self._parts = 0, parts
        self._began = self._last = time.monotonic()
        self._pace = 0.0  # seconds of one rollout
        self._record = Iteration(0, "", math.nan, math.nan, 0, 0, ())
        self._shown = 0
        self._late, self._skipped = False, list[str]()
        self.interrupted = False

    def keep(self, rollouts: int) -> None:
        """Keep the time of so many rollouts for the conclusion; the search begins now.

        The time before it, as for the choice of clips, and that of a search before it, is no measure of its
        iterations.
        """
        self._reserve, self._last, self._pace = rollouts, time.monotonic(), 0.0

    def saw(self, iteration: Iteration, total: int) -> None:
        """Take note of an iteration of the search."""
        self.measured(iteration.rollouts)
        left = self._pace * (iteration.rollouts * (total - iteration.number) + self._reserve)
        if self._limit is None and not self._record.number and left > _LONG:
            logger.log(
                NOTE,
                f"this may take {left / 60.0:.0f} min more, at {iteration.rollouts} rollouts an "
                f"iteration; `max_time` ends it in time with the best so far",
            )
        self._record = iteration
        self._on_iteration(iteration, total)
        self._last = time.monotonic()

    def measured(self, rollouts: int) -> None:
        """Take the pace of the rollouts since the last call."""
        now = time.monotonic()
        self._pace, self._last = (now - self._last) / max(rollouts, 1), now

    @property
    def stopped(self) -> bool:
        """Whether the search has to stop with the best so far: one more iteration would take the reserve."""
        if not (self._late or self.affords(self._record.rollouts + self._reserve)):
            self._late = True
            logger.warning(
                f"`max_time` of {self._limit:g} s stopped the search before it had settled: the rest is for "
                f"the conclusion"
            )
        return self.interrupted or self._late

    @property
    def cut_short(self) -> bool:
        """Whether the search ended before it had settled."""
        return self.interrupted or self._late

    def interrupt(self) -> None:
        """Note that Ctrl-C ended a search, if its time has not."""
        self.interrupted = not self._late

    @property
    def cause(self) -> str:
        """Why a search was cut short, in words."""
        return "it was interrupted" if self.interrupted else f"it had {self._limit:g} s"

    @property
    def short(self) -> str:
        """Why the values of a search that was cut short explain too little, in words."""
        done = f"the search did not end ({self.cause}), and its values do not explain the logs yet"
        return f"{done}: give it longer"

    def affords(self, rollouts: float) -> bool:
        """Whether there is time for so many rollouts."""
        return self._limit is None or self._pace * rollouts <= self._limit - (time.monotonic() - self._began)

    def enter(self, part: str) -> None:
        """Show that a part of the conclusion begins."""
        self._shown += 1
        number = self._record.number + self._shown
        record = replace(self._record, number=number, method=part, stage="conclusion", rollouts=0, diverged=0)
        self._on_iteration(record, self._record.number + self._parts)

    def omits(self) -> None:
        """Count a part of the conclusion that these logs do not need."""
        self._shown += 1

    def allows(self, part: str, rollouts: float) -> bool:
        """Whether a part of the conclusion that can be left out has time; if so, it is shown as begun."""
        if self.interrupted:
            return False
        if self.affords(rollouts):
            self.enter(part)
            return True
        self._skipped.append(part)
        return False

    def report_skipped(self) -> None:
        """Warn of the parts for which there was no time."""
        if self._skipped:
            parts = ", ".join(self._skipped)
            logger.warning(
                f"`max_time` of {self._limit:g} s left no time for: {parts}; the result lacks them"
            )
