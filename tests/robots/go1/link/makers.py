"""States of a robot that all is well with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link.packets import SERVO, RobotState

#: Legs of a robot that lies, calves folded.
FOLDED = np.tile([0.0, 1.25, -2.75], 4)


def a_state(**changes: Any) -> RobotState:
    """A robot that stands still."""
    return replace(
        RobotState(
            tick=1, quaternion=np.array([1.0, 0, 0, 0]), gyro=np.zeros(3),
            accelerometer=np.array([0, 0, 9.81]), modes=np.full(12, SERVO),
            joints=np.array(HOME), joint_rates=np.zeros(12), torques=np.zeros(12),
            temperatures=np.full(12, 30.0), charge=80,
        ),
        **changes,
    )  # fmt: skip
