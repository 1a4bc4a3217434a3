"""Figures of curves as data: plots.js draws them, at the width and in the colours of the reader's screen."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from markupsafe import Markup

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import printable
from amhe_cli.web.page import data

#: Points of one line: a clip has thousands, but a panel is only hundreds of pixels wide.
MAX_POINTS = 300

#: Colours of lines of one kind, by their names in style.css; dashed, then dotted, where they are used again.
SERIES = ("after", "before", "green", "violet", "red", "teal", "measured", "brown")
_SHAPES: Sequence[Literal["line", "dashed", "dotted"]] = ("line", "dashed", "dotted")


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Points over x; NaN where there is none.

    Args:
        x, y: Places, shape (n,) each.
        name: What the line is, for the legend and the pointer; '': nothing is said of it.
        color: Name of a colour in style.css.
        shape: How the points are drawn: joined, as steps, as dots, or as the outline of an area.
        band: Lower and upper end of an interval around each point, shape (n,) each.
        leads: The panel is as high as this line; others may leave it.
    """

    x: FloatArray
    y: FloatArray
    name: str = ""
    color: str = "after"
    shape: Literal["line", "dashed", "dotted", "step", "dots", "area"] = "line"
    band: tuple[FloatArray, FloatArray] | None = None
    leads: bool = True


@dataclass(frozen=True, slots=True)
class Mark:
    """A line at a place, or a shade between two.

    Args:
        at: The place, or its two ends.
        name: What it is, for the legend; '': nothing is said of it.
        color: Name of a colour in style.css.
        axis: The axis on which the place is.
    """

    at: float | tuple[float, float]
    name: str = ""
    color: str = "soft"
    axis: Literal["x", "y"] = "x"


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """A pair of axes.

    Args:
        title: What is shown.
        unit: Unit of y.
        x: Name and unit of x.
        marks: Lines and shades behind the lines.
        log: The scale of y is logarithmic.
        low, high: Ends of y, where the lines do not decide them.
        equal: x and y have the same scale.
        height: Height [px].
    """

    title: str
    lines: Sequence[Curve]
    unit: str = ""
    x: str = "time [s]"
    marks: Sequence[Mark] = ()
    log: bool = False
    low: float | None = None
    high: float | None = None
    equal: bool = False
    height: int = 150


def figure(panels: Sequence[Panel], across: int = 3, wide: bool = False) -> Markup:
    """Panels side by side under one legend; '' for no panels.

    Args:
        across: How many stand side by side on a wide screen.
        wide: The first one has a row of its own.
    """
    if not panels:
        return Markup("")
    values = {"panels": [_values(one) for one in panels], "across": min(across, len(panels)), "wide": wide}
    return Markup('<figure class="plots"><script type="application/json">{}</script></figure>').format(
        data(values)
    )


def color_of(i: int) -> dict[str, Any]:
    """Colour and shape of line i: no two of the first 24 are alike."""
    return {"color": SERIES[i % len(SERIES)], "shape": _SHAPES[i // len(SERIES) % len(_SHAPES)]}


def shown_unit(unit: str) -> tuple[float, str]:
    """Factor to the unit in which people read a quantity, and that unit: degrees of angles."""
    return {"rad": (180.0 / math.pi, "°"), "rad/s": (180.0 / math.pi, "°/s"), "-": (1.0, "")}.get(
        unit, (1.0, unit)
    )


def evenly(count: int) -> IntArray:
    """At most MAX_POINTS rows of so many, equally far apart."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, MAX_POINTS)).astype(np.int64))


def thinned(x: FloatArray, *values: FloatArray) -> tuple[FloatArray, ...]:
    """Some MAX_POINTS points that keep every peak and gap of the first values: ends of short stretches."""
    first = np.where(np.isfinite(values[0]), values[0], np.nan)
    if first.size <= MAX_POINTS:
        return (x, *values)
    kept = {0, first.size - 1}
    for stretch in np.array_split(np.arange(first.size), MAX_POINTS // 2):
        part = first[stretch]
        gaps = np.flatnonzero(np.isnan(part))
        if len(gaps) < len(part):
            kept |= {int(stretch[np.nanargmin(part)]), int(stretch[np.nanargmax(part)])}
        kept |= {int(stretch[gap]) for gap in gaps[:1]}
    index = np.array(sorted(kept))
    return tuple(one[index] for one in (x, *values))


def _values(panel: Panel) -> dict[str, Any]:
    """A panel as plain values, without those that are as they usually are."""
    found = {
        name: value
        for name in ("title", "unit", "x", "log", "low", "high", "equal", "height")
        if (value := getattr(panel, name)) not in ("", None) and value is not False  # 0 is an end
    }
    for name in ("title", "x"):
        found[name] = printable(found[name])
    lines = [_line(one, panel.log) for one in panel.lines]
    return found | {"lines": lines, "marks": [_mark(one) for one in panel.marks]}


def _line(line: Curve, log: bool) -> dict[str, Any]:
    every = (line.x, line.y, *(line.band or ()))
    if line.shape == "dots":
        every = tuple(one[evenly(len(one))] for one in every)
    elif line.shape != "area":
        every = thinned(*every)
    x, y, *band = every
    found: dict[str, Any] = {"x": _numbers(x), "y": _numbers(y, log), "color": line.color}
    found |= {"name": printable(line.name)} if line.name else {}
    found |= {"shape": line.shape} if line.shape != "line" else {}
    found |= {"lower": _numbers(band[0], log), "upper": _numbers(band[1], log)} if band else {}
    return found | ({} if line.leads else {"leads": False})


def _mark(mark: Mark) -> Mapping[str, Any]:
    return {"at": mark.at, "name": mark.name, "color": mark.color, "axis": mark.axis}


def _numbers(values: FloatArray, log: bool = False) -> list[float | None]:
    """Values to a ten-thousandth of their range, which is less than can be seen; None where there is none."""
    known = values[np.isfinite(values)]
    span = float(np.ptp(known)) if known.size else 0.0
    span = float(np.abs(known).min()) if log and known.size else span or float(np.abs(known).max(initial=1.0))
    digits = 4 - math.floor(math.log10(span)) if span > 0.0 else 6
    return [round(float(value), digits) if math.isfinite(value) else None for value in values]
