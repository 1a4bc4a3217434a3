"""What estimates say of the newest part of their windows: the measured topics, as they should have been."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.log import Window
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.online.horizon import usable
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.matching.windows import starts_of
from amhe_cli.system.system import System

#: Windows that are rolled out at once: enough for every thread, and no more memory than that takes.
_AT_ONCE = 16


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Part of a rollout, on the clock of the log that it started from.

    Args:
        rows: Rows of that log, shape (m,).
        values: Series of the log, such as 'box.position' -> its prediction, shape (m, k).
    """

    rows: IntArray
    values: Mapping[str, FloatArray]


def predictions(done: Replay, engine: Engine) -> list[Prediction | None]:
    """Roll each window out with the estimate that it led to, and keep the part that no window before held.

    Returns:
        One for each window; None where it lacks a signal to start from, or the rollout diverged.
    """
    theta, system = done.column("theta"), done.system
    newest = round(system.settings.mhe.update_period / done.windows[0].log.dt)
    found: list[Prediction | None] = [None] * len(done.windows)
    known = [i for i, window in enumerate(done.windows) if usable(system, window)]
    for start in range(0, len(known), _AT_ONCE):
        some = known[start : start + _AT_ONCE]
        ends = _ends(system, engine, [done.windows[i] for i in some], theta[some], newest)
        for i, end in zip(some, ends, strict=True):
            found[i] = end
    return found


def _ends(
    system: System, engine: Engine, windows: Sequence[Window], theta: FloatArray, newest: int
) -> list[Prediction | None]:
    """Of windows of one length, each with its own theta (windows, d); the last `newest` rows."""
    smoothing = system.settings.cost.smoothing
    starts = [starts_of(system, [window], smoothing) for window in windows]
    delays = system.edits.delays(theta) / system.model.opt.timestep
    length = windows[0].length
    rollouts = engine.rollout(
        theta,
        np.concatenate([start.qpos for start in starts]),
        np.concatenate([start.qvel for start in starts]),
        np.concatenate([start.inputs_under(delays[i : i + 1]) for i, start in enumerate(starts)]),
        np.full(len(windows), length),
    )
    end = slice(max(length - newest, 0), length)
    return [
        Prediction(
            # row k of a rollout is the instant k + 1
            window.start + 1 + np.arange(end.start, end.stop),
            {c.key: getattr(rollouts, c.source)[i][end][:, list(c.columns)] for c in system.channels},
        )
        if rollouts.completed[i]
        else None
        for i, window in enumerate(windows)
    ]
