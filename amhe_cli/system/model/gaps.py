"""Backlash and elastic drives: a drive and the link that it moves are joints of their own.

The drive is a rotor on the link's parent, with a joint on the axis of the link's. Between the two is a tendon
whose length is the drive's position less the link's. Of a gap it holds the two within half the gap of each
other; of an elastic drive it is a spring. Nothing else holds them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.model.files import compiled

#: Mass [kg] and inertia [kg m^2] of a rotor, which MuJoCo demands; the armature is its real inertia.
_ROTOR = 1e-6
#: Inertia of a drive that has no armature, as a share of the link's.
_ARMATURE = 0.1
#: Time constant of the stops of a gap, in time steps: as hard as these allow.
_STOP_STEPS = 2.0
#: Impedance of the stops of a gap.
_STOP_IMPEDANCE = (0.99, 0.999, 0.001, 0.5, 2.0)
#: Damping of an elastic drive against its link, as a share of the critical one.
_ELASTIC_DAMPING = 0.03
#: Acceleration of a link that bends an elastic drive by what is unknown of it at first [rad/s^2 or m/s^2].
_SHAKEN = 10.0
#: A load [N m or N] below this leaves the drive in the middle of the gap.
_NO_LOAD = 1e-6


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap or spring between two joints: rows of the drive's joint, the link's, and their tendon."""

    drive: int
    link: int
    tendon: int

    @property
    def ends(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Each of the two joints with the other one."""
        return (self.drive, self.link), (self.link, self.drive)

    def ahead(self, model: mujoco.MjModel, torque: float) -> float:
        """How far the drive is ahead of a link that it holds with this torque."""
        if stiffness := float(model.tendon_stiffness[self.tendon]):
            return torque / stiffness
        half = 0.5 * float(np.ptp(model.tendon_range[self.tendon]))
        return half * float(np.sign(torque)) * (abs(torque) > _NO_LOAD)

    def slack(self, model: mujoco.MjModel) -> float:
        """How far the drive may be from where it is put [rad or m]."""
        torque = _SHAKEN * float(model.dof_M0[model.jnt_dofadr[self.link]])
        return abs(self.ahead(model, torque))


def gaps(model: mujoco.MjModel) -> list[Gap]:
    """Gaps of a model: limited or stiff tendons whose length is one joint's position less another's."""
    found_gaps = []
    for tendon in np.flatnonzero((model.tendon_limited != 0) | (model.tendon_stiffness > 0.0)):
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        wraps = slice(first, first + count)
        fixed = (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all()
        if fixed and list(model.wrap_prm[wraps]) in ([1.0, -1.0], [-1.0, 1.0]):
            drive, link = model.wrap_objid[wraps][np.argsort(-model.wrap_prm[wraps])]
            found_gaps.append(Gap(int(drive), int(link), int(tendon)))
    return found_gaps


def add_gaps(spec: mujoco.MjSpec, sizes: Mapping[str, float], elastic: bool = False) -> dict[str, str]:
    """Put gaps or springs between joints and actuators; armature, friction and damping go to the drive.

    Args:
        spec: The model's source, which is changed.
        sizes: Hinge or slide joint -> free motion between the stops of its gap [rad or m], or the stiffness
            of its drive [N m/rad or N/m].
        elastic: They are stiffnesses.

    Returns:
        Joint -> the joint of its drive.

    Raises:
        ConfigError: A joint shares its body with others: its drive would have no place.
    """
    model = compiled(spec)
    keys = [(key, np.array(key.qpos), np.array(key.qvel)) for key in spec.keys]
    drives = {joint: _add_gap(spec, model, joint, size, elastic) for joint, size in sizes.items()}
    for key, _, _ in keys:
        key.qpos, key.qvel = [], []
    wide = compiled(spec) if keys else model
    links = {drive: model.joint(joint).id for joint, drive in drives.items()}
    old = iter(range(model.njnt))  # the model's own joints keep their order
    names = [wide.joint(row).name for row in range(wide.njnt)]
    rows = [links[name] if name in links else next(old) for name in names] if keys else []
    for key, qpos, qvel in keys:
        for attribute, values, starts in (("qpos", qpos, "jnt_qposadr"), ("qvel", qvel, "jnt_dofadr")):
            parts = np.split(values, getattr(model, starts)[1:]) if values.size else []
            setattr(key, attribute, np.concatenate([parts[row] for row in rows]) if parts else [])
    return drives


def _add_gap(spec: mujoco.MjSpec, model: mujoco.MjModel, joint: str, size: float, elastic: bool) -> str:
    """Put one gap or spring; `model` is the source as it was before. The name of the drive's joint."""
    link, row = spec.joint(joint), model.joint(joint).id
    body, drive = link.parent, f"{joint}_drive"
    if len(body.joints) > 1:
        others = ", ".join(beside.name or "unnamed" for beside in body.joints if beside.name != joint)
        raise ConfigError(f"joint {joint!r} shares its body with {others}: give each a body of its own")
    at, dof = int(model.jnt_bodyid[row]), int(model.jnt_dofadr[row])
    rotor = body.parent.add_body(name=drive, pos=model.body_pos[at], quat=model.body_quat[at])
    rotor.explicitinertial, rotor.ipos = True, np.zeros(3)
    rotor.mass, rotor.inertia = _ROTOR, [_ROTOR] * 3
    rotor.add_joint(
        name=drive,
        type=link.type,
        axis=model.jnt_axis[row],
        pos=model.jnt_pos[row],
        ref=link.ref,
        springref=link.ref,
        limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        damping=[model.dof_damping[dof], *model.dof_dampingpoly[dof]],
        frictionloss=model.dof_frictionloss[dof],
        armature=model.dof_armature[dof] or _ARMATURE * model.dof_M0[dof],
    )
    link.damping, link.frictionloss, link.armature = np.zeros_like(link.damping), 0.0, 0.0
    tendon = spec.add_tendon(name=f"{joint}_{'elastic' if elastic else 'backlash'}")
    if elastic:
        tendon.stiffness[0], tendon.springlength = size, [0.0, 0.0]
        tendon.damping[0] = 2.0 * _ELASTIC_DAMPING * float(np.sqrt(size * model.dof_M0[dof]))
    else:
        tendon.limited, tendon.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-0.5 * size, 0.5 * size]
        tendon.solref_limit = [_STOP_STEPS * model.opt.timestep, 1.0]
        tendon.solimp_limit = _STOP_IMPEDANCE
    tendon.wrap_joint(drive, 1.0)
    tendon.wrap_joint(joint, -1.0)
    at_joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for actuator in spec.actuators:
        if actuator.target == joint and actuator.trntype in at_joint:
            actuator.target = drive
            if actuator.inheritrange:  # from the joint, whose range the drive does not have
                actuator.ctrlrange = model.actuator_ctrlrange[model.actuator_ctrladr[actuator.id]]
                actuator.inheritrange = 0.0
    return drive


