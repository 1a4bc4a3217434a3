"""Figures of a run's report."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amhe_cli.core.arrays import FloatArray
from amhe_cli.report.figures import (
    IDENTIFIED,
    INITIAL,
    INK,
    MEASURED,
    MUTED,
    WIDTH,
    Grid,
    styled,
    svg,
    thinned,
)
from amhe_cli.report.run_words import TERMS
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.tasks import Task

GOAL, BOX = "#15803d", "#b45309"
#: The view from above is no higher than this [inch], and shows no less than this [m].
_HIGHEST, _LEAST = 6.0, 1.2
#: Outlines of the box along its way.
_OUTLINES = 5


def path_figure(history: History, task: Task) -> str:
    """From above: the path, the goal, the ways of box and robot, and of the foot that pushes."""
    c = history.columns()
    path = task.path.points(np.linspace(0.0, task.path.length, 181))
    xs = np.concatenate((path[:, 0], c["box_x"], c["trunk_x"]))
    ys = np.concatenate((path[:, 1], c["box_y"], c["trunk_y"]))
    x, y = (_span(values, 0.5 * max(task.box.size[:2]) + 0.1) for values in (xs, ys))
    scale = min((WIDTH - 0.7) / (x[1] - x[0]), _HIGHEST / (y[1] - y[0]))
    wide, high = scale * (x[1] - x[0]), scale * (y[1] - y[0])
    with styled("path"):
        figure = Figure(figsize=(wide + 0.7, high + 0.55))
        w, h = figure.get_size_inches()
        axes = figure.add_axes((0.55 / w, 0.45 / h, wide / w, high / h))
        _floors(axes, task, x[1])
        axes.plot(path[:, 0], path[:, 1], color=MUTED, linewidth=1.0, linestyle="--")
        _outlines(axes, c, task)
        axes.plot(c["trunk_x"][::5], c["trunk_y"][::5], color=IDENTIFIED, linewidth=1.3)
        axes.plot(c["box_x"][::5], c["box_y"][::5], color=BOX, linewidth=1.8)
        if task.one_leg:
            axes.plot(c["foot_x"][::2], c["foot_y"][::2], color=INK, linewidth=0.8)
        axes.set_xlim(*x)
        axes.set_ylim(*y)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]", labelpad=1.0)
        return svg(figure)


def motion_figure(history: History, task: Task) -> str:
    """Over time: speed against command, the way to the goal, the distance from the path."""
    c = history.columns()
    grid = Grid(3, 3, height=2.6)
    with styled("motion"):
        figure = grid.figure()
        speed, goal, left = (grid.axes(figure, index) for index in range(3))
        speed.plot(*thinned(c["time"], c["speed"]), color=IDENTIFIED, linewidth=1.0)
        speed.plot(*thinned(c["time"], c["command"]), "--", color=INITIAL, linewidth=1.3)
        speed.set_title("forward speed of the robot [m/s]")
        goal.plot(*thinned(c["time"], c["to_goal"]), color=BOX)
        goal.set_ylim(bottom=0.0)
        goal.set_title("box from the goal [m]")
        left.axhline(0.0, color=MUTED, linewidth=0.8, linestyle="--")
        left.plot(*thinned(c["time"], 1e3 * c["left"]), color=BOX)
        left.set_title("box left of its path [mm]")
        for axes in (speed, goal, left):
            _changes(axes, c)
            axes.set_xlabel("time [s]")
        return svg(figure)


def belief_figure(history: History, units: Mapping[str, str]) -> str:
    """What was believed, against what was true."""
    c = history.columns()
    names = [name.removeprefix("belief/") for name in c if name.startswith("belief/")]
    grid = Grid(len(names), 3, height=2.3)
    with styled("belief"):
        figure = grid.figure()
        for index, name in enumerate(names):
            axes = grid.axes(figure, index)
            believed, true = c[f"belief/{name}"], c.get(f"truth/{name}")
            if true is not None:
                axes.plot(*_steps(c["time"], true), color=INK, linewidth=1.3)
            shown = [v for v in (believed, true) if v is not None]
            if (lower := c.get(f"lower/{name}")) is not None:
                upper = c[f"upper/{name}"]
                _band(axes, c["time"], lower, upper)
                shown.append(np.minimum(upper, 2.0 * np.nanmax(shown)))
            axes.plot(*_steps(c["time"], believed), "--", color=IDENTIFIED, linewidth=1.8)
            highest = max(float(np.nanmax(v)) for v in shown)
            axes.set_ylim(0.0, 1.25 * highest or 1.0)
            axes.set_xlabel("time [s]")
            unit = units.get(name, "-")
            axes.set_title(name if unit == "-" else f"{name} [{unit}]")
        return svg(figure)


def planning_figure(history: History, period_ms: float) -> str:
    """How long cycles took, and how many samples counted."""
    c = history.columns()
    grid = Grid(2, 2, height=2.5)
    with styled("planning"):
        figure = grid.figure()
        times, samples = (grid.axes(figure, index) for index in range(2))
        top = max(float(np.quantile(c["plan_ms"], 0.995)), 1.2 * period_ms)
        times.hist(np.minimum(c["plan_ms"], top), bins=40, range=(0.0, top), color="#93b4f5")
        times.axvline(period_ms, color=INITIAL, linewidth=1.2, linestyle="--")
        times.set_xlabel("time of a cycle [ms]")
        times.set_title("cycles; dashed: the control period")
        samples.plot(*thinned(c["time"], c["effective_samples"]), color=MEASURED, linewidth=0.8)
        samples.set_ylim(bottom=0.0)
        samples.set_xlabel("time [s]")
        samples.set_title("effective samples")
        return svg(figure)


def cost_figure(terms: Mapping[str, float]) -> str:
    """The cost by its terms, dearest on top."""
    ranked = sorted(terms.items(), key=lambda item: item[1])
    high = 0.27 * len(ranked) + 0.45
    with styled("cost", **{"axes.grid": False}):
        figure = Figure(figsize=(0.75 * WIDTH, high))
        axes = figure.add_axes((0.24, 0.36 / high, 0.64, 1.0 - 0.42 / high))
        values = [value for _, value in ranked]
        bars = axes.barh([TERMS.get(name, name) for name, _ in ranked], values, color="#93b4f5", height=0.62)
        total = sum(values) or 1.0
        axes.bar_label(
            bars, [f"{v:,.0f} ({v / total:.0%})" for v in values], padding=4, color=MUTED, fontsize=8
        )
        axes.tick_params(axis="y", labelcolor=INK)
        return svg(figure)


def _span(values: FloatArray, margin: float) -> tuple[float, float]:
    low, high = float(values.min()) - margin, float(values.max()) + margin
    lacking = max(0.0, _LEAST - (high - low))
    return low - 0.5 * lacking, high + 0.5 * lacking


def _floors(axes: Axes, task: Task, right: float) -> None:
    for change in task.changes:
        if change.beyond_x is None:
            continue
        if change.floor_friction is not None:
            axes.axvspan(change.beyond_x, right, color="#e7efe9", linewidth=0)
        else:
            axes.axvline(change.beyond_x, color=MUTED, linewidth=1.0, linestyle=":")


def _outlines(axes: Axes, c: Mapping[str, FloatArray], task: Task) -> None:
    """The box now and then, and where it is to stand."""
    for row in np.linspace(0, c["time"].size - 1, _OUTLINES).astype(int):
        place = np.array([c["box_x"][row], c["box_y"][row]])
        x, y = _rectangle(place, float(c["box_yaw"][row]), task)
        axes.fill(x, y, facecolor="#fdf2e3", edgecolor="#d9a566", linewidth=0.8, alpha=0.9)
    turn = task.box.yaw + task.path.curvature * task.path.length
    axes.plot(*_rectangle(task.path.goal, turn, task), color=GOAL, linewidth=1.5)


def _rectangle(place: FloatArray, yaw: float, task: Task) -> tuple[FloatArray, FloatArray]:
    depth, width = 0.5 * task.box.size[0], 0.5 * task.box.size[1]
    ahead, left = depth * np.array([1, 1, -1, -1, 1]), width * np.array([1, -1, -1, 1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    return place[0] + c * ahead - s * left, place[1] + s * ahead + c * left


def _changes(axes: Axes, c: Mapping[str, FloatArray]) -> None:
    """Where the truth changes."""
    for name, values in c.items():
        if name.startswith("truth/"):
            for row in np.flatnonzero(np.diff(values)):
                axes.axvline(c["time"][row + 1], color=MUTED, linewidth=0.8, linestyle=":")


def _band(axes: Axes, time: FloatArray, lower: FloatArray, upper: FloatArray) -> None:
    """An interval over time, thinned."""
    kept = np.flatnonzero(np.isfinite(lower))[::5]
    axes.fill_between(time[kept], lower[kept], upper[kept], step="post", color="#dbeafe", linewidth=0)


def _steps(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Only the corners of what seldom changes."""
    kept = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    kept = np.union1d(np.union1d(kept, np.maximum(kept - 1, 0)), [values.size - 1])
    return time[kept], values[kept]
