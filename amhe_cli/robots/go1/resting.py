"""How high the trunk is over a floor that the robot touches, from its joints and its description."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.model import layout, plant_model


def trunk_height(orientation: FloatArray, joints: FloatArray) -> float:
    """Height of the trunk's centre when the lowest of all collision shapes touches the floor [m].

    Args:
        orientation: Unit quaternion of the trunk (4,); its heading does not matter.
        joints: Joint angles [rad], shape (12,).
    """
    model, robot = _robot()
    data = mujoco.MjData(model)
    at = layout(model)
    data.qpos[at.trunk] = (0.0, 0.0, 0.0, *orientation)
    data.qpos[at.joints] = joints
    mujoco.mj_kinematics(model, data)
    down = data.geom_xmat[robot, 6:]  # of each shape's axes, shape (n, 3)
    lowest = data.geom_xpos[robot, 2] - [
        _reach(kind, size, axes)
        for kind, size, axes in zip(model.geom_type[robot], model.geom_size[robot], down, strict=True)
    ]
    return -float(lowest.min())


@cache
def _robot() -> tuple[mujoco.MjModel, list[int]]:
    """The plant's model, and the robot's shapes that touch the floor."""
    model = plant_model()
    floor, box = model.geom("floor").id, model.geom("box").id
    pairs = np.stack((model.pair_geom1, model.pair_geom2), axis=1)
    touching = pairs[(pairs == floor).any(axis=1)].ravel().tolist()
    return model, sorted(set(touching) - {floor, box})


def _reach(kind: int, size: FloatArray, axes: FloatArray) -> float:
    """How far a shape reaches down from its centre [m].

    Args:
        kind: Type of the shape, an mjtGeom.
        size: Size as MuJoCo defines it for that type, shape (3,).
        axes: Vertical component of each of its axes, shape (3,).
    """
    upright = abs(float(axes[2]))
    match kind:
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return float(size[0])
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return float(size[0] + size[1] * upright)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return float(size[1] * upright + size[0] * np.sqrt(max(0.0, 1.0 - upright**2)))
        case _:
            return float(np.abs(axes) @ size)
