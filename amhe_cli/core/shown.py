"""What people are shown: a value in a notebook, curves beside a log, the floor on which a box is pushed."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import write_whole


@dataclass(frozen=True, slots=True)
class SavedView:
    """A page that needs no network; a notebook shows it as it is.

    Args:
        html: The page.
        height: Height of the frame in which a notebook shows it [px].
    """

    html: str
    height: int = 900

    def save(self, path: str | Path) -> Path:
        """Write the page, whole or not at all; returns its path."""
        write_whole(Path(path), self.html)
        return Path(path)

    def _repr_html_(self) -> str:
        """The page in a frame."""
        return (
            f'<iframe title="amhe" style="width:100%;height:{self.height}px;border:0" '
            f'srcdoc="{html.escape(self.html)}"></iframe>'
        )

    def __repr__(self) -> str:
        return f"SavedView({len(self.html) / 1e6:.1f} MB)"


class Displayed:
    """A value that a notebook shows as a page with tables and figures."""

    __slots__ = ()
    #: Makes the page of a value. The package sets it, as nothing below may know the room that draws.
    painter: ClassVar[Callable[[Displayed], SavedView]]

    def plot(self) -> SavedView:
        """The value as a page of tables and figures; a notebook shows it."""
        return Displayed.painter(self)

    def _repr_html_(self) -> str:
        return self.plot()._repr_html_()


@dataclass(frozen=True, slots=True, eq=False)
class TimeCurve:
    """One number over time.

    Args:
        name: What it is.
        group: Those of one group are shown together.
        unit: Its unit; empty: it has none.
        times: Times from the log's start [s], shape (n,).
        values: The number, shape (n,).
        band: Lower and upper end of its 90 % interval, shape (2, n); None: it has none.
    """

    name: str
    group: str
    unit: str = ""
    times: FloatArray = field(default_factory=lambda: np.empty(0))
    values: FloatArray = field(default_factory=lambda: np.empty(0))
    band: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """The path of a box, its goal, and where the floor changes.

    Args:
        path: Points of the path of the box's centre [m], shape (n, 2); the last one is the goal.
        goal_yaw: Heading of the box at the goal [rad].
        footprint: Depth and width of the box [m].
        other_floor: Beyond this x there is another floor [m]; None: there is only one.
        marks: x at which something else changes [m].
        one_leg: Whether the robot pushes with one leg, not by walking.
    """

    path: FloatArray
    goal_yaw: float
    footprint: tuple[float, float]
    other_floor: float | None = None
    marks: tuple[float, ...] = ()
    one_leg: bool = False

    @property
    def curved(self) -> bool:
        """Whether the path is more than a straight line from its first to its last point."""
        return len(self.path) > 2


def outline(centre: FloatArray, yaw: float, size: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """X and y of the closed outline of a rectangle on the floor [m], shape (5,) each.

    Args:
        centre: Centre of the rectangle [m], shape (2,).
        yaw: Heading of the rectangle [rad].
        size: Depth along the heading and width across it [m].
    """
    ahead = 0.5 * size[0] * np.array([1, 1, -1, -1, 1])
    left = 0.5 * size[1] * np.array([1, -1, -1, 1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    return centre[0] + c * ahead - s * left, centre[1] + s * ahead + c * left
