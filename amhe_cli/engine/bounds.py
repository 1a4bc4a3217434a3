"""What a robot must not do while it plays an excitation, checked in simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.engine.states import home
from amhe_cli.system.assumed import acting
from amhe_cli.system.parameters.contacts import geom_name
from amhe_cli.system.system import System

#: Time between two states that are looked at [s].
_LOOK = 0.01


@dataclass(frozen=True, slots=True)
class Broken:
    """A bound that a rollout breaks.

    Args:
        text: What happens, in words.
        joint: Row of the joint that breaks it; None: several do together.
        advice: What helps where no smaller motion does.
    """

    text: str
    joint: int | None = None
    advice: str = ""


def joint_at_limit(model: mujoco.MjModel, qpos: FloatArray) -> Broken | None:
    """A limited hinge or slide that is at its limits in states (n, nq)."""
    joints = np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2))  # neither free nor ball
    values = qpos[:, model.jnt_qposadr[joints]]
    beyond = (values <= model.jnt_range[joints, 0]) | (values >= model.jnt_range[joints, 1])
    hit = joints[beyond.any(axis=0)]
    advice = "widen its range in the model, or start elsewhere by a `keyframe:` in system.yaml"
    return _by(model, int(hit[0]), "reaches its limit", advice) if hit.size else None


def home_within(system: System) -> None:
    """Check that a system's home position is within the ranges of its joints.

    Raises:
        ConfigError: It is not, so that nothing can begin there.
    """
    model = system.model
    qpos, _ = home(model, system.keyframe, system.input_spec)
    for joint in np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2)):
        value, (low, high) = qpos[model.jnt_qposadr[joint]], model.jnt_range[joint]
        if not low <= value <= high:
            raise ConfigError(
                f"{system.name}: the home position, {model.joint(joint).name} = {value:.3g}, is outside its "
                f"range {low:.3g} to {high:.3g} {_unit(model, int(joint))}: give a `keyframe:` in system.yaml"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """Bounds of what driven joints may do, beside their limits: speed, force, contact.

    Args:
        actuators: Rows of the actuators that are commanded, shape (k,).
        speed: Largest speed of each actuator's joint [rad/s or m/s], shape (k,).
    """

    system: System
    actuators: Sequence[int]
    speed: FloatArray

    def broken(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray
    ) -> Broken | None:
        """What a rollout breaks first; None where it breaks nothing.

        Args:
            theta: Its parameters, shape (d,).
            qpos, qvel, inputs: Its states and inputs, shape (n, ...).
        """
        model = self.system.edits.apply(self.system.model, theta)
        joints = model.actuator_trnid[list(self.actuators), 0]
        fastest = np.abs(qvel[:, model.jnt_dofadr[joints]]).max(axis=0)
        for joint, speed, most in zip(joints, fastest, self.speed, strict=True):
            if speed > most:
                unit = f"{_unit(model, int(joint))}/s"
                return _by(model, int(joint), f"is faster than {most:.3g} {unit}", "allow a larger `speed`")
        some = slice(None, None, max(1, round(_LOOK / self.system.dt)))
        acts = acting(model, self.system.input_spec, qpos[some], qvel[some], inputs[some])
        full = (acts.force[:, list(self.actuators)] | acts.joint_force[:, joints]).any(axis=0)
        if full.any():
            advice = "give a smaller `speed`, or the actuator its real force limit in the model"
            strained = int(joints[np.argmax(full)])
            return _by(model, strained, "needs more force than its actuator has", advice)
        return self._touches(model, qpos[some], joints)

    def _touches(self, model: mujoco.MjModel, qpos: FloatArray, joints: Sequence[int]) -> Broken | None:
        """Two geoms that touch, one of them on a driven link, and did not at home."""
        data = mujoco.MjData(model)
        data.qpos[:], _ = home(model, self.system.keyframe, self.system.input_spec)
        before = set(_contacts(model, data))
        moved = {int(model.jnt_bodyid[joint]) for joint in joints}
        links = {row for row in range(model.nbody) if moved & set(_ancestors(model, row))}
        for state in qpos:
            data.qpos[:] = state
            for pair in _contacts(model, data):
                if pair not in before and links & {int(model.geom_bodyid[geom]) for geom in pair}:
                    text = " touches ".join(geom_name(model, geom) for geom in pair)
                    advice = (
                        "start elsewhere by a `keyframe:` in system.yaml, or exclude the pair in the model"
                    )
                    return Broken(text, advice=advice)
        return None


def _by(model: mujoco.MjModel, joint: int, text: str, advice: str) -> Broken:
    return Broken(f"joint {model.joint(joint).name} {text}", joint, advice)


def _unit(model: mujoco.MjModel, joint: int) -> str:
    return "m" if model.jnt_type[joint] == 2 else "rad"  # mjJNT_SLIDE


def _contacts(model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int, int]]:
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    pairs = data.contact.geom[data.contact.dist < 0.0]
    return [(first, second) for first, second in pairs.tolist() if first >= 0 and second >= 0]


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """A body and those that it hangs on."""
    bodies = [body]
    while bodies[-1]:
        bodies.append(int(model.body_parentid[bodies[-1]]))
    return bodies
