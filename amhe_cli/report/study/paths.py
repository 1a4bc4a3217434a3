"""Figures in the plane: the ways of the box, and how the task with one leg ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.floor import outline
from amhe_cli.report.figures import INK, MUTED, Grid
from amhe_cli.report.study.drawing import PATH, TRUTH, StudyTask, color_of, legend, line, room
from amhe_cli.study.summary import Group, Groups

#: Straight tasks show at least this much beside their path [m].
_BESIDE = 0.12
#: Length and width of the trunk as drawn [m]: the distances between the hips, and a margin.
_TRUNK = np.array([0.436, 0.154])


def path_figure(groups: Groups, tasks: Sequence[StudyTask]) -> Figure:
    """The paths of the box, seed by seed; straight ones with their sides stretched."""
    grid = Grid(len(tasks), 3, height=3.3)
    figure = room(grid)
    for index, task in enumerate(tasks):
        axes = grid.axes(figure, index)
        path = task.floor.path
        axes.plot(path[:, 0], path[:, 1], "--", color=PATH, linewidth=1.2)
        axes.plot(*path[-1], "x", color=TRUTH, markersize=7, markeredgewidth=1.8)
        for group in groups.of(task.name):
            for result in group.results:
                trace = result.trace
                axes.plot(
                    trace["box_x"], trace["box_y"], color=color_of(group.mode), linewidth=0.9, alpha=0.65
                )
        if task.floor.curved:
            axes.set_aspect("equal", adjustable="datalim")
        else:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -_BESIDE), max(high, _BESIDE))
        axes.set_title(f"{task.name.upper()}: {task.title}, y [m]")
        axes.set_xlabel("x [m]")
    legend(figure, groups.modes_of(task.name for task in tasks), line("path", PATH))
    return figure


def one_leg_figure(groups: Groups, task: StudyTask) -> Figure:
    """Robot and box from above at the end, one panel a mode."""
    found = groups.of(task.name)
    grid = Grid(len(found), min(4, max(3, len(found))), height=3.4)
    figure = grid.figure()
    for index, group in enumerate(found):
        axes = grid.axes(figure, index)
        color = color_of(group.mode)
        first, size = group.results[0].trace, _box_size(group, task)
        _outline(axes, first, 0, _TRUNK, "trunk", color=MUTED, linewidth=0.9, linestyle=":")
        _outline(axes, first, 0, size, "box", color=MUTED, linewidth=0.9, linestyle=":")
        goal = outline(task.floor.path[-1], task.floor.goal_yaw, (size[0], size[1]))
        axes.plot(*goal, color=TRUTH, linewidth=1.6, linestyle="--")
        for number, result in enumerate(group.results):
            faint = {"alpha": 0.9 if number == 0 else 0.35, "linewidth": 1.6 if number == 0 else 0.8}
            _outline(axes, result.trace, -1, size, "box", color=color, **faint)
        _outline(axes, first, -1, _TRUNK, "trunk", color=INK, linewidth=1.4)
        axes.plot(first["foot_x"], first["foot_y"], color=INK, linewidth=0.8)
        axes.plot(first["foot_x"][-1], first["foot_y"][-1], "o", color=INK, markersize=4)
        axes.set_aspect("equal", adjustable="datalim")
        error = group.spread("goal_error_m")
        axes.set_title(f"{group.mode}, y [m]; e_g {error.mean:.3f} m")
        axes.set_xlabel("x [m]")
    return figure


def _box_size(group: Group, task: StudyTask) -> FloatArray:
    """Depth and width of the box [m], shape (2,): those of the task, or those of the setting."""
    return np.array(dict(group.setting).get("boxes.box", task.floor.footprint)[:2])


def _outline(
    axes: Axes, trace: Mapping[str, FloatArray], row: int, size: FloatArray, what: str, **style: Any
) -> None:
    """Draw the outline of a body in one row of a trace."""
    x, y, yaw = (trace[f"{what}_{name}"][row] for name in ("x", "y", "yaw"))
    axes.plot(*outline(np.array([x, y]), yaw, (size[0], size[1])), **style)
