"""Figures of a run's report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeAlias

import numpy as np
from markupsafe import Markup

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.shown import Floor, outline
from amhe_cli.report import numbers
from amhe_cli.web.plots import Curve, Mark, Panel, figure

Columns: TypeAlias = Mapping[str, FloatArray]

#: Outlines of the box along its path.
_OUTLINES = 5


def path_figure(c: Columns, floor: Floor) -> Markup:
    """From above: the path and the goal, and the tracks of box and robot, or of the foot that pushes."""
    rows = np.linspace(0, c["time"].size - 1, _OUTLINES).astype(int)
    boxes = [
        outline(np.array([c["box_x"][row], c["box_y"][row]]), float(c["box_yaw"][row]), floor.footprint)
        for row in rows
    ]
    goal = outline(floor.path[-1], floor.goal_yaw, floor.footprint)
    lines = [
        Curve(floor.path[:, 0], floor.path[:, 1], "path", "soft", "dashed"),
        *(Curve(*box, "", "amber", "area") for box in boxes),
        Curve(*goal, "goal of the box", "green", "area"),
        Curve(c["trunk_x"], c["trunk_y"], "robot", "after"),
        Curve(c["box_x"], c["box_y"], "box", "amber"),
    ]
    lines += [Curve(c["foot_x"], c["foot_y"], "front right foot", "ink")] if floor.one_leg else []
    other = [] if floor.other_floor is None else [(floor.other_floor, max(one.x.max() for one in lines))]
    marks = [Mark(ends, "other floor", "good") for ends in other] + [Mark(x, "change") for x in floor.marks]
    return figure([Panel("y [m]", lines, x="x [m]", marks=marks, equal=True)], 1)


def motion_figure(c: Columns) -> Markup:
    """Over time: speed and command, distance from the goal, distance from the path."""
    time, marks = c["time"], list(_changes(c))
    speed = [
        Curve(time, c["speed"], "robot"),
        Curve(time, c["command"], "commanded speed", "before", "dashed"),
    ]
    goal, left = (Curve(time, values, "box", "amber") for values in (c["to_goal"], 1e3 * c["left"]))
    return figure(
        [
            Panel("forward speed of the robot", speed, "m/s", marks=marks),
            Panel("box from the goal", [goal], "m", marks=marks, low=0.0),
            Panel("box left of its path", [left], "mm", marks=[*marks, Mark(0.0, axis="y")]),
        ]
    )


def belief_figure(c: Columns, units: Mapping[str, str]) -> Markup:
    """Each parameter over time, as the controller believed it and as it was."""
    panels, time = [], c["time"]
    for name in (key.removeprefix("belief/") for key in c if key.startswith("belief/")):
        believed, true = c[f"belief/{name}"], c.get(f"truth/{name}")
        band = (c[f"lower/{name}"], c[f"upper/{name}"]) if f"lower/{name}" in c else None
        lines = [] if true is None else [Curve(time, true, "true", "ink", "step")]
        lines.append(
            Curve(
                time,
                believed,
                "believed, with its 90 % interval" if band else "believed",
                "after",
                "step",
                band,
            )
        )
        highest = max(float(np.nanmax(one.y)) for one in lines)
        most = 2.0 * highest if band and np.nanmax(band[1]) > 2.0 * highest else None
        panels.append(Panel(name, lines, numbers.unit_of(units.get(name, "")), low=0.0, high=most))
    return figure(panels)


def _changes(c: Columns) -> Iterator[Mark]:
    """A dotted line wherever a true parameter changes."""
    for name, values in c.items():
        if name.startswith("truth/"):
            for row in np.flatnonzero(np.diff(values)):
                yield Mark(float(c["time"][row + 1]), "change of box or floor")
