"""From the frame of motion capture to that of the task, with checks whether poses can be true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import conjugate, exp, multiply, rotate, yaw_of
from amhe_cli.robots.go1.poses.source import Pose, PoseError

#: Place [m] and rotation vector [rad] of the body that carries the markers, in the rigid body's frame.
Offset = tuple[float, float, float, float, float, float]
NO_OFFSET: Offset = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
#: IMU and cameras may differ by so much about the trunk's up [rad].
LEVEL = float(np.deg2rad(15.0))
#: Height of a lying or standing trunk over the floor [m]: what is outside is not in metres, or not the trunk.
_HEIGHTS = (0.03, 0.6)


def offset_pose(pose: Pose, offset: Offset) -> Pose:
    """The pose of a body from that of its rigid body; offset: place [m] and rotation vector [rad] in it."""
    position, orientation = pose
    place, turn = np.array(offset[:3]), np.array(offset[3:])
    return position + rotate(orientation, place), multiply(orientation, exp(turn))


def rigid_body(true: Pose, offset: Offset) -> Pose:
    """The pose that a rigid body has, whose offset leads to the true pose."""
    turn = multiply(true[1], conjugate(exp(np.array(offset[3:]))))
    return true[0] - rotate(turn, np.array(offset[:3])), turn


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """The task's frame in that of motion capture: moved over the floor and turned about the vertical.

    Args:
        origin: Origin of the task's frame in that of motion capture [m], shape (3,).
        turn: Orientation of the task's frame in that of motion capture, a unit quaternion, shape (4,).
    """

    origin: FloatArray
    turn: FloatArray

    @staticmethod
    def same() -> World:
        """The frame of motion capture itself."""
        return World(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))

    @staticmethod
    def under(trunk: Pose) -> World:
        """The frame on the floor under the trunk, x along its heading."""
        position, orientation = trunk
        level = np.array([0.0, 0.0, yaw_of(orientation)])
        return World(np.array([position[0], position[1], 0.0]), exp(level))

    def seen(self, pose: Pose) -> Pose:
        """A pose of motion capture, in the task's frame."""
        back = conjugate(self.turn)
        return rotate(back, pose[0] - self.origin), multiply(back, pose[1])


def up(orientation: FloatArray) -> FloatArray:
    """The world's up in a body's frame, shape (3,)."""
    return rotate(conjugate(orientation), np.array([0.0, 0.0, 1.0]))


def check_axes(trunk: Pose, imu: FloatArray) -> None:
    """Refuse a frame that is not in metres with z upward, by comparison with the IMU.

    Args:
        trunk: Pose of the trunk by motion capture.
        imu: Orientation by the IMU, shape (4,); its heading does not matter.

    Raises:
        PoseError: They contradict each other.
    """
    position, orientation = trunk
    height = float(position[2])
    between = float(np.arccos(np.clip(up(orientation) @ up(imu), -1.0, 1.0)))
    if between > LEVEL and abs(float(up(orientation)[2])) < 0.5:
        raise PoseError(
            f"by motion capture the trunk leans {np.rad2deg(between):.0f} degrees more than by its IMU: is "
            "its up axis z? (Motive: Settings > Streaming > Up Axis: Z)"
        )
    if between > LEVEL:
        raise PoseError(
            f"motion capture and IMU disagree by {np.rad2deg(between):.0f} degrees about the trunk's tilt: "
            "align the rigid body with the trunk, or set go1.trunk_offset"
        )
    if not _HEIGHTS[0] < height < _HEIGHTS[1]:
        raise PoseError(
            f"by motion capture the trunk is {height:.3g} m over the floor: stream metres, z upward, with "
            "the origin on the floor, and the pivot in the trunk's centre"
        )


def check_place(box: FloatArray, wanted: FloatArray, tolerance: float) -> None:
    """Refuse a box that is not where the task puts it.

    Args:
        box: Centre of the box in the task's frame [m], shape (3,).
        wanted: Centre at which it should be, shape (3,).
        tolerance: Largest distance [m].

    Raises:
        PoseError: It is elsewhere.
    """
    if np.hypot(*(box[:2] + wanted[:2])) < tolerance and wanted[0] > tolerance:
        raise PoseError(
            "the box seems to be behind the robot: have the two rigid bodies each other's name? "
            "(`go1.trunk=NAME` `go1.box=NAME`)"
        )
    away = np.hypot(*(box[:2] - wanted[:2]))
    if away > tolerance or abs(box[2] - wanted[2]) > tolerance:
        at, to = (", ".join(f"{value:.2f}" for value in place) for place in (box, wanted))
        raise PoseError(
            f"the box is at ({at}) m from the robot, the task wants it at ({to}): move one of them, or "
            "set go1.box_offset (or go1.place_tolerance)"
        )


def tilt_offset(trunk: Pose, imu: FloatArray) -> FloatArray:
    """Rotation vector [rad] that would make motion capture agree with the IMU about up, shape (3,)."""
    seen, sensed = up(trunk[1]), up(imu)
    axis, sine = np.cross(sensed, seen), float(np.linalg.norm(np.cross(sensed, seen)))
    angle = float(np.arctan2(sine, seen @ sensed))
    return axis / sine * angle if sine > 1e-9 else np.zeros(3)
