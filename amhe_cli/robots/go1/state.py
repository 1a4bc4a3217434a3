"""The state of robot and box; plain arrays, the same for every target.

What a target measures are `Samples` of these keys: of the robot itself `joints.position`, `joints.velocity`,
`imu.angular_velocity` and `imu.linear_acceleration`, all at the same times; of the cameras `position` and
`orientation` of `trunk` and `box`, likewise; and `command.position`, the joint targets that the robot
followed, where it reports them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.rotations import exp, multiply, yaw_of
from amhe_cli.robots.go1.kinematics import LOWER, UPPER

#: Gravity in the models, and in all that is computed by hand [m/s^2].
GRAVITY = 9.81


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """White noise of the sensors (sd), and the period of motion capture.

    Args:
        position: Noise of measured positions [m].
        orientation: Noise of measured orientations, about each axis [rad].
        joint: Noise of joint angles [rad].
        joint_rate: Noise of joint velocities [rad/s].
        gyro: Noise of the gyro [rad/s].
        accelerometer: Noise of the accelerometer [m/s^2].
        pose_period: Time between two poses [s].
    """

    position: float = 0.002
    orientation: float = float(np.deg2rad(0.5))
    joint: float = 0.003
    joint_rate: float = 0.05
    gyro: float = 0.02
    accelerometer: float = 0.1
    pose_period: float = 0.01


@dataclass(frozen=True, eq=False)
class Body:
    """Pose and twist of trunk or box; leading axes, where there are any, are those of time.

    Args:
        position: Position of its origin in the world [m], shape (..., 3).
        orientation: Unit quaternion w, x, y, z, shape (..., 4).
        velocity: Velocity of its origin in the world [m/s], shape (..., 3).
        rate: Angular velocity in its own frame [rad/s], shape (..., 3).
    """

    position: FloatArray
    orientation: FloatArray
    velocity: FloatArray
    rate: FloatArray

    @cached_property
    def yaw(self) -> Any:
        """Heading [rad], shape (...); a plain number at one instant."""
        yaw = yaw_of(self.orientation)
        return yaw if np.ndim(yaw) else float(yaw)

    @cached_property
    def compass(self) -> tuple[Any, Any]:
        """Cosine and sine of the heading, each likewise."""
        return np.cos(self.yaw), np.sin(self.yaw)


def wrapped(angle: Any) -> Any:
    """The same angle in [-pi, pi): of an array (...), or of a plain number."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


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
    def under(position: FloatArray, orientation: FloatArray) -> Plane:
        """The frame that a body at a position (3,) [m] with a unit quaternion (4,) stands in."""
        return Plane(np.array(position[:2]), float(yaw_of(orientation)))

    def place(self, point: FloatArray) -> FloatArray:
        """A point of the world (3,) in this frame [m], shape (3,)."""
        d, c, s = point[:2] - self.origin, np.cos(self.yaw), np.sin(self.yaw)
        return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], point[2]])

    def seen(self, position: FloatArray, orientation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """A pose of the world, position (3,) [m] and unit quaternion (4,), in this frame."""
        return self.place(position), multiply(exp(np.array([0.0, 0.0, -self.yaw])), orientation)

    def turn(self, body: Body) -> float:
        """Heading of a body in this frame [rad]."""
        return wrapped(body.yaw - self.yaw)

    def pose(self, body: Body) -> FloatArray:
        """Place ahead and left [m] and heading [rad] of a body in this frame, shape (3,)."""
        return np.array([*self.place(body.position)[:2], self.turn(body)])

    def in_world(self, pose: FloatArray) -> FloatArray:
        """The inverse of `pose`: place [m] and heading [rad] in the world, shape (3,)."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        x, y = self.origin[0] + c * pose[0] - s * pose[1], self.origin[1] + s * pose[0] + c * pose[1]
        return np.array([x, y, self.yaw + pose[2]])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Robot and box at one instant.

    Args:
        time: Time of the instant [s].
        trunk, box: Pose and twist of each.
        joints: Joint angles in the order of `kinematics.JOINTS` [rad], shape (12,).
        joint_rates: Joint velocities [rad/s], shape (12,).
    """

    time: float
    trunk: Body
    box: Body
    joints: FloatArray
    joint_rates: FloatArray


def heading_velocity(body: Body) -> tuple[float, float]:
    """Speed of one body at one instant ahead, and to the left, of its own heading [m/s]."""
    (c, s), (x, y, _) = body.compass, body.velocity.tolist()
    return x * c + y * s, y * c - x * s


@dataclass(frozen=True, slots=True, eq=False)
class ModelLayout:
    """Where robot and box are in a model's state, as a `Robot`; joints in our order, whatever the file's.

    Args:
        trunk: Slice of qpos, 7 numbers; the slice of qvel, 6 numbers, is `trunk_v`.
        box: The same two slices of the box, `box` and `box_v`.
        joints: Indices into qpos, shape (12,); those into qvel are `joints_v`, those into ctrl `servos`.
    """

    trunk: slice
    trunk_v: slice
    box: slice
    box_v: slice
    joints: IntArray
    joints_v: IntArray
    servos: IntArray

    lower, upper = LOWER, UPPER

    def state_of(self, time: float, qpos: FloatArray, qvel: FloatArray) -> State:
        """See `Robot`: copies, whatever happens to the model's own arrays."""
        qpos, qvel = np.array(qpos), np.array(qvel)
        return State(time, *self.bodies(qpos, qvel), qpos[self.joints], qvel[self.joints_v])

    def bodies(self, qpos: FloatArray, qvel: FloatArray) -> tuple[Body, Body]:
        """Trunk and box of coordinates (..., nq) and velocities (..., nv), as views of them."""
        places = ((self.trunk, self.trunk_v), (self.box, self.box_v))
        pairs = ((qpos[..., q], qvel[..., v]) for q, v in places)
        trunk, box = (Body(q[..., :3], q[..., 3:], v[..., :3], v[..., 3:]) for q, v in pairs)
        return trunk, box

    def coordinates(self, state: State) -> tuple[FloatArray, FloatArray]:
        """The inverse: qpos (26,) and qvel (24,) of a model of robot and box alone."""
        qpos, qvel = np.empty(26), np.empty(24)
        qpos[self.trunk] = np.concatenate((state.trunk.position, state.trunk.orientation))
        qpos[self.box] = np.concatenate((state.box.position, state.box.orientation))
        qpos[self.joints] = state.joints
        qvel[self.trunk_v] = np.concatenate((state.trunk.velocity, state.trunk.rate))
        qvel[self.box_v] = np.concatenate((state.box.velocity, state.box.rate))
        qvel[self.joints_v] = state.joint_rates
        return qpos, qvel
