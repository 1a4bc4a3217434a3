"""Places on the floor: along the course that a box is to follow, and as a standing robot counts them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.objective import wrapped
from amhe_cli.robots.go1.state import Body


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where points are with respect to a path; each shape (...).

    Args:
        progress: Distance along the path from its start [m]; it goes on beyond both ends.
        left: Distance from the path, positive to the left [m].
        heading: Heading of the path at that point [rad].
    """

    progress: FloatArray
    left: FloatArray
    heading: FloatArray


@dataclass(frozen=True, slots=True)
class Course:
    """A path of constant curvature.

    Args:
        start: First point [m].
        heading: Direction at the start [rad].
        length: Length of the path [m].
        curvature: 1 / radius, positive to the left [1/m]; 0 is a line.
    """

    start: tuple[float, float]
    heading: float
    length: float
    curvature: float = 0.0

    @property
    def goal(self) -> FloatArray:
        """Last point of the path [m], shape (2,)."""
        return self.points(np.array([self.length]))[0]

    def tapered(self, progress: FloatArray | float, taper: float) -> float:
        """Share of the speed that is left along the path: 1, going to 0 over the last `taper` [m]."""
        return float(np.clip((self.length - progress) / taper, 0.0, 1.0))

    def nearest(self, point: FloatArray, place: Place) -> FloatArray:
        """The point of the path beside a point [m] (2,) whose place is known, shape (2,)."""
        return point - place.left * np.array([-np.sin(place.heading), np.cos(place.heading)])

    def points(self, progress: FloatArray) -> FloatArray:
        """Points at distances from the start [m] (...), shape (..., 2)."""
        turn = self.curvature * progress
        # sin(x)/x and (1 - cos x)/x stay exact where the path is straight.
        ahead = progress * np.sinc(turn / np.pi)
        left = progress * np.sinc(0.5 * turn / np.pi) * np.sin(0.5 * turn)
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack((self.start[0] + c * ahead - s * left, self.start[1] + s * ahead + c * left), axis=-1)

    def place(self, points: FloatArray) -> Place:
        """Progress, distance and heading of points [m] (..., 2) with respect to the path."""
        dx, dy = points[..., 0] - self.start[0], points[..., 1] - self.start[1]
        c, s = np.cos(self.heading), np.sin(self.heading)
        ahead, left = c * dx + s * dy, c * dy - s * dx
        if self.curvature == 0.0:
            return Place(ahead, left, np.full_like(ahead, self.heading))
        k = self.curvature
        # Angle about the centre, cut where the path is not: opposite to its middle.
        middle = 0.5 * k * self.length
        angle = np.arctan2(k * ahead, 1.0 - k * left) - middle
        turn = middle + np.mod(angle + np.pi, 2.0 * np.pi) - np.pi
        distance = np.hypot(ahead, left - 1.0 / k)
        return Place(turn / k, np.sign(k) * (1.0 / abs(k) - distance), self.heading + turn)


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """Origin and heading of a frame whose z is the world's.

    Args:
        origin: Origin of the frame in the world [m], shape (2,).
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