def loose_ends(
    model: mujoco.MjModel, among: Sequence[Gap], measured: Collection[int]
) -> list[tuple[Gap, int, int]]:
    """Gaps of which one joint is measured and one is not: the gap, that joint's row, the measured one's.

    Args:
        among: Gaps of the model.
        measured: Columns of qpos that are measured.
    """
    return [
        (gap, joint, other)
        for gap in among
        for joint, other in gap.ends
        if model.jnt_qposadr[other] in measured and model.jnt_qposadr[joint] not in measured
    ]


def set_gaps(model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, measured: Collection[int]) -> None:
    """Put what a gap leaves unmeasured beside its partner, at the stop that carries the load, in place.

    Args:
        qpos, qvel: Positions (c, nq) and velocities (c, nv) of c states.
        measured: Columns of qpos that were measured.
    """
    loose = loose_ends(model, gaps(model), measured)
    if not loose:
        return
    data = mujoco.MjData(model)
    for _, joint, other in loose:
        qpos[:, model.jnt_qposadr[joint]] = qpos[:, model.jnt_qposadr[other]]
        qvel[:, model.jnt_dofadr[joint]] = qvel[:, model.jnt_dofadr[other]]
    for state, rates in zip(qpos, qvel, strict=True):
        data.qpos[:], data.qvel[:] = state, rates
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        load = data.qfrc_bias - data.qfrc_passive
        for gap, joint, _ in loose:
            ahead = gap.ahead(model, float(load[model.jnt_dofadr[gap.link]]))
            state[model.jnt_qposadr[joint]] += ahead if joint == gap.drive else -ahead
