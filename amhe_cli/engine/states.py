"""States of a model: steps on their manifold, and the home state.

The tangent space of a quaternion has three coordinates, not four.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray

#: Distance from which geoms count as far apart [m].
_FAR = 100.0
#: Surfaces that are nearer [m] may touch.
_NEAR = 0.003


def integrated(model: mujoco.MjModel, qpos: FloatArray, delta: FloatArray) -> FloatArray:
    """Positions moved by steps in the tangent space, as `mj_integratePos` moves them.

    Args:
        qpos: Positions, shape (..., nq).
        delta: Steps, shape (..., nv); rotations of free and ball joints are in the body's own frame.

    Returns:
        Moved positions, shape (..., nq).
    """
    moved = np.array(np.broadcast_to(qpos, (*delta.shape[:-1], model.nq)))
    for joint in range(model.njnt):
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        kind = mujoco.mjtJoint(model.jnt_type[joint])  # in a tuple, numpy integers do not equal enums
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            moved[..., q : q + 3] += delta[..., v : v + 3]
            q, v = q + 3, v + 3
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            turn = rotations.exp(delta[..., v : v + 3])
            moved[..., q : q + 4] = rotations.multiply(moved[..., q : q + 4], turn)
        else:
            moved[..., q] += delta[..., v]
    return moved


def home(model: mujoco.MjModel, keyframe: int | None, input_spec: int) -> tuple[FloatArray, FloatArray]:
    """State and inputs of everything that no signal gives: qpos, shape (nq,), and inputs, shape (nu,).

    Args:
        keyframe: Number of the keyframe that holds them; None: the model's own default.
        input_spec: mjtState bits of the input vector.
    """
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    inputs = np.empty(mujoco.mj_stateSize(model, input_spec))
    mujoco.mj_getState(model, data, inputs, input_spec)
    return np.array(data.qpos), inputs


def controls(model: mujoco.MjModel, input_spec: int) -> slice | None:
    """Where the controls are in the engine's input vector; None where they are no inputs."""
    bit = int(mujoco.mjtState.mjSTATE_CTRL)
    first = mujoco.mj_stateSize(model, input_spec & (bit - 1))
    return slice(first, first + model.nu) if input_spec & bit else None


def in_state(model: mujoco.MjModel, input_spec: int) -> IntArray:
    """Where the input vector is in a simulation's whole state, as `mujoco.batch` has it, shape (nu,)."""
    whole, found = int(mujoco.mjtState.mjSTATE_INTEGRATION), [np.empty(0, dtype=np.int64)]
    for bit in (1 << i for i in range(input_spec.bit_length()) if input_spec >> i & 1):
        first = mujoco.mj_stateSize(model, whole & (bit - 1))
        found.append(first + np.arange(mujoco.mj_stateSize(model, bit)))
    return np.concatenate(found)


def first_activations(model: mujoco.MjModel, qpos: FloatArray, controls: FloatArray) -> FloatArray:
    """Activations of actuators that have followed their first commands for long, shape (n, na).

    No log has them. A filter or a limited slew starts at the command, an integrated velocity at the joint;
    bristles, currents and the integral of a controller start at zero.

    Args:
        qpos: First positions, shape (n, nq).
        controls: First controls, shape (n, nu).
    """
    act = np.zeros((len(qpos), model.na))
    for row in map(int, np.flatnonzero(model.actuator_actnum)):
        at, ctrl = int(model.actuator_actadr[row]), int(model.actuator_ctrladr[row])
        kind, joint = mujoco.mjtDyn(model.actuator_dyntype[row]), int(model.actuator_trnid[row, 0])
        command = controls[:, ctrl]
        if model.actuator_ctrllimited[ctrl]:
            command = np.clip(command, *model.actuator_ctrlrange[ctrl])
        if kind in (mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT) or _slews(model, row):
            act[:, at] = command
        elif (
            kind == mujoco.mjtDyn.mjDYN_INTEGRATOR
            and model.actuator_trntype[row] == mujoco.mjtTrn.mjTRN_JOINT
        ):
            gear = float(model.actuator_gear[model.actuator_outadr[row], 0])
            act[:, at] = gear * qpos[:, model.jnt_qposadr[joint]]
    return act


