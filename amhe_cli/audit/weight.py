"""How much a number matters: by how much of the forces along a motion another value would change them."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from amhe_cli.check.motion import States
from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.inverse import forces_along

#: States that stand for all, where no log says how a robot moves.
_STATES = 60
#: Speeds [rad/s] and accelerations [rad/s^2] of such states, and how far servos are from their targets [rad].
_SPEED, _ACCELERATION, _BEHIND = 1.0, 5.0, 0.05


def anywhere(model: mujoco.MjModel) -> States:
    """States all over a model's joints, the same in each call."""
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (_STATES, 1))
    targets = np.zeros((_STATES, model.nu))
    for joint in range(model.njnt):
        if model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-1.0, 1.0)
            qpos[:, model.jnt_qposadr[joint]] = rng.uniform(low, high, _STATES)
    for actuator in range(model.nactuator):
        joint, place = int(model.actuator_trnid[actuator, 0]), int(model.actuator_ctrladr[actuator])
        if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE and joint >= 0:
            targets[:, place] = qpos[:, model.jnt_qposadr[joint]] + rng.normal(0.0, _BEHIND, _STATES)
        else:
            targets[:, place] = rng.normal(0.0, 1.0, _STATES)
    qvel, qacc = (rng.normal(0.0, size, (_STATES, model.nv)) for size in (_SPEED, _ACCELERATION))
    return States(qpos, qvel, qacc, targets, int(mujoco.mjtState.mjSTATE_CTRL))


def weights(model: mujoco.MjModel, others: Iterable[mujoco.MjModel], states: States) -> list[float]:
    """By how much the forces of other models differ, as shares of those that the model's joints need.

    Args:
        others: Models of the same layout.
        states: The motion.

    Returns:
        Of each other model the share at the joint that differs most, rms over the motion.
    """
    own, needed = _forces(model, states)
    usual = np.maximum(np.sqrt((needed**2).mean(axis=0)), 1e-12)
    return [
        float(np.sqrt(((_forces(one, states)[0] - own) ** 2).mean(axis=0) / usual**2).max(initial=0.0))
        for one in others
    ]


def _forces(model: mujoco.MjModel, states: States) -> tuple[FloatArray, FloatArray]:
    """What the motion needs and nothing gives, with dry friction, and what it needs, (T, nv)."""
    found = forces_along(model, states.qpos, states.qvel, states.qacc, states.inputs, states.input_spec)
    dry = model.dof_frictionloss * np.sign(states.qvel)
    return found.missing + dry, found.needed + dry
