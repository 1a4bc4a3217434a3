"""What each primitive tells, from the log of a rehearsal in simulation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.trajectory import Trajectory, Window
from amhe_cli.engine.rollout import RolloutEngine
from amhe_cli.probing.information import information_at
from amhe_cli.probing.primitives import STEADY, Primitive, Score
from amhe_cli.system.system import System

#: Before anything is asked of a rehearsal the robot gets going: a plain push is not all starting.
_LEAD = (STEADY,)
#: Parts that are not asked: the approach and the lead.
_SKIPPED = 1 + len(_LEAD)
#: Length of the windows, about that of the clips of `amhe identify` [s].
WINDOW = 0.5


def rehearsal_of(library: Sequence[Primitive]) -> tuple[Primitive, ...]:
    """The sequence to rehearse: each primitive once."""
    return (*_LEAD, *library)


def rehearsed_information(
    system: System,
    library: Sequence[Primitive],
    log: Trajectory,
    engine: RolloutEngine,
    z: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Information of each of n primitives on z, shape (n, d, d); zero for those that did not end.

    Args:
        system: Its space says what z is.
        library: The primitives.
        log: Of their `rehearsal_of`.
        engine: For the rollouts of the system's model.
        z: The rehearsal's true parameters, shape (d,).
        rng: Draws the samples.
    """
    score = Score(rehearsal_of(library))
    parts = list(zip(score.parts, score.starts, strict=True))[_SKIPPED:]
    cut = [windows_of(log, start, part.seconds) for part, start in parts]
    whose = np.repeat(np.arange(len(cut)), [len(windows) for windows in cut])
    found = np.zeros((len(cut), z.size, z.size))
    if whose.size:
        windows = [window for windows in cut for window in windows]
        np.add.at(found, whose, information_at(system, windows, engine, z, rng).matrix)
    return found


def windows_of(log: Trajectory, start: float, seconds: float) -> Sequence[Window]:
    """Windows side by side over a part of a run [s, by its own clock]; none where the log ends before."""
    count = max(1, round(seconds / WINDOW))
    length = round(seconds / count / log.dt)
    first = max(round((start - 1e-9 * log.start_ns) / log.dt), 0)
    if first + count * length > log.steps + 1:
        return []
    starts = [first + i * length for i in range(count)]
    return [Window(log, at, min(length, log.steps - 1 - at)) for at in starts]
