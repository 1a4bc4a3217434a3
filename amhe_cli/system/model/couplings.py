"""Joints that follow another one: mimic joints of a URDF, `<equality><joint>` of an MJCF."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.polynomial import Polynomial

from amhe_cli.core.arrays import FloatArray


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
        model: The model.
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
