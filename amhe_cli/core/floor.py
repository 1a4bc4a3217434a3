"""What a report draws on the floor on which a box is pushed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray


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
