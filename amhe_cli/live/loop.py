"""Drive a run to its end, whatever that is: all that it brought is kept."""

from __future__ import annotations

import logging
from collections.abc import Callable

from amhe_cli.core.errors import Ending
from amhe_cli.live.episode import Cycle, Episode
from amhe_cli.live.recorder import Recorder
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.robots.go1.history import History

logger = logging.getLogger(__name__)

#: Called after each cycle with it and its row of the history.
OnCycle = Callable[[Cycle, dict[str, float]], None]


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
                recorder.say(time, WARN, "interrupted")
                return Ending(interrupted=True)
    except Exception as error:
        recorder.say(time, ERROR, str(error))
        return Ending(error=error)
    finally:
        episode.belief.close()
        for trouble in history.told:
            logger.warning(trouble)
    recorder.say(time, *_verdict(episode))
    return Ending()


def _verdict(episode: Episode) -> tuple[int, str]:
    if episode.judge.fell:
        return ERROR, "the robot fell"
    if episode.judge.arrived:
        return OK, "the box has arrived"
    return WARN, "the time is up"
