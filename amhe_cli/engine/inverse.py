"""The model run backwards: the forces that a motion needs, and those that act along it."""

from __future__ import annotations

import copy
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.rollout import Along, Predicted, Rollouts, Starts, Wanted
from amhe_cli.engine.states import controls, first_activations
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.inertia import rotation_matrix
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.parameters.servos import with_servos

#: Inertia of a body: efforts are linear in its mass, first moments and moments about the body's origin.
_INERTIA = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
#: Numbers of a joint that efforts are linear in.
_JOINT = ("dof_armature", "dof_damping", "dof_dampingpoly", "jnt_stiffness", "dof_frictionloss")
#: All that efforts are linear in, an inertia as a whole: its mass and moments about the body's origin.
_LINEAR = frozenset((*_INERTIA, *_JOINT))
#: Fields that no effort depends on, by their beginning; those of actuators matter only where inputs act.
_IDLE = ("geom_", "pair_", "tendon_range", "jnt_range", "jnt_actfrc", "dof_sol", "jnt_sol", "numeric_")
#: Step of finite differences.
_NEAR = 1e-6
#: Tables are kept for further calls as long as they have fewer bytes together.
_KEPT_BYTES = 256 * 2**20


def linear_in(edits: ModelEdits) -> bool:
    """Whether efforts along a motion are linear in all that edits write, so that they have one minimum.

    They are quadratic in a centre of mass that is free without its body's moments, and bend with the axes.
    """
    alone = {cells.field for _, written in edits.by_parameter() for cells in written}
    return _LINEAR.issuperset(edits.fields) and not alone & {"body_ipos", "body_iquat"}


@dataclass(frozen=True, slots=True, eq=False)
class Forces:
    """Generalised forces at T instants of a motion [N or N m], shape (T, nv) where nothing else is said.

    Args:
        needed: What the motion needs beside springs, dampers and gravity compensation, M a + c + g - passive.
            Dry friction, contacts, limits and equalities are not in it.
        given: What actuators and applied forces give.
        by: What each actuator gives, shape (T, actuators, nv).
        friction: Size of the dry friction, which has no part in the others.
        mass: The mass matrix, shape (T, nv, nv).
    """

    needed: FloatArray
    given: FloatArray
    by: FloatArray
    friction: FloatArray
    mass: FloatArray

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
    act: FloatArray | None = None,
) -> Forces:
    """Forces along a motion; a state and an instant are about 10 microseconds for an arm.

    Args:
        model: The model, its parameters written into it (`ModelEdits.apply`).
        qpos, qvel, qacc: The motion, shape (T, nq), (T, nv) and (T, nv).
        inputs: Inputs at the same instants, shape (T, nu); None: nothing is given.
        input_spec: mjtState bits of the inputs.
        act: Activations of actuators, shape (T, na); None: they have followed their commands for long.
    """
    (count, nv), at = qvel.shape, controls(model, input_spec)
    if act is None and inputs is not None and model.na and at is not None:
        act = first_activations(model, qpos, inputs[:, at])
    ctrl = np.zeros((count, model.nu)) if inputs is None or at is None else inputs[:, at]
    states = np.zeros((count, model.na)) if act is None else act
    free, drive = with_servos(unconstrained(model), qpos, qvel, ctrl, states)
    data, gear = mujoco.MjData(free), GearFriction.of(model)
    pushed = bool(input_spec & int(mujoco.mjtState.mjSTATE_XFRC_APPLIED))
    moment, mass = np.zeros((count, free.nout, nv)), np.empty((count, nv, nv))
    needed, given, force = np.empty((count, nv)), np.zeros((count, nv)), np.zeros((count, free.nout))
    friction, motor, smooth = np.tile(model.dof_frictionloss, (count, 1)), *np.zeros((2, count, nv))
    # fields of data are views of it: to make them at each instant would take as long as the mechanics
    position, speed, acceleration, activation = data.qpos, data.qvel, data.qacc, data.act
    inverse, driven, applied, pushes = (
        data.qfrc_inverse,
        data.qfrc_actuator,
        data.qfrc_applied,
        data.xfrc_applied,
    )
    sparse = data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    forces, rest = data.actuator_force, (data.qfrc_passive, data.qfrc_bias, data.qfrc_damper)
    for k in range(count):
        if inputs is not None and inputs.shape[1]:
            mujoco.mj_setState(free, data, inputs[k], input_spec)
        position[:], speed[:], acceleration[:] = qpos[k], qvel[k], qacc[k]
        mujoco.mj_inverse(free, data)
        needed[k] = inverse
        mujoco.mj_fullM(free, data, mass[k])
        if inputs is None:
            continue
        if act is not None:
            activation[:] = act[k]
        drive(k)
        mujoco.mj_fwdActuation(free, data)
        given[k] = driven + applied
        for body in np.flatnonzero(pushes.any(axis=1)) if pushed else ():
            push, torque = np.split(pushes[body], 2)
            mujoco.mj_applyFT(free, data, push, torque, data.xipos[body], body, given[k])
        if free.nout:
            mujoco.mju_sparse2dense(moment[k], *sparse)
            force[k] = forces
        if gear is not None:
            motor[k], smooth[k] = driven, rest[0] - rest[1] - rest[2]
    by = moment[:, free.actuator_outadr] * force[:, free.actuator_outadr, None]  # the first of several
    if gear is not None and inputs is not None:
        own, dofs = motor[:, gear.dofs], gear.dofs
        bound = gear.law(model.numeric_data[gear.at][None], model.dof_frictionloss[None, dofs])
        friction[:, dofs] = bound(own, smooth[:, dofs] + given[:, dofs] - own, qvel[:, dofs])
    return Forces(needed, given, by, friction, mass)


