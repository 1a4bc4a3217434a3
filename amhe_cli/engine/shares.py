"""Forces along a motion by what gives them, as a rollout computes them; where a motion touches nothing."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.engine.inverse import unconstrained
from amhe_cli.engine.states import collides
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.servos import with_servos

#: Surfaces that are nearer [m] may touch.
_NEAR = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Shares:
    """Forces along a motion by what gives them, shape (T, nv) where nothing else is said; see `Forces`.

    Args:
        needed, given: As in `Forces`.
        by: What each actuator gives, shape (T, actuators, nv).
        mass: The mass matrix, shape (T, nv, nv).
        friction: Size of the dry friction, which has no part in the others.
    """

    needed: FloatArray
    given: FloatArray
    by: FloatArray
    mass: FloatArray
    friction: FloatArray

    def missing(self, way: FloatArray) -> FloatArray:
        """What the motion needs and nothing gives, dry friction against its `way`, the sign of its speeds."""
        return self.needed + self.friction * way - self.given


def shares_along(
    model: mujoco.MjModel,
    qpos: FloatArray,
    qvel: FloatArray,
    qacc: FloatArray,
    inputs: FloatArray,
    input_spec: int,
    act: FloatArray,
) -> Shares:
    """Forces along a motion, by actuator; arguments as of `forces_along`, and activations (T, na).

    They are those of a rollout: it computes forces at a speed that is half a time step old (Euler), or half a
    step ahead (implicit); Euler's joint damping is implicit.
    """
    (free, drive), (count, nv) = with_servos(unconstrained(model)), qvel.shape
    kind, ahead = int(model.opt.integrator), 0.5 * model.opt.timestep
    euler, runge = int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4)
    qvel = qvel + {euler: -ahead, runge: 0.0}.get(kind, ahead) * qacc
    implicit = 2.0 * ahead * model.dof_damping * (kind == euler)
    data, outputs = mujoco.MjData(free), list(free.actuator_outadr)  # of several outputs the first
    needed, given, mass = np.empty((count, nv)), np.empty((count, nv)), np.empty((count, nv, nv))
    friction, gear = np.tile(model.dof_frictionloss, (count, 1)), GearFriction.of(model)
    moment, by = np.zeros((free.nout, nv)), np.zeros((count, free.nactuator, nv))
    for k in range(count):
        if inputs.shape[1]:
            mujoco.mj_setState(free, data, inputs[k], input_spec)
        data.qpos, data.qvel, data.act = qpos[k], qvel[k], act[k]
        drive(data)
        mujoco.mj_forward(free, data)
        given[k] = data.qfrc_smooth - data.qfrc_passive + data.qfrc_bias
        if outputs:
            rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
            mujoco.mju_sparse2dense(moment, data.actuator_moment, *rows)
            by[k] = (moment * data.actuator_force[:, None])[outputs]
        mujoco.mj_fullM(free, data, mass[k])
        if gear is not None:
            motor = data.qfrc_actuator[gear.dofs]
            friction[k, gear.dofs] = gear.bound(
                numbers=model.numeric_data[gear.at],
                dry=model.dof_frictionloss[gear.dofs],
                motor=motor,
                external=(data.qfrc_smooth - data.qfrc_damper)[gear.dofs] - motor,
                speed=data.qvel[gear.dofs],
            )
        needed[k] = mass[k] @ qacc[k] + implicit * qacc[k] + data.qfrc_bias - data.qfrc_passive
    return Shares(needed, given, by, mass, friction)


def apart(model: mujoco.MjModel, qpos: FloatArray) -> BoolArray:
    """At which positions (n, nq) nothing touches and no joint is at an end of its range, shape (n,)."""
    clear = np.ones(len(qpos), dtype=bool)
    for joint in map(int, np.flatnonzero(model.jnt_limited)):
        if int(model.jnt_type[joint]) in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
            low, high = model.jnt_range[joint]
            clear &= (qpos[:, model.jnt_qposadr[joint]] > low) & (qpos[:, model.jnt_qposadr[joint]] < high)
    if collides(model):
        data = mujoco.MjData(model)
        for k, row in enumerate(qpos):
            data.qpos = row
            mujoco.mj_fwdPosition(model, data)
            clear[k] &= not (data.ncon and (data.contact.dist < _NEAR).any())
    return clear


def filters(model: mujoco.MjModel) -> list[tuple[int, float]]:
    """Places in the activations, and time constants, of commands that act through a filter of first order."""
    kinds = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    rows = [row for row in range(model.nactuator) if int(model.actuator_dyntype[row]) in kinds]
    return [(int(model.actuator_actadr[r]), max(float(model.actuator_dynprm[r, 0]), 1e-9)) for r in rows]
