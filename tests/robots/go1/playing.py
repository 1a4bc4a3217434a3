"""A Go1 driven by a gait, open loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.robots.go1.behaviours.gait import Gait, LegTargets, standing, walk
from amhe_cli.robots.go1.model import Box, home, layout

#: A box out of the robot's way.
FAR = Box(position=(5.0, 0.0))


@dataclass
class Motion:
    """Trunk and box over time, at 50 Hz from the end of the first second of standing."""

    trunk: np.ndarray
    box: np.ndarray

    @property
    def tilt(self) -> np.ndarray:
        """Angle between the trunk's up and the world's [rad]."""
        return np.arccos(1.0 - 2.0 * (self.trunk[:, 4] ** 2 + self.trunk[:, 5] ** 2))

    @property
    def yaw(self) -> float:
        q = self.trunk[-1, 3:]
        return float(2.0 * np.arctan2(q[3], q[0]))


def play(model: mujoco.MjModel, at_time: Callable[[float], LegTargets], seconds: float) -> Motion:
    """Stand for a second, then follow a gait for some seconds at 50 Hz."""
    data = mujoco.MjData(model)
    at = layout(model)
    data.qpos[:] = home(model)
    trunk, box = [], []
    for cycle in range(round((1.0 + seconds) * 50)):
        time = cycle / 50 - 1.0
        reference = walk(standing(Gait()), 0.0, np.zeros(3)) if time < 0.0 else at_time(time)
        data.ctrl[at.servos] = reference.targets
        for _ in range(round(0.02 / model.opt.timestep)):
            mujoco.mj_step(model, data)
        if time >= -0.021:
            trunk.append(data.qpos[at.trunk].copy())
            box.append(data.qpos[at.box].copy())
    assert not data.warning.number.any()
    return Motion(np.array(trunk), np.array(box))
