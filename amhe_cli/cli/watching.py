"""`--view`: a page that shows what a command does, while it does it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import TYPE_CHECKING

from amhe_cli.cli.command import flag
from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.core.arrays import FloatArray
    from amhe_cli.core.log import Window
    from amhe_cli.estimation.online.horizon import Estimate
    from amhe_cli.live.episode import Cycle
    from amhe_cli.robots.go1.run import Run
    from amhe_cli.robots.go1.tasks import Task
    from amhe_cli.system.system import System
    from amhe_cli.view.scene import Geom
    from amhe_cli.view.server import PageServer

#: Most sampled plans that are shown.
_TRACES = 20

watched = flag("--view", "Serve a page to this computer that shows it live (docs/view.md).")


@contextmanager
def watching_run(session: Session, run: Run) -> Iterator[Callable[[Cycle, dict[str, float]], None]]:
    """Show the cycles of a run: its state, the estimated one as a ghost, belief and cost."""
    import numpy as np

    from amhe_cli.core.shown import TimeCurve
    from amhe_cli.robots.go1.model import layout
    from amhe_cli.view.live import Happening, StatesShown
    from amhe_cli.view.page import Heading
    from amhe_cli.view.scene import scene_of

    system, at = run.system, layout(run.system.model)
    names = system.space.names
    curves = [TimeCurve(p.name, "parameters", p.unit) for p in system.space.parameters]
    curves += [
        TimeCurve("speed", "run", "m/s"),
        TimeCurve("cost", "run"),
        TimeCurve("cycle time", "run", "ms"),
    ]
    heading = Heading(f"{run.task.name} {run.options.mode}", (run.task.title,))
    page = StatesShown(scene_of(system, floor_of(run.task)), ["estimated"], curves, heading)

    def show(cycle: Cycle, row: dict[str, float]) -> None:
        if not page.due(cycle.time):
            return
        numbers = {
            name: tuple(row[end + name] for end in ("belief/", "lower/", "upper/") if end + name in row)
            for name in names
        }
        step = cycle.plan.step
        numbers |= {"speed": (row["speed"],), "cycle time": (cycle.plan_ms,)}
        numbers |= {"cost": (step.best,)} if step else {}
        true = cycle.truth
        states = [at.coordinates(state)[0] for state in (true or cycle.estimate, cycle.estimate)]
        jumped = any(getattr(news, "mark", "") == "jump" for news in cycle.news)
        forces = run.plant.contacts if run.plant else None
        sampled = cycle.plan.candidates
        traces = (
            None
            if sampled is None
            else np.concatenate([sampled[:_TRACES, ::2, of][..., :3] for of in (at.trunk, at.box)])
        )
        shown = [states[0], states[1] if true else None]
        page.put(Happening(cycle.time, shown, numbers, jumped, forces, traces))

    with page:
        announce(session, page.server)
        yield show


@contextmanager
def watching_windows(
    session: Session, system: System, start: FloatArray, about: str
) -> Iterator[Callable[[Window, Estimate], None]]:
    """Show windows of an online estimator, under its belief and the first one.

    Args:
        start: Values of the first belief, shape (d,).
        about: Where the samples come from, in words.
    """
    from amhe_cli.view.live import WindowsShown

    with WindowsShown(system, start, about) as page:
        announce(session, page.server)
        yield lambda window, estimate: page.put((window, estimate))


def floor_of(task: Task) -> list[Geom]:
    """Path and goal of a task, as plates on the floor."""
    import numpy as np

    from amhe_cli.view.scene import plate

    path, (depth, width) = task.floor.path, task.floor.footprint
    blue, green = (0.15, 0.39, 0.92, 1.0), (0.08, 0.55, 0.25, 1.0)
    plates = []
    for start, end in pairwise(path):
        along = end - start
        half = (0.5 * float(np.hypot(*along)), 0.012)
        plates.append(plate(0.5 * (start + end), half, float(np.arctan2(along[1], along[0])), blue))
    yaw = task.floor.goal_yaw
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    for side in (-0.5, 0.5):
        plates.append(plate(path[-1] + side * depth * ahead, (0.012, 0.5 * width), yaw, green))
        plates.append(plate(path[-1] + side * width * left, (0.5 * depth, 0.012), yaw, green))
    return plates


def announce(session: Session, server: PageServer) -> None:
    """Say where the page is, and open it in a browser if this is a terminal on a desktop."""
    import logging

    if not server.private:
        logging.getLogger("amhe_cli").warning(
            "whoever reaches %s sees the log, without a password; without `host` only this computer does",
            server.address,
        )
    session.say("", f"the page is at {server.address}; Ctrl-C ends")
    if sys.stdin.isatty() and sys.stderr.isatty() and _desktop():
        import webbrowser

        webbrowser.open(server.address)


def _desktop() -> bool:
    """Whether a window would appear before the user: not over SSH, and not as text in this terminal."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform == "darwin" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
