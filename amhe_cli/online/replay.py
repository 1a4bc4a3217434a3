"""The estimator over a recorded trajectory: the newest window at each update, as if it were live."""

from __future__ import annotations

from collections.abc import Iterator

from amhe_cli.core.errors import EstimationError
from amhe_cli.core.trajectory import Trajectory, Window
from amhe_cli.online.horizon import Estimate, MovingHorizon
from amhe_cli.system.system import System


def windows(system: System, trajectory: Trajectory) -> list[Window]:
    """The window before each update, one update period apart.

    Raises:
        EstimationError: The log is shorter than one window.
    """
    setting, dt = system.settings.mhe, trajectory.dt
    length, every = max(1, round(setting.window / dt)), max(1, round(setting.update_period / dt))
    if trajectory.steps < length + 2:
        raise EstimationError(
            f"{trajectory.source}: the log's {trajectory.duration:.2f} s hold no window of "
            f"{setting.window:g} s; choose a shorter one with --window, or record a longer log"
        )
    return [Window(trajectory, stop - length, length) for stop in range(length, trajectory.steps - 1, every)]


def replay(estimator: MovingHorizon, steps: list[Window]) -> Iterator[Estimate]:
    """One estimate after the other."""
    for window in steps:
        yield estimator.update(window, window.stop * window.trajectory.dt)
