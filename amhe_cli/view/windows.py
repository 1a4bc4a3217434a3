"""A page that follows an online estimator: what was measured, and what its beliefs predict of it."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.core.shown import TimeCurve
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, usable
from amhe_cli.system.system import System
from amhe_cli.view.ghosts import MeasuredLog, takes_of
from amhe_cli.view.live import STEP, Broadcast
from amhe_cli.view.page import Heading, live_page
from amhe_cli.view.scene import scene_of


class WindowsShown(Broadcast[tuple[Window, Estimate]]):
    """The newest part of each window, measured, and rolled out from the window's start by two beliefs.

    Args:
        system: The system.
        first: Values of the parameters before the first estimate, shape (d,).
        about: Where the samples come from, in words.
    """

    def __init__(self, system: System, first: FloatArray, about: str) -> None:
        curves = [TimeCurve(p.name, "parameters", p.unit) for p in system.space.parameters]
        self._scene = scene_of(system)
        self._engine, self._first = open_engine(system, threads=1), system.space.z_of(first)
        self._shown = -np.inf
        page = live_page(self._scene, ["before", "now"], curves, STEP, Heading(system.name, (about,)))
        super().__init__(page, self._frames)

    def _frames(self, item: tuple[Window, Estimate]) -> Iterator[Mapping[str, Any]]:
        """The frames of a window that came after those of the one before."""
        (window, estimate), space = item, self._scene.system.space
        rows = zip(space.names, estimate.theta, estimate.lower, estimate.upper, strict=True)
        numbers = {name: values for name, *values in rows}
        last: dict[str, Any] = {"numbers": numbers, "event": estimate.mark == "jump", "time": estimate.time}
        if not usable(self._scene.system, window):
            yield last
            return
        z = [self._first, space.z_of(estimate.theta)]
        measured = MeasuredLog(self._scene, window.log, z[-1])
        (take,) = takes_of(measured, 0, [(window, None)], z, self._engine, 1.0 / STEP)
        tracks = [
            None if track is None else track.poses.astype("<f4") for track in (take.measured, *take.ghosts)
        ]
        begun = estimate.time - window.length * window.log.dt
        times = begun + take.measured.step * np.arange(len(take.measured.poses))
        for k in np.flatnonzero(times > self._shown + 0.5 * STEP):
            self._shown = float(times[k])
            poses = [None if each is None else b64encode(each[k].tobytes()).decode() for each in tracks]
            yield {"time": self._shown, "poses": poses}
        yield last
