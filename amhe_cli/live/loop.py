"""Drive a run to its end, whatever that is: all that it brought is kept."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from amhe_cli.live import messages
from amhe_cli.live.episode import Cycle, Episode
from amhe_cli.live.recorder import Recorder
from amhe_cli.robots.go1.history import History

logger = logging.getLogger(__name__)

#: Called after each cycle with it and its row of the history.
OnCycle = Callable[[Cycle, dict[str, float]], None]


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run ended.

    Args:
        interrupted: Somebody stopped it.
        error: What broke it; None: nothing did.
    """

    interrupted: bool = False
    error: Exception | None = None


def drive(
    episode: Episode, recorder: Recorder, history: History, stopped: Callable[[], bool], on_cycle: OnCycle
) -> Ending:
    """Run the episode, record every cycle, and say how it ended; what the estimator failed at is warned of.

    Args:
        episode: To run.
        recorder: Open; the caller closes it.
        history: Of the run.
        stopped: Asked after each cycle: whether to stop here.
        on_cycle: Who else wants to see the cycles.
    """
    time = 0.0
    try:
        for cycle in episode.cycles():
            time = cycle.estimate.time
            recorder.write(cycle)
            on_cycle(cycle, history.add(cycle))
            if stopped() and not cycle.over:
                recorder.say(time, messages.WARN, "interrupted")
                return Ending(interrupted=True)
    except Exception as error:
        recorder.say(time, messages.ERROR, str(error))
        return Ending(error=error)
    finally:
        episode.belief.close()
        for trouble in history.told:
            logger.warning(trouble)
    recorder.say(time, *_verdict(episode))
    return Ending()


def _verdict(episode: Episode) -> tuple[int, str]:
    if episode.judge.fell:
        return messages.ERROR, "the robot fell"
    if episode.judge.arrived:
        return messages.OK, "the box has arrived"
    return messages.WARN, "the time is up"
