"""Plans from what a robot measures, which are never sent: does this computer keep the pace of the task?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from amhe_cli.control.pace import LEAST
from amhe_cli.live.episode import Cycle
from amhe_cli.robots.go1.link.target import Go1Target
from amhe_cli.robots.go1.link.wire import LinkError
from amhe_cli.robots.go1.run import Run
from amhe_cli.robots.go1.settings import settings_of

#: Cycles that are planned.
_CYCLES = 100


class _Patient:
    """A judge of a robot that lies and will not arrive."""

    verdict = (0, "")

    def watch(self, state: object) -> bool:
        """See `EpisodeJudge`."""
        return False


def rehearse(run: Run) -> dict[str, str]:
    """Plan cycles of the task from what is measured, and send none; the pace in words.

    Args:
        run: The run, at a robot that has been checked; it cannot be run any more.

    Raises:
        LinkError: Even the least number of rollouts takes longer than a control period.
    """
    assert isinstance(run.target, Go1Target)
    run.target.rehearse()
    cycles = list(islice(replace(run.episode, judge=_Patient()).cycles(), _CYCLES))
    settings = settings_of(run.system).control
    return {"pace": pace(cycles, settings.samples, settings.period * run.target.slow)}


def pace(cycles: Sequence[Cycle], samples: int, period: float) -> str:
    """The pace of some cycles in words.

    Args:
        cycles: The cycles.
        samples: Rollouts that each should have had.
        period: Control period by the wall clock [s].

    Raises:
        LinkError: See `rehearse`.
    """
    median, slow = np.quantile([cycle.plan_ms for cycle in cycles], (0.5, 0.99))
    made = [cycle.plan.step.rollouts for cycle in cycles if cycle.plan.step]
    if median > 1e3 * period:
        raise LinkError(
            f"this computer is too slow: a cycle with {min(made)} rollouts ({LEAST} are the least) takes "
            f"{median:.0f} ms, the median of {len(cycles)}, and the control period is {1e3 * period:g} ms; "
            "end other programs, or at the emulator give both commands a larger `go1.slow`"
        )
    return (
        f"{np.mean(made):.1f} of {samples} rollouts in a cycle ({min(made)} at least), {median:.0f} ms of "
        f"{1e3 * period:g} ms (99 %: {slow:.0f} ms)"
    )
