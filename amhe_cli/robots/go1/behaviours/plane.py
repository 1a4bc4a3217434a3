"""A frame on the floor: places and headings as a standing robot counts them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.objective import wrapped
from amhe_cli.robots.go1.state import Body


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Origin and heading of a frame whose z is the world's.

    Args:
        origin: In the world [m], shape (2,).
        yaw: Heading of its x axis [rad].
    """

    origin: FloatArray
    yaw: float

    @staticmethod
    def under(body: Body) -> Plane:
        """The frame that a body stands in."""
        return Plane(np.array(body.position[:2]), float(yaw_of(body.orientation)))

    def place(self, point: FloatArray) -> FloatArray:
        """A point of the world (3,) in this frame [m], shape (3,)."""
        d, c, s = point[:2] - self.origin, np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], point[2]])

    def turn(self, body: Body) -> float:
        """Heading of a body in this frame [rad]."""
        return float(wrapped(yaw_of(body.orientation) - self.yaw))

    def pose(self, body: Body) -> FloatArray:
        """Place ahead and left [m] and heading [rad] of a body in this frame, shape (3,)."""
        return np.array([*self.place(body.position)[:2], self.turn(body)])

    def in_world(self, pose: FloatArray) -> FloatArray:
        """The inverse of `pose`: place [m] and heading [rad] in the world, shape (3,)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = self.origin[0] + c * pose[0] - s * pose[1], self.origin[1] + s * pose[0] + c * pose[1]
        return np.array([x, y, self.yaw + pose[2]])
