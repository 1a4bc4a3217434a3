"""What a motion costs, term by term, along the course that a box is to follow: in plans, and in J.

Every term is a weighted square; a cost is their mean over time. The belief matters because the *box's* speed
is weighted, not the robot's alone: how hard to push for it depends on mass and friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, copysign, cos, hypot, sin

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.state import Body, wrapped

#: The bumper's front in the trunk's frame, ahead of its origin [m].
BUMPER = 0.27


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What robot and box should do at present.

    Args:
        time: Time at which the reference was made [s].
        speed: Desired speed of robot and box along their headings [m/s].
        origin: A point on the line that the box is to follow [m], shape (2,).
        heading: Heading of that line, and of the box's desired velocity [rad].
        yaw: Desired yaw of the robot [rad].
        box_yaw: Desired yaw of the box [rad].
        turn: How fast the three headings turn [rad/s].
        offset: Where the bumper's middle pushes, left of the box's middle [m].
        pushing: 1 where the box is to move already, 0 while the robot still comes to it.
        harder: Share by which it is pushed harder than its believed friction demands.
        lift: How much higher than usual the trunk is to be [m].
    """

    time: float
    speed: float
    origin: FloatArray
    heading: float
    yaw: float
    box_yaw: float
    turn: float = 0.0
    offset: float = 0.0
    pushing: float = 1.0
    harder: float = 0.0
    lift: float = 0.0


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of the terms that all behaviours share; in 1 / (unit of the term)^2."""

    box_speed: float = 300.0
    """Weight of (box's speed along the heading - reference) [m/s]."""
    box_left: float = 20.0
    """Weight of the box's distance from the line [m]."""
    box_yaw: float = 60.0
    """Weight of the error of the box's yaw [rad]."""
    height: float = 200.0
    """Weight of the error of the trunk's height [m]."""
    tilt: float = 60.0
    """Weight of the sine of the trunk's roll and pitch."""
    box_tilt: float = 300.0
    """Weight of the sine of the box's roll and pitch."""
    knots: float = 0.5
    """Weight of the knots: how far the joint targets leave the behaviour's own [rad]."""


@dataclass(frozen=True, slots=True)
class PushWeights(Weights):
    """Weights of the terms of walking and pushing."""

    robot_speed: float = 100.0
    """Weight of (trunk's speed ahead in its own heading - reference) [m/s]."""
    robot_left: float = 60.0
    """Weight of the distance between the bumper's middle and the place where it should push [m]."""
    yaw: float = 100.0
    """Weight of the error of the robot's yaw [rad]."""


@dataclass(frozen=True, slots=True)
class SweepWeights(Weights):
    """Weights of the terms of pushing with one leg."""

    box_left: float = 100.0
    box_yaw: float = 20.0
    robot_speed: float = 20.0
    """Weight of the trunk's speed, which should be zero [m/s]."""
    trunk_place: float = 1500.0
    """Weight of the trunk's distance from where it should lean to [m]; in plans only."""
    trunk_turn: float = 40.0
    """Weight of the error of the trunk's yaw against its lean [rad]; in plans only."""


def _shared_terms(
    w: Weights, trunk: Body, box: Body, height: float, at: Reference, turned: FloatArray | float
) -> dict[str, FloatArray]:
    """Terms of all behaviours, each (..., H); `turned` [rad] is how far the references have turned."""
    c, s = np.cos(at.heading + turned), np.sin(at.heading + turned)
    speed = c * box.velocity[..., 0] + s * box.velocity[..., 1]
    drift = c * (box.position[..., 1] - at.origin[1]) - s * (box.position[..., 0] - at.origin[0])
    return {
        "box_speed": at.pushing * w.box_speed * (speed - at.speed) ** 2,
        "box_left": w.box_left * drift**2,
        "box_yaw": w.box_yaw * wrapped(box.yaw - at.box_yaw - turned) ** 2,
        "height": w.height * (trunk.position[..., 2] - height) ** 2,
        "tilt": w.tilt * tilt_squared(trunk.orientation),
        "box_tilt": w.box_tilt * tilt_squared(box.orientation),
    }


def sweep_terms(
    weights: SweepWeights, trunk: Body, box: Body, height: float, at: Reference
) -> dict[str, FloatArray]:
    """Terms of pushing with one leg, each shape (..., H); arguments as of `push_terms`."""
    still = weights.robot_speed * (trunk.velocity[..., :2] ** 2).sum(axis=-1)
    return _shared_terms(weights, trunk, box, height, at, 0.0) | {"robot_speed": still}


def push_terms(
    weights: PushWeights, trunk: Body, box: Body, height: float, at: Reference, elapsed: FloatArray
) -> dict[str, FloatArray]:
    """Terms of walking behind a box, each shape (..., H).

    Args:
        trunk, box: Motions, leading axes (..., H).
        height: Desired height of the trunk [m].
        at: What robot and box should do.
        elapsed: Time since it was made [s], shape (H,).
    """
    w = weights
    turned = at.turn * elapsed
    c, s = trunk.compass
    ahead = trunk.velocity[..., 0] * c + trunk.velocity[..., 1] * s
    _, left = bumper_from_box(trunk, box)
    return _shared_terms(w, trunk, box, height, at, turned) | {
        "robot_speed": w.robot_speed * (ahead - at.speed) ** 2,
        "robot_left": w.robot_left * (left - at.offset) ** 2,
        "yaw": w.yaw * wrapped(trunk.yaw - at.yaw - turned) ** 2,
    }


def bumper_from_box(trunk: Body, box: Body) -> tuple[FloatArray, FloatArray]:
    """Middle of the bumper's front, ahead and left of the box's middle in the box's frame [m], each (...)."""
    (ahead, aside), (c, s) = trunk.compass, box.compass
    dx = trunk.position[..., 0] + BUMPER * ahead - box.position[..., 0]
    dy = trunk.position[..., 1] + BUMPER * aside - box.position[..., 1]
    return c * dx + s * dy, c * dy - s * dx


def tilt_squared(q: FloatArray) -> FloatArray:
    """Squared sine of the angle between a body's z and the world's, shape (...), by unit quaternions."""
    square = q[..., 1] ** 2 + q[..., 2] ** 2  # squared sine of half the angle
    return 4.0 * square * (1.0 - square)


def limited(value: float, limit: float) -> float:
    """The nearest number within a limit on either side of zero."""
    return max(-limit, min(value, limit))


@dataclass(frozen=True, slots=True)
class Place:
    """How far along a path, beyond its ends too, and left of it a point is [m]; its heading there [rad]."""

    progress: float
    left: float
    heading: float


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

    def tapered(self, progress: float, taper: float) -> float:
        """Share of the speed that is left along the path: 1, going to 0 over the last `taper` [m]."""
        return min(max((self.length - progress) / taper, 0.0), 1.0)

    def nearest(self, point: FloatArray, place: Place) -> FloatArray:
        """The point of the path beside a point [m] (2,) whose place is known, shape (2,)."""
        return point - place.left * np.array([-sin(place.heading), cos(place.heading)])

    def points(self, progress: FloatArray) -> FloatArray:
        """Points at distances from the start [m] (...), shape (..., 2)."""
        turn = self.curvature * progress
        # sin(x)/x and (1 - cos x)/x stay exact where the path is straight.
        ahead = progress * np.sinc(turn / np.pi)
        left = progress * np.sinc(0.5 * turn / np.pi) * np.sin(0.5 * turn)
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.stack((self.start[0] + c * ahead - s * left, self.start[1] + s * ahead + c * left), axis=-1)

    def place(self, point: FloatArray) -> Place:
        """Progress, distance and heading of a point [m] (2,) with respect to the path."""
        dx, dy = (point - self.start).tolist()
        c, s = cos(self.heading), sin(self.heading)
        ahead, left = c * dx + s * dy, c * dy - s * dx
        if self.curvature == 0.0:
            return Place(ahead, left, self.heading)
        k = self.curvature
        # Angle about the centre, cut where the path is not: opposite to its middle.
        middle = 0.5 * k * self.length
        turn = middle + wrapped(atan2(k * ahead, 1.0 - k * left) - middle)
        distance = hypot(ahead, left - 1.0 / k)
        return Place(turn / k, 1.0 / k - copysign(distance, k), self.heading + turn)
