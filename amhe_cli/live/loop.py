"""Drive a run to its end, however it ends, and keep all results."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Protocol

from amhe_cli.core.errors import Ending, OperatorStopError
from amhe_cli.live.episode import Cycle, Episode
from amhe_cli.live.recorder import Recorder
from amhe_cli.logs.messages.writer import ERROR, WARN

logger = logging.getLogger(__name__)

#: Called after each cycle with it and its row of the history.
OnCycle = Callable[[Cycle, dict[str, float]], None]


class CycleHistory(Protocol):
    """Numbers of every cycle, for the report."""

    def add(self, cycle: Cycle) -> dict[str, float]:
        """Take in a cycle; returns its numbers by name."""
        ...

    @property
    def troubles(self) -> list[str]:
        """What went wrong with the online estimator, in words."""
        ...


def drive(
    episode: Episode,
    recorder: Recorder,
    history: CycleHistory,
    stopped: Callable[[], bool],
    on_cycle: OnCycle,
) -> Ending:
    """Run the episode, record every cycle, warn of the estimator's troubles, and return how it ended.

    A trouble is a warning when it first occurs; one that came again is another in the end, with its count.

    Args:
        recorder: Recorder of the run, open; the caller closes it.
        history: Takes in every cycle.
        stopped: Called after each cycle; True: stop here.
        on_cycle: Called after each cycle.
    """
    time = 0.0
    warned: list[str] = []
    try:
        for cycle in episode.cycles():
            time = cycle.time
            recorder.write(cycle)
            on_cycle(cycle, history.add(cycle))
            for trouble in history.troubles[len(warned) :]:
                logger.warning(trouble)
                warned.append(trouble)
            if stopped() and not cycle.over:
                recorder.note(time, WARN, "interrupted")
                return Ending(interrupted=True)
    except OperatorStopError as stop:
        recorder.note(time, WARN, str(stop))
        return Ending(interrupted=True)
    except Exception as error:
        recorder.note(time, ERROR, str(error))
        return Ending(error=error)
    finally:
        episode.belief.close()
        for trouble in history.troubles:
            if trouble not in warned:
                logger.warning(trouble)
    recorder.note(time, *episode.judge.verdict)
    return Ending()
