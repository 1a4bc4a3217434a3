"""What torques along a measured motion tell: how many numbers, and of each joint, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.result import HeldOut, SpanError
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty.fit import FinalFit
from amhe_cli.matching.efforts import path_of
from amhe_cli.system.model.elements import dofs_of
from amhe_cli.system.system import System

#: A number is known where its sd is below this share of its prior's.
_KNOWN = 0.5
#: Numbers of friction.
_RUBS = ("dof_damping", "dof_frictionloss")
#: Step of a parameter, in its prior sd, for its slope.
_STEP = 1e-4


def told(
    problem: Problem, fit: FinalFit, z: FloatArray, covariance: FloatArray, held_out: HeldOut | None
) -> tuple[str, ...]:
    """How many numbers the motion determines and how well it tells them apart; then a verdict on each joint.

    Where efforts are linear in the unknowns, those numbers are the base parameters (Gautier and Khalil 1990).

    Args:
        problem: The problem.
        fit: Its linearisation at the estimate.
        z, covariance: The estimate and its covariance, shape (d,) and (d, d).
        held_out: Errors on clips that were not fitted.
    """
    system, path = problem.system, path_of(problem.system, problem.clips[0].log)
    known = np.linalg.eigvalsh(fit.posterior.hessian - fit.posterior.prior)
    better = known[known > 1.0]
    band, rate = float(path.motion.band.max()), 1.0 / (path.every * system.dt)
    speed = np.sqrt((path.motion.qvel**2).mean(axis=0))
    return (
        f"this motion determines {better.size} of {known.size} numbers better than their priors do "
        f"(condition number {np.sqrt(better.max(initial=1.0) / better.min(initial=1e300)):.0f}); it reaches "
        f"{band:.2g} Hz, and efforts are compared {rate:.2g} times a second",
        *_joints(system, z, covariance, speed, _missed(problem, held_out)),
    )


def _missed(problem: Problem, held_out: HeldOut | None) -> dict[int, SpanError | None]:
    """Degrees of freedom whose efforts are compared, and how these are missed, where that is known."""
    errors = {one.channel: one for one in held_out.errors} if held_out else {}
    log = problem.clips[0].log
    parts = (c.parts(log[c.key].columns) for c in problem.system.channels if c.compared)
    return {part.columns[0]: errors.get(part.key) for each in parts for part in each}


def _joints(
    system: System,
    z: FloatArray,
    covariance: FloatArray,
    speed: FloatArray,
    missed: Mapping[int, SpanError | None],
) -> Iterator[str]:
    """'elbow: friction known to 4 %, inertia in 3 of 10 combinations, torque misses 0.3 N m'."""
    places = {name: i for i, name in enumerate(system.space.names)}
    reached = [
        (places[name], cells.field, int(cells.row))
        for name, edit in system.edits.by_name() if name in places for cells in edit.cells
    ]  # fmt: skip
    dofs = dofs_of(system.model)
    for dof, one in ((dof, dofs[dof]) for dof in missed):
        body, unit = int(system.model.jnt_bodyid[one.joint]), "N m" if one.turns else "N"
        rubs = sorted({i for i, field, row in reached if field in _RUBS and row == dof})
        inert = sorted({i for i, field, row in reached if field.startswith("body_") and row == body})
        parts = []
        if rubs:
            share = _friction(system, z, covariance, rubs, dof, float(speed[dof]))
            parts.append(f"friction known to {share:.0%}" if share < 1.0 else "friction not known")
        if inert:
            values = np.linalg.eigvalsh(covariance[np.ix_(inert, inert)])
            count = int((values < _KNOWN**2).sum())
            several = f"inertia in {count} of {len(inert)} combinations" if count else "inertia as given"
            parts.append("inertia known" if count == len(inert) else several)
        if (error := missed[dof]) is not None:
            parts.append(f"torque misses {error.identified:.2g} {unit} ({error.initial:.2g} before)")
        if parts:
            yield f"{one.name}: {', '.join(parts)}"


def _friction(
    system: System, z: FloatArray, covariance: FloatArray, rows: list[int], dof: int, speed: float
) -> float:
    """Sd of a joint's friction at its usual speed, as a share of it."""

    def at(values: FloatArray) -> float:
        theta = system.space.theta_of(values)
        model = system.edits.apply(system.model, theta)
        return float(model.dof_damping[dof] * speed + model.dof_frictionloss[dof])

    size = at(z)
    slopes = np.array([(at(z + _STEP * row) - size) / _STEP for row in np.eye(len(z))[rows]])
    variance = slopes @ covariance[np.ix_(rows, rows)] @ slopes
    return float(np.sqrt(variance) / size) if size > 0.0 else np.inf
