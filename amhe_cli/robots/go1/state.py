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
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.kinematics import LOWER, UPPER
from amhe_cli.robots.go1.model import ModelLayout

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


def state_of(at: ModelLayout, time: float, qpos: FloatArray, qvel: FloatArray) -> State:
    """The state of a model that lies at `at`: copies, whatever happens to the model's own arrays."""
    qpos, qvel = np.array(qpos), np.array(qvel)
    return State(time, *bodies(at, qpos, qvel), qpos[at.joints], qvel[at.joints_v])


def bodies(at: ModelLayout, qpos: FloatArray, qvel: FloatArray) -> tuple[Body, Body]:
    """Trunk and box of coordinates (..., nq) and velocities (..., nv), as views of them."""
    pairs = ((qpos[..., at.trunk], qvel[..., at.trunk_v]), (qpos[..., at.box], qvel[..., at.box_v]))
    trunk, box = (Body(q[..., :3], q[..., 3:], v[..., :3], v[..., 3:]) for q, v in pairs)
    return trunk, box


def coordinates(at: ModelLayout, state: State) -> tuple[FloatArray, FloatArray]:
    """The inverse: qpos (26,) and qvel (24,) of a model of robot and box alone."""
    qpos, qvel = np.empty(26), np.empty(24)
    qpos[at.trunk] = np.concatenate((state.trunk.position, state.trunk.orientation))
    qpos[at.box] = np.concatenate((state.box.position, state.box.orientation))
    qpos[at.joints] = state.joints
    qvel[at.trunk_v] = np.concatenate((state.trunk.velocity, state.trunk.rate))
    qvel[at.box_v] = np.concatenate((state.box.velocity, state.box.rate))
    qvel[at.joints_v] = state.joint_rates
    return qpos, qvel


@dataclass(frozen=True, slots=True, eq=False)
class Go1:
    """The robot of the planner's model.

    Args:
        at: Addresses of robot and box in that model's state.
        sigma: Start sd of the sampling noise on each joint's knots [rad], shape (12,).
    """

    at: ModelLayout
    sigma: FloatArray

    lower, upper = LOWER, UPPER

    @property
    def servos(self) -> IntArray:
        """See `Robot`."""
        return self.at.servos

    def coordinates(self, state: State) -> tuple[FloatArray, FloatArray]:
        """See `Robot`."""
        return coordinates(self.at, state)

    def state_of(self, time: float, qpos: FloatArray, qvel: FloatArray) -> State:
        """See `Robot`."""
        return state_of(self.at, time, qpos, qvel)

    def bodies(self, qpos: FloatArray, qvel: FloatArray) -> tuple[Body, Body]:
        """See `Robot`."""
        return bodies(self.at, qpos, qvel)
