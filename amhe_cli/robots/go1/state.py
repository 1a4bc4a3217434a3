"""The state of robot and box, and what sensors tell of it; plain arrays, the same for every target."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.model import ModelLayout

#: Of the models, and of all that is computed by hand [m/s^2].
GRAVITY = 9.81


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Pose and twist of trunk or box; leading axes, where there are any, are those of time.

    Args:
        position: Of its origin in the world [m], shape (..., 3).
        orientation: Unit quaternion w, x, y, z, shape (..., 4).
        velocity: Of its origin in the world [m/s], shape (..., 3).
        rate: Angular velocity in its own frame [rad/s], shape (..., 3).
    """

    position: FloatArray
    orientation: FloatArray
    velocity: FloatArray
    rate: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Robot and box at one instant.

    Args:
        time: [s].
        trunk, box: Pose and twist.
        joints: Angles in the order of `legs.JOINTS` [rad], shape (12,).
        joint_rates: [rad/s], shape (12,).
    """

    time: float
    trunk: Body
    box: Body
    joints: FloatArray
    joint_rates: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """What the sensors said since they were last read: m samples of the robot's own, n of the cameras'.

    Args:
        time: Until when [s].
        robot_times: Of the robot's own samples [s], shape (m,).
        joints: [rad], shape (m, 12).
        joint_rates: [rad/s], shape (m, 12).
        gyro: Angular velocity of the trunk in its own frame [rad/s], shape (m, 3).
        accelerometer: Specific force in the trunk's frame [m/s^2], shape (m, 3).
        pose_times: Of the poses [s], shape (n,).
        trunk_position, box_position: In the world [m], shape (n, 3).
        trunk_orientation, box_orientation: Unit quaternions w, x, y, z, shape (n, 4).
        targets: Joint targets that were followed at `robot_times` [rad], shape (m, 12); None: those planned.
    """

    time: float
    robot_times: FloatArray
    joints: FloatArray
    joint_rates: FloatArray
    gyro: FloatArray
    accelerometer: FloatArray
    pose_times: FloatArray
    trunk_position: FloatArray
    trunk_orientation: FloatArray
    box_position: FloatArray
    box_orientation: FloatArray
    targets: FloatArray | None = None


def heading_velocity(body: Body) -> tuple[float, float]:
    """Speed of one body at one instant ahead, and to the left, of its own heading [m/s]."""
    yaw = float(yaw_of(body.orientation))
    x, y = body.velocity[0], body.velocity[1]
    return float(x * np.cos(yaw) + y * np.sin(yaw)), float(y * np.cos(yaw) - x * np.sin(yaw))


def state_of(at: ModelLayout, time: float, qpos: FloatArray, qvel: FloatArray) -> State:
    """The state of a model that lies at `at`: copies, whatever happens to the model's own arrays."""
    return State(
        time,
        _body(qpos[at.trunk], qvel[at.trunk_v]),
        _body(qpos[at.box], qvel[at.box_v]),
        np.array(qpos[at.joints]),
        np.array(qvel[at.joints_v]),
    )


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


def _body(pose: FloatArray, twist: FloatArray) -> Body:
    return Body(np.array(pose[:3]), np.array(pose[3:]), np.array(twist[:3]), np.array(twist[3:]))


def merged(parts: list[Measurements]) -> Measurements:
    """Measurements one after the other as one."""
    if len(parts) == 1:
        return parts[0]
    sampled = {name: [getattr(part, name) for part in parts] for name in _SAMPLED}
    joined = {name: np.concatenate(each) for name, each in sampled.items() if each[0] is not None}
    return Measurements(parts[-1].time, **joined)


_SAMPLED = tuple(field.name for field in fields(Measurements))[1:]