def _slews(model: mujoco.MjModel, row: int) -> bool:
    """Whether an actuator's first activation is a position command that changes at a limited rate."""
    column = {mujoco.mjtDyn.mjDYN_PID: 1, mujoco.mjtDyn.mjDYN_DCMOTOR: 7}
    kind = mujoco.mjtDyn(model.actuator_dyntype[row])
    position = int(model.actuator_ctrlspec[row]) & int(mujoco.mjtCtrlInput.mjINPUT_POS)
    return kind in column and bool(position and model.actuator_dynprm[row, column[kind]])


def collides(model: mujoco.MjModel) -> bool:
    """Whether any two shapes of a model can collide."""
    return bool(model.npair > 0 or (model.geom_contype.any() and model.geom_conaffinity.any()))


def without_contacts(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model; where nothing in it can collide, a copy that does not look for contacts: that takes time."""
    if collides(model):
        return model
    changed = copy.copy(model)
    changed.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return changed


def filters(model: mujoco.MjModel) -> list[tuple[int, int, float]]:
    """Activations, commands and time constants, where commands act through a filter of first order."""
    kinds = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
    rows = [row for row in range(model.nactuator) if int(model.actuator_dyntype[row]) in kinds]
    places = [(int(model.actuator_actadr[row]), int(model.actuator_ctrladr[row])) for row in rows]
    return [(*at, max(float(model.actuator_dynprm[r, 0]), 1e-9)) for r, at in zip(rows, places, strict=True)]


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


def touching(model: mujoco.MjModel, qpos: FloatArray) -> bool:
    """Whether anything touches, or a joint or tendon is at a limit of its range, at positions (n, nq)."""
    data = mujoco.MjData(model)
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_fwdPosition(model, data)
        if (data.efc_type >= int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)).any():
            return True
    return False


def nearest(
    model: mujoco.MjModel,
    qpos: FloatArray,
    inputs: FloatArray,
    input_spec: int,
    pairs: Sequence[tuple[int, int]],
) -> tuple[float, tuple[int, int]]:
    """Smallest distance [m] of some pairs of geoms, zero or less where they touch, and the pair that has it.

    Args:
        qpos, inputs: Positions (n, nq), and the inputs there (n, nu): they may move mocap bodies.
        input_spec: mjtState bits of the inputs.
        pairs: The pairs, by rows of geoms.
    """
    data, best = mujoco.MjData(model), (_FAR, pairs[0])
    for row, driven in zip(qpos, inputs, strict=True):
        mujoco.mj_setState(model, data, np.ascontiguousarray(driven), input_spec)
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for pair in pairs:
            distance = mujoco.mj_geomDistance(model, data, *pair, best[0], None)
            if distance < best[0]:
                best = distance, pair
        if best[0] <= 0.0:
            return best
    return best


def contact_forces(model: mujoco.MjModel, data: mujoco.MjData) -> FloatArray:
    """Sum of the contact forces between each two touching bodies, shape (m, 6).

    Args:
        data: Its state after `mj_forward` or a step.

    Returns:
        Where the force acts [m], the mean of the contacts weighted by their normal forces, and the force on
        the second body of the two [N], both in the world. The world itself is always the first.
    """
    sums: dict[tuple[int, int], FloatArray] = {}
    wrench = np.empty(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        if min(contact.geom) < 0:  # of a flexible body
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        first, second = (int(model.geom_bodyid[g]) for g in contact.geom)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second; the normal points to it
        pair, sign = ((first, second), 1.0) if first <= second else ((second, first), -1.0)
        row = sums.setdefault(pair, np.zeros(7))
        row += np.concatenate((wrench[0] * contact.pos, sign * force, wrench[:1]))
    return np.array([[*(row[:3] / row[6]), *row[3:6]] for row in sums.values() if row[6] > 0.0]).reshape(
        -1, 6
    )
