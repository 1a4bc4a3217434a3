"""A page that follows a replay of the online estimator: each window with ghosts, while it is estimated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.core.curves import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.replay import ReplayProblem
from amhe_cli.view.ghosts import RATE, MeasuredLog, Recording, Viewing, columns_of, takes_of
from amhe_cli.view.live import Broadcast
from amhe_cli.view.page import Heading, replay_page, take_data
from amhe_cli.view.scene import scene_of

#: Frames of a second of the whole log.
_COARSE = 20.0


class TakesShown(Broadcast[tuple[int, Estimate]]):
    """Windows of a replay and their estimates.

    Args:
        problem: The replay; its windows are all of one log.
    """

    def __init__(self, problem: ReplayProblem) -> None:
        self._problem, self._count = problem, 0
        system, log = problem.system, problem.windows[0].log
        scene = scene_of(system)
        self._measured = MeasuredLog(scene, log, problem.start.z)
        self._engine = open_engine(system)  # the estimator's own is busy
        curves = [TimeCurve(p.name, "parameters", p.unit) for p in system.space.parameters]
        curves += [TimeCurve("misfit", "estimator"), TimeCurve("update time", "estimator", "ms")]
        track, gaps = self._measured.track(_COARSE), self._measured.gaps
        recording = Recording(Path(log.source).name, track, gaps, curves)
        found = Viewing(scene, tuple(columns_of(system, log)), ("before", "estimated"), (recording,), (), 0)
        heading = Heading(f"mhe-replay: {recording.name}", (f"{log.duration:.1f} s of log",))
        page, self._packed = replay_page(found, heading)
        super().__init__(page, self._message)

    def show(self, estimate: Estimate) -> None:
        """Hand over the estimate after the next window."""
        self.put((self._count, estimate))
        self._count += 1

    def _message(self, item: tuple[int, Estimate]) -> dict[str, Any]:
        number, estimate = item
        window, space = self._problem.windows[number], self._problem.system.space
        ends = zip(space.names, estimate.theta, estimate.lower, estimate.upper, strict=True)
        message: dict[str, Any] = {
            "time": window.stop * window.log.dt,
            "event": estimate.mark == "jump",
            "numbers": {name: tuple(map(float, values)) for name, *values in ends}
            | {"misfit": (estimate.misfit,), "update time": (estimate.update_ms,)},
        }
        if estimate.mark != "gap":
            z = np.stack((self._problem.start.z, space.z_of(estimate.theta)))
            (take,) = takes_of(self._measured, 0, [(window, None)], z, self._engine, RATE)
            message["take"] = take_data(take, self._packed)
        return message
