"""Figures of a run's report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.floor import Floor, outline
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

Columns: TypeAlias = Mapping[str, FloatArray]

#: Colour of the goal.
GOAL = "#15803d"
#: Colour of the box.
BOX = "#b45309"
#: Colour of 90 % intervals.
BAND = "#dbeafe"
#: Greatest height of the view from above [inch].
_HIGHEST = 6.0
#: The least width that it shows [m].
_LEAST = 1.2
#: Outlines of the box along its path.
_OUTLINES = 5

#: Terms of the running cost, in words.
_TERMS = {
    "box_speed": "speed of the box",
    "robot_speed": "speed of the robot",
    "box_left": "box beside its path",
    "robot_left": "robot beside the box",
    "yaw": "heading of the robot",
    "box_yaw": "heading of the box",
    "height": "height of the trunk",
    "tilt": "tilt of the trunk",
    "box_tilt": "tilt of the box",
    "knots": "plan off the reference",
}


def path_figure(c: Columns, floor: Floor) -> Markup:
    """From above: the path and the goal, and the tracks of box and robot, or of the foot that pushes."""
    path = floor.path
    xs = np.concatenate((path[:, 0], c["box_x"], c["trunk_x"]))
    ys = np.concatenate((path[:, 1], c["box_y"], c["trunk_y"]))
    x, y = (_span(values, 0.5 * max(floor.footprint) + 0.1) for values in (xs, ys))
    scale = min((WIDTH - 0.7) / (x[1] - x[0]), _HIGHEST / (y[1] - y[0]))
    wide, high = scale * (x[1] - x[0]), scale * (y[1] - y[0])
    with styled("path"):
        figure = Figure(figsize=(wide + 0.7, high + 0.55))
        w, h = figure.get_size_inches()
        axes = figure.add_axes((0.55 / w, 0.45 / h, wide / w, high / h))
        _floors(axes, floor, x[1])
        axes.plot(path[:, 0], path[:, 1], color=MUTED, linewidth=1.0, linestyle="--")
        _outlines(axes, c, floor)
        axes.plot(c["trunk_x"][::5], c["trunk_y"][::5], color=IDENTIFIED, linewidth=1.3)
        axes.plot(c["box_x"][::5], c["box_y"][::5], color=BOX, linewidth=1.8)
        if floor.one_leg:
            axes.plot(c["foot_x"][::2], c["foot_y"][::2], color=INK, linewidth=0.8)
        axes.set_xlim(*x)
        axes.set_ylim(*y)
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]", labelpad=1.0)
        return svg(figure)


def motion_figure(c: Columns) -> Markup:
    """Over time: speed and command, distance from the goal, distance from the path."""
    grid = Grid(3, 3, height=2.6)
    with styled("motion"):
        figure = grid.figure()
        speed, goal, left = (grid.axes(figure, index) for index in range(3))
        speed.plot(*thinned(c["time"], c["speed"]), color=IDENTIFIED, linewidth=1.0)
        speed.plot(*thinned(c["time"], c["command"]), "--", color=INITIAL, linewidth=1.3)
        speed.set_title("forward speed of the robot [m/s]")
        goal.plot(*thinned(c["time"], c["to_goal"]), color=BOX)
        goal.set_ylim(0.0, 1.05 * float(np.nanmax(c["to_goal"])) or 1.0)
        goal.set_title("box from the goal [m]")
        left.axhline(0.0, color=MUTED, linewidth=0.8, linestyle="--")
        left.plot(*thinned(c["time"], 1e3 * c["left"]), color=BOX)
        left.set_title("box left of its path [mm]")
        for axes in (speed, goal, left):
            _changes(axes, c)
            axes.set_xlabel("time [s]")
        return svg(figure)


def belief_figure(c: Columns, units: Mapping[str, str]) -> Markup:
    """Each parameter over time, as the controller believed it and as it was."""
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


def planning_figure(c: Columns, period_ms: float) -> Markup:
    """Histogram of the cycle times [ms], and the number of effective samples over time."""
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


def cost_figure(terms: Mapping[str, float]) -> Markup:
    """The terms of the cost, the largest on top."""
    ranked = sorted(terms.items(), key=lambda item: item[1])
    high = 0.27 * len(ranked) + 0.45
    with styled("cost", **{"axes.grid": False}):
        figure = Figure(figsize=(0.75 * WIDTH, high))
        axes = figure.add_axes((0.24, 0.36 / high, 0.64, 1.0 - 0.42 / high))
        values = [value for _, value in ranked]
        bars = axes.barh([_TERMS.get(name, name) for name, _ in ranked], values, color="#93b4f5", height=0.62)
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


def _floors(axes: Axes, floor: Floor, right: float) -> None:
    if floor.other_floor is not None:
        axes.axvspan(floor.other_floor, right, color="#e7efe9", linewidth=0)
    for x in floor.marks:
        axes.axvline(x, color=MUTED, linewidth=1.0, linestyle=":")


def _outlines(axes: Axes, c: Columns, floor: Floor) -> None:
    """The box at a few times, and at its goal."""
    for row in np.linspace(0, c["time"].size - 1, _OUTLINES).astype(int):
        x, y = outline(
            np.array([c["box_x"][row], c["box_y"][row]]), float(c["box_yaw"][row]), floor.footprint
        )
        axes.fill(x, y, facecolor="#fdf2e3", edgecolor="#d9a566", linewidth=0.8, alpha=0.9)
    axes.plot(*outline(floor.path[-1], floor.goal_yaw, floor.footprint), color=GOAL, linewidth=1.5)


def _changes(axes: Axes, c: Columns) -> None:
    """A dotted line wherever a true parameter changes."""
    for name, values in c.items():
        if name.startswith("truth/"):
            for row in np.flatnonzero(np.diff(values)):
                axes.axvline(c["time"][row + 1], color=MUTED, linewidth=0.8, linestyle=":")


def _band(axes: Axes, time: FloatArray, lower: FloatArray, upper: FloatArray) -> None:
    """An interval over time; every fifth cycle."""
    kept = np.flatnonzero(np.isfinite(lower))[::5]
    axes.fill_between(time[kept], lower[kept], upper[kept], step="post", color=BAND, linewidth=0)


def _steps(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The corners of a curve that seldom changes."""
    kept = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    kept = np.union1d(np.union1d(kept, np.maximum(kept - 1, 0)), [values.size - 1])
    return time[kept], values[kept]
