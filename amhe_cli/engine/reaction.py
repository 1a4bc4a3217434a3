"""What a robot does to the place that carries it, and what a motion of that place does to the robot.

A base that is fixed to the world takes the rate of change of the robot's momentum, and the moment of its
weight. Were the base to give way, the same Jacobian of the momentum would tell how its acceleration acts on
the joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Tangents:
    """How small deviations of a rollout go on, at n of its states.

    Args:
        step: Deviation of (qpos, qvel) after a step, by that before it, shape (n, 2 nv, 2 nv).
        push: Velocity of the joints after a step, by the acceleration of the base, shape (n, nv, 6).
        lean: The same by the angle of the base, whose gravity turns, shape (n, nv, 6).
    """

    step: FloatArray
    push: FloatArray
    lean: FloatArray


def fixed_base(model: mujoco.MjModel) -> bool:
    """Whether all that moves does so by hinges and slides: nothing flies, rolls or stands free."""
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    return model.nv > 0 and bool(np.isin(model.jnt_type, kinds).all())


def momentum(model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Momentum about the world's origin (n, 6), and what gravity adds to its rate of change (n, 6).

    Args:
        model: The model.
        qpos, qvel: States, shape (n, nq) and (n, nv).
    """
    data, trees = mujoco.MjData(model), _Trees(model, (len(qpos),))
    for k, (positions, velocities) in enumerate(zip(qpos, qvel, strict=True)):
        data.qpos[:], data.qvel[:] = positions, velocities
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        trees.note(data, k)
    moment = np.zeros((len(qpos), 6))
    moment[:, 3:] = np.cross(model.opt.gravity, (trees.mass * trees.centre).sum(axis=1))
    return trees.momentum(), moment


def tangents(
    model: mujoco.MjModel, input_spec: int, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray
) -> Tangents:
    """Tangents of the model's steps, and what a motion of its base would do.

    Args:
        model: The model.
        input_spec: mjtState bits of the inputs.
        qpos, qvel, inputs: States (n, nq), (n, nv) and the inputs there (n, nu).
    """
    data, nv, dt = mujoco.MjData(model), model.nv, model.opt.timestep
    trees, masses = _Trees(model, (len(qpos), nv)), np.zeros((len(qpos), nv, nv))
    whole, inertia = np.zeros((2 * nv + model.na,) * 2), np.zeros((nv, nv))
    step = np.zeros((len(qpos), 2 * nv, 2 * nv))
    for k in range(len(qpos)):
        mujoco.mj_setState(model, data, np.ascontiguousarray(inputs[k]), input_spec)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos[k], qvel[k], 0.0
        mujoco.mj_forward(model, data)
        mujoco.mjd_transitionFD(model, data, 1e-6, 0, whole, None, None, None)
        step[k] = whole[: 2 * nv, : 2 * nv]
        mujoco.mj_fullM(model, data, inertia)
        masses[k] = inertia
        for joint in range(nv):
            data.qvel[:] = 0.0
            data.qvel[joint] = 1.0
            trees.note(data, (k, joint))
    jacobian = trees.momentum()  # (n, nv, 6)
    turned = np.cross(model.opt.gravity, np.eye(3)).T  # force on a mass, by the angle of the base
    leaning = np.concatenate((np.zeros_like(jacobian[..., :3]), jacobian[..., :3] @ turned), axis=-1)
    push, lean = (dt * np.linalg.solve(masses, one) for one in (-jacobian, leaning))
    return Tangents(step, push, lean)


class _Trees:
    """Motion of all trees of a model, at states of some shape."""

    def __init__(self, model: mujoco.MjModel, shape: tuple[int, ...]) -> None:
        self._model, self._roots = model, np.flatnonzero(model.body_parentid == 0)[1:]
        self.mass = model.body_subtreemass[self._roots, None]
        self.centre, self._speed, self._spin = np.zeros((3, *shape, len(self._roots), 3))

    def note(self, data: mujoco.MjData, at: int | tuple[int, int]) -> None:
        """Take note of a state, whose positions are up to date."""
        mujoco.mj_comVel(self._model, data)
        mujoco.mj_subtreeVel(self._model, data)
        self.centre[at] = data.subtree_com[self._roots]
        self._speed[at] = data.subtree_linvel[self._roots]
        self._spin[at] = data.subtree_angmom[self._roots]

    def momentum(self) -> FloatArray:
        """Momentum of all trees about the world's origin, shape (..., 6)."""
        linear = self.mass * self._speed
        angular = self._spin + np.cross(self.centre, linear)
        return np.concatenate((linear.sum(axis=-2), angular.sum(axis=-2)), axis=-1)
