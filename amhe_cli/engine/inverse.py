"""The model run backwards: the forces that a motion needs, and those that act along it."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.states import controls, first_activations


@dataclass(frozen=True, slots=True, eq=False)
class Forces:
    """Generalised forces at T instants of a motion [N or N m].

    Args:
        needed: What the motion needs beside springs, dampers and gravity compensation, M a + c + g - passive,
            shape (T, nv). Dry friction, contacts, limits and equalities are not in it.
        given: What actuators and applied forces give, shape (T, nv).
    """

    needed: FloatArray
    given: FloatArray

    @property
    def missing(self) -> FloatArray:
        """What the motion needs and nothing gives, shape (T, nv): dry friction is in it, with its sign."""
        return self.needed - self.given


def forces_along(
    model: mujoco.MjModel,
    qpos: FloatArray,
    qvel: FloatArray,
    qacc: FloatArray,
    inputs: FloatArray | None = None,
    input_spec: int = 0,
) -> Forces:
    """Forces along a motion; a state and an instant are about 10 microseconds for an arm.

    Args:
        model: The model, its parameters written into it (`ModelEdits.apply`).
        qpos, qvel, qacc: The motion, shape (T, nq), (T, nv) and (T, nv).
        inputs: Inputs at the same instants, shape (T, nu); None: nothing is given. Activations of filters
            have followed their commands for long.
        input_spec: mjtState bits of the inputs.
    """
    free = unconstrained(model)
    data, count = mujoco.MjData(free), len(qpos)
    needed, given = np.empty((count, model.nv)), np.zeros((count, model.nv))
    act = None
    if inputs is not None and model.na and (at := controls(model, input_spec)) is not None:
        act = first_activations(model, qpos, inputs[:, at])
    for k in range(count):
        if inputs is not None:
            mujoco.mj_setState(free, data, inputs[k], input_spec)
        data.qpos, data.qvel, data.qacc = qpos[k], qvel[k], qacc[k]
        mujoco.mj_inverse(free, data)
        needed[k] = data.qfrc_inverse
        if inputs is None:
            continue
        if act is not None:
            data.act = act[k]
        mujoco.mj_fwdActuation(free, data)
        given[k] = data.qfrc_actuator + data.qfrc_applied
        for body in np.flatnonzero(data.xfrc_applied.any(axis=1)):
            force, torque = np.split(data.xfrc_applied[body], 2)
            mujoco.mj_applyFT(free, data, force, torque, data.xipos[body], body, given[k])
    return Forces(needed, given)


def unconstrained(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model without dry friction, contacts, limits and equalities."""
    free = copy.copy(model)
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    free.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    return free
