"""What is known of the robot itself, for planner and gait: see `group: robot` in models/go1_push/system.yaml.

A planner without dry friction takes half the time. What is known of it is viscous friction there, of the same
torque at the speed of a walking joint, and the gait leads the joints by it.
"""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.kinematics import KINDS
from amhe_cli.robots.go1.model import KD, KP, home, layout
from amhe_cli.robots.go1.state import GRAVITY
from amhe_cli.system.system import System

#: Speed of a joint at which dry friction and its stand-in are equal [rad/s]; dry friction of the model that
#: the gait was made with [N m].
_SPEED, _USUAL = 1.5, 0.2


def robot_is_known(system: System) -> bool:
    """Whether somebody has identified the robot."""
    return any(held.sd for held in system.edits.held.values())


def latency_of(system: System) -> float:
    """Time that a command takes to act, as far as it is known [s]."""
    return system.edits.held["command_latency"].value if robot_is_known(system) else 0.0


def without_dry_friction(system: System) -> System:
    """The system without dry friction in the robot's joints; viscous friction stands in for what is known."""
    held = {name: one.value for name, one in system.edits.held.items()}
    numbers = {f"joint_friction_{kind}": 0.0 for kind in KINDS}
    if robot_is_known(system):
        for kind in KINDS:
            more = held[f"joint_friction_{kind}"] - _USUAL
            numbers[f"joint_damping_{kind}"] = max(held[f"joint_damping_{kind}"] + more / _SPEED, 0.05)
    return system.fixing({name: value for name, value in numbers.items() if name in held})


def gait_of(system: System) -> Gait:
    """The gait of a robot as far as it is known."""
    if not robot_is_known(system):
        return Gait()
    model = without_dry_friction(system).model
    data, at = mujoco.MjData(model), layout(model)
    data.qpos[:] = home(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    gain = system.edits.held["motor_gain"].value
    trunk, damping = model.body("trunk").id, model.dof_damping[at.joints_v[:3]] + gain * KD
    ahead, left = (data.subtree_com[trunk] - data.xpos[trunk])[:2].tolist()
    hip, thigh, calf = np.asarray(damping).tolist()
    return Gait(
        kp=gain * KP, damping=(hip, thigh, calf), weight=float(model.body_subtreemass[trunk]) * GRAVITY,
        centre=(ahead, left),
    )  # fmt: skip
