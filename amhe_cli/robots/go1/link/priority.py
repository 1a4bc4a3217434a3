"""Real-time priority for what must not be late, where the computer allows it."""

from __future__ import annotations

import contextlib
import os

#: Above all that plans and estimates: an emulated robot, and what talks to a robot.
ROBOT, SENDER = 20, 50


def take_priority(level: int) -> bool:
    """Let this process go before others; whether it is sure to, or only more likely.

    Args:
        level: Of real-time processes; the highest goes first.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
    except (OSError, AttributeError):
        with contextlib.suppress(OSError):
            os.nice(-10)
        return False
    return True
