"""How high the trunk is over a floor that the robot touches, from its joints and its description."""

from __future__ import annotations

from functools import cache

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.model import layout, plant_model

#: Higher than any part of the robot is over another [m].
_ABOVE = 1.0


def trunk_height(orientation: FloatArray, joints: FloatArray) -> float:
    """Height of the trunk's centre when the lowest of all collision shapes touches the floor [m].

    Args:
        orientation: Unit quaternion of the trunk (4,); its heading does not matter.
        joints: Joint angles [rad], shape (12,).
    """
    model, robot = _robot()
    data, at, floor = mujoco.MjData(model), layout(model), model.geom("floor").id
    data.qpos[at.trunk] = (0.0, 0.0, _ABOVE, *orientation)
    data.qpos[at.joints] = joints
    mujoco.mj_kinematics(model, data)
    gaps = [mujoco.mj_geomDistance(model, data, floor, shape, 2.0 * _ABOVE, None) for shape in robot]
    return _ABOVE - min(gaps)


@cache
def _robot() -> tuple[mujoco.MjModel, list[int]]:
    """The plant's model, and the robot's shapes that touch the floor."""
    model = plant_model()
    floor, box = model.geom("floor").id, model.geom("box").id
    pairs = np.stack((model.pair_geom1, model.pair_geom2), axis=1)
    touching = pairs[(pairs == floor).any(axis=1)].ravel().tolist()
    return model, sorted(set(touching) - {floor, box})