def forces_as_stepped(
    model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, qacc: FloatArray, *driven: Any
) -> Forces:
    """`forces_along` as a rollout computes them.

    Its speed is half a time step old (Euler), or half a step ahead (implicit); Euler's joint damping is
    implicit.
    """
    kind, ahead = int(model.opt.integrator), 0.5 * model.opt.timestep
    euler, runge = int(mujoco.mjtIntegrator.mjINT_EULER), int(mujoco.mjtIntegrator.mjINT_RK4)
    speed = qvel + {euler: -ahead, runge: 0.0}.get(kind, ahead) * qacc
    found = forces_along(model, qpos, speed, qacc, *driven)
    implicit = 2.0 * ahead * model.dof_damping * (kind == euler)
    return replace(found, needed=found.needed + implicit * qacc)


def unconstrained(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model without dry friction, contacts, limits and equalities."""
    free = copy.copy(model)
    free.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    free.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
    return free


def effort_variance(
    model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, qacc: FloatArray, sd: FloatArray
) -> FloatArray:
    """Variance of the efforts along a motion that errors of the motion make, shape (T, nv).

    Args:
        qpos, qvel, qacc: The motion, as in `forces_along`.
        sd: Sd of the errors of positions, velocities and accelerations, shape (3, nv).
    """
    free, nv = unconstrained(model), model.nv
    data, slopes = mujoco.MjData(free), np.empty((3, nv, nv))
    variance = np.empty((len(qpos), nv))
    for k in range(len(qpos)):
        data.qpos, data.qvel, data.qacc = qpos[k], qvel[k], qacc[k]
        mujoco.mj_inverse(free, data)
        mujoco.mjd_inverseFD(free, data, _NEAR, False, *slopes, None, None, None, None)
        variance[k] = np.einsum("kji,kj->i", slopes**2, sd**2)  # row j is the slope by coordinate j
    return variance


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Efforts along the motion of one clip, as linear functions of what they are linear in.

    Args:
        bodies: Slopes by the ten numbers of each of some bodies, shape (s, nv, 10 b).
        joints: Slopes by the numbers of each joint, which act on it alone, shape (6, s, nv).
        rest: Efforts where all of these are zero, shape (s, nv).
    """

    bodies: FloatArray
    joints: FloatArray
    rest: FloatArray


class InverseEngine:
    """An engine that follows the measured motion and predicts the joints' efforts: nothing is integrated.

    Efforts are linear in inertias, armature, damping, stiffness and dry friction (Atkeson, An and Hollerbach
    1986, "Estimation of inertial parameters of manipulator loads and links"). So a clip's motion becomes a
    table once, and a candidate costs one product. What moves the model's shape is computed by `mj_inverse`.
    Dry friction opposes the measured velocity: MuJoCo's own depends on accelerations that noise has. Friction
    of gears that grows with load or at rest follows from the efforts without it.

    Args:
        model: The model to run.
        edits: How parameters are written into it.
        input_spec: mjtState bits of the input vector.
    """

    precision, device_bytes = float(np.finfo(np.float64).eps), 0

    def __init__(self, model: mujoco.MjModel, edits: ModelEdits, input_spec: int) -> None:
        self._model, self._edits, self._input_spec = _without_actuators(model), edits, input_spec
        rows = {cells.row for cells in edits.cells if cells.field in _INERTIA}
        self._bodies = sorted(rows)
        self._joint = np.array(model.dof_jntid)
        self._gear = edits.gear_friction
        self._tables: dict[Hashable, _Table] = {}
        self._bytes = 0

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """Not of this engine: it follows a motion.

        Raises:
            SimulationError: Always.
        """
        raise SimulationError("where efforts are matched, nothing is rolled out; use match: motion for this")

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`; there are no first states."""
        along = starts.along
        assert along is not None, "the clips have a measured motion"
        efforts = self._efforts(theta, along)
        if self._gear is not None:
            efforts[..., self._gear.dofs] += self._beyond_dry(self._gear, theta, along, efforts)
        completed: BoolArray = np.asarray(np.isfinite(efforts).all(axis=(2, 3)))
        efforts[~completed] = 0.0
        return Predicted(tuple(one.picked(efforts) for one in wanted), completed)

    def _efforts(self, theta: FloatArray, along: Along) -> FloatArray:
        """Efforts (p, c, s, nv) with dry friction that does not grow."""
        fields = self._edits.written(theta)
        shaped = self._reshaped(fields, len(theta), along)
        efforts = np.empty((len(theta), *along.qvel.shape))
        if not shaped.any():
            efforts = self._linear(fields, len(theta), along)
        elif not shaped.all():
            own = {name: values[~shaped] for name, values in fields.items()}
            efforts[~shaped] = self._linear(own, int((~shaped).sum()), along)
        for row in np.flatnonzero(shaped):
            model = self._edits.apply(self._model, theta[row])
            efforts[row] = self._along(model, along) + model.dof_frictionloss * along.dry
        return efforts

    def _beyond_dry(
        self, gear: GearFriction, theta: FloatArray, along: Along, efforts: FloatArray
    ) -> FloatArray:
        """What friction of gears takes beside `efforts` (p, c, s, nv), shape (p, c, s, g).

        The effort is the motor's, friction included, which grows with it: three turns settle that.
        """
        shape = efforts.shape[:3]
        slow = replace(
            along, qacc=0.0 * along.qacc, dry=0.0 * along.dry, keys=tuple((key, "slow") for key in along.keys)
        )
        fields = self._edits.written(theta)

        def of(name: str, at: IntArray) -> FloatArray:
            values = fields[name] if name in fields else getattr(self._model, name)[None]
            return np.broadcast_to(values[:, None, None][..., at], (*shape, *at.shape))

        viscous, dry = (of(name, gear.dofs) for name in ("dof_damping", "dof_frictionloss"))
        numbers, speed = of("numeric_data", gear.at), along.qvel[..., gear.dofs]
        external = viscous * speed - self._efforts(theta, slow)[..., gear.dofs]
        way, motor = along.dry[..., gear.dofs], efforts[..., gear.dofs]
        bound, found = gear.law(numbers, dry), np.zeros(external.shape)
        for _ in range(3):
            found = way * (bound(motor + found, external, speed) - dry)
        return found

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> InverseEngine:
        """See `Engine.upon`."""
        return InverseEngine(model, edits or self._edits.upon(model), self._input_spec)

    def _reshaped(self, fields: Mapping[str, FloatArray], count: int, along: Along) -> BoolArray:
        """Candidates that move what efforts are not linear in, shape (p,)."""
        changed = np.zeros(count, dtype=bool)
        idle = (*_IDLE, *(("actuator_",) if along.inputs is None else ()))
        for name, values in fields.items():
            if name not in (*_INERTIA, *_JOINT) and not name.startswith(idle):
                changed |= (values != getattr(self._model, name)).reshape(count, -1).any(axis=1)
        return changed

    def _linear(self, fields: Mapping[str, FloatArray], count: int, along: Along) -> FloatArray:
        """Efforts (p, c, s, nv) of p candidates that differ in inertias and numbers of joints only."""
        missing = [i for i, key in enumerate(along.keys) if key not in self._tables]
        if missing:
            self._add(along.of(np.array(missing)))
        tables = [self._tables[key] for key in along.keys]
        bodies, joints = self._numbers(fields, count)
        c, s, nv = along.qvel.shape
        efforts = np.zeros((count, c, s, nv))
        for i, table in enumerate(tables):
            of = efforts[:, i, : len(table.rest)]  # a clip may be padded by more instants than its table
            of += (table.rest + np.einsum("ksv,pkv->psv", table.joints, joints))[:, :s]
            if self._bodies:
                slopes = table.bodies[:s].reshape(of.shape[1] * nv, -1)
                of += (bodies @ slopes.T).reshape(-1, *of.shape[1:])
        return efforts

    def _numbers(self, fields: Mapping[str, FloatArray], count: int) -> tuple[FloatArray, FloatArray]:
        """What efforts are linear in, of p candidates: of the bodies (p, 10 b), of the joints (p, 6, nv)."""

        def of(name: str) -> FloatArray:
            own = getattr(self._model, name)
            return fields.get(name, np.broadcast_to(own, (count, *own.shape)))

        bodies = inertial_numbers(*(of(name)[:, self._bodies] for name in _INERTIA))
        poly = of("dof_dampingpoly")
        stiffness = of("jnt_stiffness")[:, self._joint]
        rows = of("dof_armature"), of("dof_damping"), poly[..., 0], poly[..., 1], stiffness
        return bodies.reshape(count, -1), np.stack((*rows, of("dof_frictionloss")), axis=1)

    def _along(self, model: mujoco.MjModel, along: Along) -> FloatArray:
        """Efforts (c, s, nv) without dry friction, by `mj_inverse`."""
        c, s, nv = along.qvel.shape
        qpos, qvel, qacc = along.flat
        inputs = None if along.inputs is None else along.inputs.reshape(c * s, -1)
        return forces_along(model, qpos, qvel, qacc, inputs, self._input_spec).missing.reshape(c, s, nv)

    def _add(self, along: Along) -> None:
        """Make the tables of some clips."""
        model, (c, s, nv) = self._model, along.qvel.shape
        bodies = np.zeros((c, s, nv, 10 * len(self._bodies)))
        if self._bodies:
            bodies = body_slopes(model, self._bodies, *along.flat).reshape(c, s, nv, -1)
        spring = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
        spring, at = spring[self._joint], model.jnt_qposadr[self._joint]
        bent = np.where(spring, along.qpos[..., at] - model.qpos_spring[at], 0.0)
        v = along.qvel
        joints = np.stack((along.qacc, v, np.abs(v) * v, v**3, bent, along.dry), axis=1)
        own = self._numbers({}, 1)
        linear = bodies @ own[0][0] + np.einsum("cksv,kv->csv", joints[:, :5], own[1][0, :5])
        rest = self._along(model, along) - linear
        if self._bytes > _KEPT_BYTES:
            self._tables, self._bytes = {}, 0
        for i, key in enumerate(along.keys):
            self._tables[key] = _Table(bodies[i], joints[i], rest[i])
            self._bytes += bodies[i].nbytes + joints[i].nbytes + rest[i].nbytes


def _without_actuators(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy of the model whose own actuators give no force; those that amhe added do."""
    off = copy.copy(model)
    rows = [row for row in range(model.nactuator) if not model.actuator(row).name.startswith("amhe/")]
    off.actuator_gainprm[rows], off.actuator_biasprm[rows] = 0.0, 0.0
    return off


def inertial_numbers(
    mass: FloatArray, centre: FloatArray, axes: FloatArray, moments: FloatArray
) -> FloatArray:
    """What efforts are linear in, of bodies: mass, first moments; xx, yy, zz, xy, xz, yz about the origin.

    Args:
        mass: Shape (...).
        centre: Centre of mass in the body's frame, shape (..., 3).
        axes: Quaternion of the principal axes, shape (..., 4).
        moments: Principal moments about the centre of mass, shape (..., 3).

    Returns:
        Shape (..., 10).
    """
    turn = rotation_matrix(axes)
    about = np.einsum("...ik,...k,...jk->...ij", turn, moments, turn)
    square = (centre**2).sum(axis=-1)[..., None, None] * np.eye(3)
    about += mass[..., None, None] * (square - centre[..., :, None] * centre[..., None, :])
    six = about[..., (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    return np.concatenate((mass[..., None], mass[..., None] * centre, six), axis=-1)


def body_slopes(
    model: mujoco.MjModel, bodies: Sequence[int], qpos: FloatArray, qvel: FloatArray, qacc: FloatArray
) -> FloatArray:
    """Slopes of the efforts along a motion by the ten numbers of bodies, shape (T, nv, 10 b).

    See `inertial_numbers`; the motion is as in `forces_along`.
    """
    data, nv = mujoco.MjData(model), model.nv
    jac, rate = np.zeros((len(qpos), len(bodies), 2, 3, nv)), np.zeros((2, 3, nv))
    turned = np.empty((len(qpos), len(bodies), 3, 3))
    moved = np.empty((len(qpos), len(bodies), 3, 3))  # a - g, omega, alpha
    for k in range(len(qpos)):
        data.qpos, data.qvel = qpos[k], qvel[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        for i, body in enumerate(bodies):
            own = jac[k, i]
            mujoco.mj_jac(model, data, own[0], own[1], data.xpos[body], body)
            mujoco.mj_jacDot(model, data, rate[0], rate[1], data.xpos[body], body)
            linear, turning = own @ qacc[k] + rate @ qvel[k]
            moved[k, i] = linear - model.opt.gravity, own[1] @ qvel[k], turning
            turned[k, i] = data.xmat[body].reshape(3, 3)
    jac = np.einsum("tbij,tbrik->tbrjk", turned, jac)  # in the body's own frame
    a, w, alpha = np.moveaxis(np.einsum("tbij,tbri->tbrj", turned, moved), 2, 0)
    forces = np.zeros((*a.shape[:2], 2, 3, 10))
    spin = _cross(w)
    forces[..., 0, :, 0] = a
    forces[..., 0, :, 1:4] = _cross(alpha) + spin @ spin
    forces[..., 1, :, 1:4] = -_cross(a)
    forces[..., 1, :, 4:] = _six(alpha) + spin @ _six(w)
    slopes = np.einsum("tbriv,tbrin->tvbn", jac, forces, optimize=True)
    return slopes.reshape(len(qpos), nv, -1)


def _cross(v: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of v (..., 3) x."""
    made = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        made[..., i, j], made[..., j, i] = -v[..., k], v[..., k]
    return made


def _six(v: FloatArray) -> FloatArray:
    """Matrices (..., 3, 6) of which a product with xx, yy, zz, xy, xz, yz of an inertia is that times v."""
    x, y, z = np.moveaxis(v, -1, 0)
    made = np.zeros((*v.shape, 6))
    for row, columns in enumerate(((0, 3, 4), (3, 1, 5), (4, 5, 2))):
        for column, value in zip(columns, (x, y, z), strict=True):
            made[..., row, column] = value
    return made
