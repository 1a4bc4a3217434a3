"""Elements of a MuJoCo model by name, what an actuator is, and which joints follow others."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np
from numpy.polynomial import Polynomial

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, one_of

#: Kind of element -> MuJoCo's number of the kind, and the field of MjModel with their number.
_KINDS = {
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "pair": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
    "joint": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nactuator"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "sensor": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "keyframe": (mujoco.mjtObj.mjOBJ_KEY, "nkey"),
}
#: Kinds of actuators whose controls have quantities.
_CONTROLLERS = (int(mujoco.mjtGain.mjGAIN_PID), int(mujoco.mjtGain.mjGAIN_DCMOTOR))
#: Bit of `actuator_ctrlspec` -> the quantity of that control.
_INPUTS = {
    mujoco.mjtCtrlInput.mjINPUT_POS: "position",
    mujoco.mjtCtrlInput.mjINPUT_VEL: "velocity",
    mujoco.mjtCtrlInput.mjINPUT_FF: "effort",
}


def names_of(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind, without the unnamed ones."""
    number, count = _KINDS[kind]
    names = (mujoco.mj_id2name(model, number, i) for i in range(getattr(model, count)))
    return [name for name in names if name and not name.startswith("amhe/")]


def id_of(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Row of a named element.

    Raises:
        ConfigError: There is none; the text lists those there are.
    """
    row = mujoco.mj_name2id(model, _KINDS[kind][0], name)
    if row < 0:
        raise ConfigError(one_of(kind, name, names_of(model, kind)))
    return row


def matching_rows(model: mujoco.MjModel, kind: str, pattern: str) -> list[int]:
    """Rows of the elements that a name or a glob such as 'foot_*' means."""
    names = names_of(model, kind)
    if pattern in names or not any(sign in pattern for sign in "*?["):
        return [id_of(model, kind, pattern)]
    rows = [id_of(model, kind, name) for name in names if fnmatchcase(name, pattern)]
    if not rows:
        raise ConfigError(one_of(f"{kind} that matches", pattern, names))
    return rows


def single_joints(model: mujoco.MjModel, names: Iterable[str]) -> list[int]:
    """Rows of hinge and slide joints."""
    rows = [id_of(model, "joint", name) for name in names]
    for row in rows:
        if int(model.jnt_type[row]) in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            body = model.body(model.jnt_bodyid[row]).name
            raise ConfigError(
                f"joint {model.joint(row).name!r} has no single position; only hinge and slide joints do. "
                f"Measure its body instead: body: {body}"
            )
    return rows


def joint_of(model: mujoco.MjModel, column: int) -> str:
    """Name of the joint that a column of qpos belongs to."""
    return model.joint(int((model.jnt_qposadr == column).nonzero()[0][0])).name


def driven_joint(model: mujoco.MjModel, actuator: int) -> str | None:
    """Name of the joint that an actuator drives; None where it drives something else, or a nameless one."""
    at_joint = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
    if int(model.actuator_trntype[actuator]) not in at_joint:
        return None
    return model.joint(int(model.actuator_trnid[actuator, 0])).name or None


def heaviest_part(model: mujoco.MjModel, body: int) -> int:
    """The heaviest of the bodies that are welded to one: a body of a URDF may be an empty frame."""
    parts = np.flatnonzero(model.body_weldid == model.body_weldid[body])
    return int(parts[np.argmax(model.body_mass[parts])])


def axis_in(model: mujoco.MjModel, joint: int, body: int) -> FloatArray:
    """A joint's axis in the frame of a body that is fixed to the joint's own, shape (3,)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.asarray(data.xmat[body].reshape(3, 3).T @ data.xaxis[joint])


def commanded(model: mujoco.MjModel, row: int) -> str:
    """What an actuator's control is: a servo's target, or a motor's effort, also that of its voltage."""
    if inputs := inputs_of(model, row):
        return inputs[0]
    bias, gain = model.actuator_biasprm[row], model.actuator_gainprm[row, 0]
    if int(model.actuator_biastype[row]) == mujoco.mjtBias.mjBIAS_AFFINE:
        if bias[1]:
            return "position"
        if abs(gain + bias[2]) < 1e-6 * abs(gain):  # no force at the speed that is commanded
            return "velocity"
    return "effort"


def holds_position(model: mujoco.MjModel, row: int) -> bool:
    """Whether an actuator is a servo that gives its gain times command less position."""
    gain, bias = model.actuator_gainprm[row, 0], model.actuator_biasprm[row, 1]
    fixed = int(model.actuator_gaintype[row]) == mujoco.mjtGain.mjGAIN_FIXED
    return fixed and bool(gain and np.isclose(bias, -gain)) and commanded(model, row) == "position"


def inputs_of(model: mujoco.MjModel, row: int) -> list[str]:
    """Quantities that a <pid>, or the controller of a <dcmotor>, takes, in the order of its controls."""
    if int(model.actuator_gaintype[row]) not in _CONTROLLERS:
        return []
    return [quantity for bit, quantity in _INPUTS.items() if int(model.actuator_ctrlspec[row]) & int(bit)]


def control_of(model: mujoco.MjModel, row: int, quantity: str) -> int:
    """Address of an actuator's control; where it has several, as a <pid> has, of the one for a quantity.

    The numbers of an array, of the quantity `value`, are for the first.

    Raises:
        ConfigError: It has several, and none for this quantity.
    """
    first = int(model.actuator_ctrladr[row])
    if model.actuator_ctrlnum[row] == 1:
        return first
    inputs, name = inputs_of(model, row), model.actuator(row).name
    if not inputs:
        raise ConfigError(f"actuator {name!r} takes several controls, not one")
    if quantity == "value":
        return first
    if quantity not in inputs:
        raise ConfigError(one_of(f"quantity that actuator {name!r} takes", quantity, inputs))
    return first + inputs.index(quantity)


@dataclass(frozen=True, slots=True)
class Dof:
    """One degree of freedom of a model.

    Args:
        name: Name of its joint; of a free body, or of a ball joint, with the axis: 'box x', 'box roll'.
        kind: Of a hinge or slide that; 'linear' and 'angular' are those of free bodies and ball joints.
        place: Column of qpos, of hinges and slides; else -1.
        joint: Row of its joint.
    """

    name: str
    kind: str
    place: int
    joint: int

    @property
    def turns(self) -> bool:
        """Whether it is an angle, and its force a torque."""
        return self.kind in ("hinge", "angular")


def dofs_of(model: mujoco.MjModel) -> list[Dof]:
    """All degrees of freedom of a model, in its order."""
    found: list[Dof] = []
    for row in range(model.njnt):
        kind, name = mujoco.mjtJoint(model.jnt_type[row]), model.joint(row).name or f"joint {row}"
        body = model.body(model.jnt_bodyid[row]).name or name
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            found += [Dof(f"{body} {axis}", "linear", -1, row) for axis in "xyz"]
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            found += [Dof(f"{body} {axis}", "angular", -1, row) for axis in ("roll", "pitch", "yaw")]
        else:
            single = "hinge" if kind == mujoco.mjtJoint.mjJNT_HINGE else "slide"
            found.append(Dof(name, single, int(model.jnt_qposadr[row]), row))
    return found


@dataclass(frozen=True, slots=True)
class Coupling:
    """A joint whose position is a polynomial of another one's, both counted from the model's own positions.

    Args:
        follower, leader: Rows of hinge or slide joints.
        polynomial: The follower's position as a function of the leader's.
    """

    follower: int
    leader: int
    polynomial: Polynomial


def couplings(model: mujoco.MjModel) -> list[Coupling]:
    """The couplings of a model that are active from the start."""
    joint = int(mujoco.mjtEq.mjEQ_JOINT)
    rows = np.flatnonzero((model.eq_type == joint) & (model.eq_active0 != 0) & (model.eq_obj2id >= 0))
    return [
        Coupling(int(model.eq_obj1id[r]), int(model.eq_obj2id[r]), Polynomial(model.eq_data[r, :5]))
        for r in rows
    ]


def followers(model: mujoco.MjModel) -> dict[str, str]:
    """Name of each joint that follows another -> name of that one."""
    return {model.joint(c.follower).name: model.joint(c.leader).name for c in couplings(model)}


def floats(model: mujoco.MjModel, joint: int) -> bool:
    """Whether a joint hangs on a body that nothing holds: the root of its tree has a free joint."""
    first = int(model.body_jntadr[model.body_rootid[model.jnt_bodyid[joint]]])
    return first >= 0 and int(model.jnt_type[first]) == mujoco.mjtJoint.mjJNT_FREE


def set_followers(
    model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, measured: Collection[int]
) -> None:
    """Put followers that are not measured where their measured leaders demand it, in place.

    Args:
        qpos, qvel: Positions (c, nq) and velocities (c, nv) of c states.
        measured: Columns of qpos that were measured.
    """
    for coupling in couplings(model):
        rows = [coupling.follower, coupling.leader]
        (own, other), (own_dof, other_dof) = model.jnt_qposadr[rows], model.jnt_dofadr[rows]
        if other in measured and own not in measured:
            away = qpos[:, other] - model.qpos0[other]
            qpos[:, own] = model.qpos0[own] + coupling.polynomial(away)
            qvel[:, own_dof] = coupling.polynomial.deriv()(away) * qvel[:, other_dof]
