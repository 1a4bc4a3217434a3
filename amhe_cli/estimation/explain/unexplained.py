"""The acceleration that a model does not explain, and what its free parameters can make of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.each_log import values_on
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.inverse import Forces, forces_as_stepped
from amhe_cli.engine.states import apart, controls
from amhe_cli.estimation.explain.motion import DrivenMotion, motion_in
from amhe_cli.system.system import System

#: A parameter's step for its slope, in its prior sd.
_STEP = 1e-3
#: Speeds below this share of their rms are about zero.
_STILL = 0.02


@dataclass(frozen=True, eq=False)
class Unexplained:
    """What is missing of the measured motion, where nothing touches.

    Args:
        motion: The motion; forces have its rows.
        rows: Rows that count, shape (n,); a contact reaches the others through the filter.
        residual: The acceleration of the measured degrees of freedom that nothing gives, filtered, (n, k).
        slopes: Its derivative by each free parameter over a step of one prior sd, shape (d, n, k).
        toward: Coefficients of the slopes that lead back to the priors, in their sd, shape (d,).
        forces: Forces along the motion, not filtered.
        uncommanded: What each actuator gives without its command, shape (n, actuators, nv).
        weights: How much the residual counts, shape (n, k); None: alike at all rows that count.
        laws: Gain and the three biases of each actuator, as its log has them, shape (n, actuators, 4).
    """

    motion: DrivenMotion
    rows: BoolArray
    residual: FloatArray
    slopes: FloatArray
    toward: FloatArray
    forces: Forces
    uncommanded: FloatArray
    weights: FloatArray | None = None
    laws: FloatArray | None = None

    @property
    def moved(self) -> FloatArray:
        """Mean square of the measured accelerations, filtered, shape (k,)."""
        return np.asarray(
            (self.motion.filtered(self.motion.qacc)[self.rows][:, self.motion.dofs] ** 2).mean(axis=0)
        )

    @cached_property
    def _mass(self) -> FloatArray:
        """The mass matrix of the measured degrees of freedom at the rows that count, shape (r, k, k)."""
        dofs = list(self.motion.dofs)
        return self.forces.mass[self.rows][:, dofs][:, :, dofs]

    @cached_property
    def _inverse(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self._mass), dtype=np.float64)

    def made_by(self, force: FloatArray) -> FloatArray:
        """Accelerations (..., r, k), at the rows that count, that forces (..., r, nv) make."""
        own = force[..., list(self.motion.dofs)]
        return np.asarray(np.einsum("nij,...nj->...ni", self._inverse, own))

    def behind(self, acceleration: FloatArray) -> FloatArray:
        """Forces (r, nv) behind accelerations (r, k), at the rows that count."""
        found = np.zeros((len(acceleration), self.forces.mass.shape[1]))
        found[:, list(self.motion.dofs)] = np.einsum("nij,nj->ni", self._mass, acceleration)
        return found

    @property
    def stretches(self) -> list[slice]:
        """Unbroken stretches among the rows that count, numbered without the others."""
        counted, found = np.concatenate(([0], np.cumsum(self.rows))), []
        for stretch in self.motion.stretches:
            edges = np.flatnonzero(np.diff(np.concatenate(([0], self.rows[stretch], [0])).astype(int)))
            for first, last in stretch.start + edges.reshape(-1, 2):
                found.append(slice(int(counted[first]), int(counted[last])))
        return found


def direction(speed: FloatArray) -> FloatArray:
    """Sign of speeds (n, k), smooth where they are about zero."""
    usual = np.sqrt((speed**2).mean(axis=0))
    return np.tanh(speed / np.maximum(_STILL * usual, 1e-12))


def unexplained(system: System, parts: Sequence[Window], z: FloatArray) -> Unexplained | None:
    """What a system does not explain of some parts of logs; None: no motion was measured apart from contacts.

    Args:
        parts: Parts of its logs.
        z: Values of the unknowns, shape (d,).
    """
    space, logs = system.space, list(dict.fromkeys(part.log for part in parts))
    theta, scale = space.theta_of(z), scale_of(system)
    if (motion := motion_in(system, parts, theta)) is None:
        return None
    models = models_of(system, logs, theta)
    found = along(system, models, motion)
    residual, rows = missing(motion, found), apart_in(models[0], motion)
    if not rows.any():
        return None
    slopes = np.empty((len(space), *residual.shape))
    for i in range(len(space)):
        step = theta.copy()
        step[i] += _STEP * scale[i]
        moved = motion_in(system, parts, step) if system.edits.late else motion
        after = along(system, models_of(system, logs, step), moved or motion)
        slopes[i] = (missing(motion, after) - residual) / _STEP
    toward = (theta - np.array(space.nominal)) / scale
    inputs = motion.inputs.copy()
    if (place := controls(system.model, system.input_spec)) is not None:
        inputs[:, place] = 0.0
    uncommanded = along(system, models, replace(motion, inputs=inputs, act=0.0 * motion.act)).by
    laws = np.stack([np.c_[m.actuator_gainprm[:, :1], m.actuator_biasprm[:, :3]] for m in models])[motion.log]
    return Unexplained(motion, rows, residual, slopes, toward, found, uncommanded, laws=laws)


def scale_of(system: System) -> FloatArray:
    """One prior sd of each free parameter, in its own unit, shape (d,)."""
    space = system.space
    return np.where(space.log, np.array(space.nominal), 1.0) * np.array(space.prior_sd)


def stepped(system: System, z: FloatArray, fit: FloatArray) -> FloatArray:
    """Values z (d,) after a step that a fit of the slopes (d,) demands; at most a factor of two."""
    space = system.space
    theta = space.theta_of(z)
    moved = theta - fit * scale_of(system)
    return space.clip(space.z_of(np.where(space.log, np.clip(moved, 0.5 * theta, 2.0 * theta), moved)))


def models_of(system: System, logs: Sequence[Log], theta: FloatArray) -> list[Any]:
    """The model of each log, with its own values."""
    values = [values_on(log, system.edits.space, system.space, theta[None])[0] for log in logs]
    return [system.edits.apply(system.model, each) for each in values]


def along(system: System, models: Sequence[Any], motion: DrivenMotion) -> Forces:
    """Forces along a motion as a rollout computes them, from the model of each log."""
    made = []
    for number, model in enumerate(models):
        own = motion.log == number
        moved = motion.qpos[own], motion.qvel[own], motion.qacc[own]
        made.append(forces_as_stepped(model, *moved, motion.inputs[own], system.input_spec, motion.act[own]))
    joined = {name: np.concatenate([getattr(one, name) for one in made]) for name in Forces.__slots__}
    return Forces(**joined)


def apart_in(model: Any, motion: DrivenMotion) -> BoolArray:
    """Rows that no contact reaches through the filter, shape (n,)."""
    clear = apart(model, motion.qpos)
    for stretch in motion.stretches:
        near = np.convolve(~clear[stretch], np.ones(2 * motion.reach + 1), "same")
        clear[stretch] = near[: stretch.stop - stretch.start] < 0.5
    return clear


def missing(motion: DrivenMotion, found: Forces) -> FloatArray:
    """Acceleration that is measured and that no force gives, filtered, shape (n, k).

    An acceleration, not a force: that of a model which weighs nothing and gives nothing would be none.
    """
    force = motion.filtered(found.missing + found.friction * direction(motion.qvel))
    dofs = list(motion.dofs)
    return np.einsum("nij,...nj->...ni", np.linalg.inv(found.mass[:, dofs][:, :, dofs]), force[..., dofs])
