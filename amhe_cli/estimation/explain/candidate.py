"""A cause that may be missing: its columns of force along the motion, in words, and as parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import Parameter
from amhe_cli.estimation.explain.unexplained import Unexplained, direction
from amhe_cli.system.model.elements import dofs_of
from amhe_cli.system.system import System

#: Coefficients (m,) and their sd -> a cause in words; or entries of `parameters` that let a model have it.
Words = Callable[[FloatArray, FloatArray], str]
Repair = Callable[[FloatArray, FloatArray], dict[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """One candidate.

    Args:
        kind: What it is, such as 'spring'.
        place: Where: a joint, a body, an actuator; several, with commas.
        dofs: Degrees of freedom whose unexplained acceleration its share is of.
        force: Its columns of force along the motion, filtered as the residual is, shape (m, n, nv).
        words: The cause in words.
        against: What its force is drawn against: name with its unit, and values (n,).
        repair: Entries of `parameters` that let the model have it; None: no number of a model does.
        most: The largest first coefficient that can be: of friction, springs and inertia what the model has.
        least: The least size of that coefficient that says anything.
    """

    kind: str
    place: str
    dofs: tuple[int, ...]
    force: FloatArray
    words: Words
    against: Callable[[], tuple[str, FloatArray]]
    repair: Repair | None = None
    most: float = np.inf
    least: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDof:
    """A degree of freedom along the motion; arrays have shape (n,).

    Args:
        dof, name: Its number and its name.
        joint, place: Row of its joint and column of its position; -1 where it is no hinge or slide.
        q, v, a: Position, speed, and the acceleration as commands, positions and speeds predict it.
        way: Sign of the speed, smooth about zero.
        given: What its drives give.
        f, u: Units of force and length: 'N m' and 'rad', or 'N' and 'm'.
    """

    dof: int
    name: str
    joint: int
    place: int
    q: FloatArray
    v: FloatArray
    a: FloatArray
    way: FloatArray
    given: FloatArray
    f: str
    u: str


class CauseMaker:
    """The system and its motion, and candidates made of columns of force.

    Args:
        found: What it does not explain.
    """

    def __init__(self, system: System, found: Unexplained) -> None:
        self.system, self.found, self.motion = system, found, found.motion
        self.model = system.edits.apply(system.model, np.array(system.edits.space.nominal))
        self.commands = found.forces.by - found.uncommanded  # what comes from commands, (n, actuators, nv)
        self.time = self.motion.time - self.motion.time[0]
        self.unknown = {parameter.of_model for parameter in system.space.parameters}
        self.set = {
            (cells.field, cells.row, column): parameter
            for parameter, each in system.edits.by_parameter() for cells in each
            for column in cells.columns or (0,)
        }  # fmt: skip
        self.moved = self._moved()

    @cached_property
    def left(self) -> FloatArray:
        """What the free parameters, each where it fits best, leave of the residual, shape (n, k)."""
        residual = self.found.residual[self.found.rows]
        slopes = self.found.slopes[:, self.found.rows].reshape(len(self.found.slopes), -1)
        fit = np.linalg.lstsq(slopes.T, residual.ravel(), rcond=1e-9)[0]
        return residual - (fit @ slopes).reshape(residual.shape)

    def _moved(self) -> dict[int, MeasuredDof]:
        """The measured degrees of freedom; a measured acceleration has the residual's own noise in it."""
        motion, dofs, way = self.motion, dofs_of(self.model), direction(self.motion.qvel)
        clean, nothing = [np.ones(len(self.time))], np.zeros(len(self.time))
        for dof in motion.dofs:
            q = motion.qpos[:, dofs[dof].place] if dofs[dof].place >= 0 else nothing
            clean += [
                *(self.commands[..., dof].sum(axis=1), self.found.forces.given[:, dof]),
                *(motion.qvel[:, dof], way[:, dof], q, np.sin(q), np.cos(q)),
                np.abs(self.found.forces.given[:, dof]) * way[:, dof],
            ]
        columns = np.stack(clean, axis=1)
        columns /= np.maximum(np.abs(columns).max(axis=0), 1e-12)
        a = columns @ np.linalg.lstsq(columns, motion.qacc, rcond=1e-9)[0]
        return {
            dof: MeasuredDof(
                dof=dof, name=dofs[dof].name, joint=dofs[dof].joint, place=dofs[dof].place,
                q=motion.qpos[:, dofs[dof].place] if dofs[dof].place >= 0 else nothing,
                v=motion.qvel[:, dof], a=a[:, dof], way=way[:, dof], given=self.found.forces.given[:, dof],
                f="N m" if dofs[dof].turns else "N", u="rad" if dofs[dof].turns else "m",
            )
            for dof in motion.dofs
        }  # fmt: skip

    def free(self, field: str, row: int, column: int = 0) -> bool:
        """Whether an unknown sets a number of the model."""
        parameter = self.set.get((field, row, column))
        return parameter is not None and parameter.name in self.unknown

    def now(self, field: str, row: int, column: int = 0) -> float:
        """A number of the model."""
        return float(np.atleast_1d(getattr(self.model, field)[row])[column])

    def on(
        self, j: MeasuredDof, kind: str, columns: Sequence[FloatArray], words: Words, against: str = "time",
        repair: Repair | None = None, most: float = np.inf,
    ) -> Cause:  # fmt: skip
        """A candidate on one degree of freedom; it is drawn against its position, speed, ... or the time."""
        values = np.zeros((len(columns), len(self.time), self.model.nv))
        values[..., j.dof] = columns
        return Cause(kind, j.name, *self.spread(values), words, lambda: self.drawn(j, against), repair, most)

    def drawn(self, j: MeasuredDof, what: str) -> tuple[str, FloatArray]:
        """A quantity of a degree of freedom with its unit, at the rows that count."""
        values, name = {
            "position": (j.q, f"{j.name} [{j.u}]"),
            "speed": (j.v, f"speed of {j.name} [{j.u}/s]"),
            "acceleration": (self.motion.qacc[:, j.dof], f"acceleration of {j.name} [{j.u}/s^2]"),
            "time": (self.time, "time [s]"),
        }[what]
        values = values if what == "time" else self.motion.filtered(values)
        return name, values[self.found.rows]

    def spread(self, values: FloatArray) -> tuple[tuple[int, ...], FloatArray]:
        """The measured degrees of freedom that columns (m, n, nv) act on, and the columns, filtered."""
        acts = np.flatnonzero(np.abs(values).max(axis=(0, 1)) > 0.0)
        force = np.zeros((len(values), int(self.found.rows.sum()), values.shape[2]))
        moved = self.motion.filtered(np.moveaxis(values[..., acts], 1, 0))
        force[..., acts] = np.moveaxis(moved, 0, 1)[:, self.found.rows]
        return tuple(d for d in self.motion.dofs if d in acts), force

    def change(self, values: FloatArray) -> FloatArray:
        """Derivative of values (n, ...) by time; 0 where an instant stands alone."""
        found = np.zeros_like(values)
        for s in (one for one in self.motion.stretches if one.stop - one.start > 1):
            found[s] = np.gradient(values[s], self.motion.period, axis=0)
        return found

    def later(self, values: FloatArray, seconds: float) -> FloatArray:
        """Values (n, ...) as they were some time before."""
        motion, found = self.motion, np.empty_like(values)
        for s in motion.stretches:
            time = motion.time[s]
            found[s] = np.stack([np.interp(time - seconds, time, one) for one in values[s].T], axis=-1)
        return found

    def wider(self, cell: tuple[str, int, int], value: float) -> dict[str, Any]:
        """The parameter that sets a number, with a prior about another value of it."""
        parameter, now = self.set[cell], self.now(*cell)
        if parameter.owner or not now:
            return {}
        return {parameter.of_model: believed(parameter, parameter.nominal * max(value / abs(now), 0.1))}

    def became(self, cell: tuple[str, int, int], value: float, sd: float, **target: str) -> dict[str, Any]:
        """The parameter that sets a number that cannot be negative, or one that will, about a value."""
        if cell in self.set:
            return self.wider(cell, value)
        where = next(name for key, name in target.items() if key != "set")
        return {f"{where}_{target['set']}": positive(value, sd, target)}


def number(value: float, sd: float) -> str:
    """'0.049 ± 0.004', with the digits that the sd warrants."""
    if not 0.0 < sd < np.inf:
        return f"{value:.3g}"
    if abs(value) < 1e-3:
        return f"{value:.2e} ± {sd:.1e}"
    digits = int(np.clip(1 - np.floor(np.log10(sd)), 0, 9)) if sd < 10.0 else 0
    return f"{value:.{digits}f} ± {sd:.{digits}f}"


def says(text: str, sign: float = 1.0) -> Words:
    """Words with the first coefficient, times a sign, for '#'; the size of all where that is 0."""

    def words(c: FloatArray, sd: FloatArray) -> str:
        size = number(sign * c[0], sd[0]) if sign else number(float(np.hypot.reduce(c)), np.hypot.reduce(sd))
        return text.replace("#", size)

    return words


def times(what: str, of: str, sign: float = 1.0) -> Words:
    """A factor in words, of a coefficient that is, with a sign, what it has beyond one."""
    return lambda c, sd: f"{what} {number(1.0 + sign * c[0], sd[0])} {of}"


def believed(parameter: Parameter, value: float) -> dict[str, Any]:
    """Keys of a parameter that give it a prior about another value, and wider."""
    if parameter.log:
        low, high = min(parameter.lower, value / 10.0), max(parameter.upper, value * 10.0)
        return {"nominal": max(value, low), "bounds": [low, high], "prior_sd": max(parameter.prior_sd, 0.5)}
    sd = max(parameter.prior_sd, abs(value - parameter.nominal))
    low, high = min(parameter.lower, value - 3.0 * sd), max(parameter.upper, value + 3.0 * sd)
    low = max(low, 0.0) if parameter.lower >= 0.0 else low
    return {"nominal": value, "bounds": [low, high], "prior_sd": sd}


def positive(value: float, sd: float, target: dict[str, Any]) -> dict[str, Any]:
    """A parameter of a number that cannot be negative."""
    start = max(value, 0.5 * sd, 1e-9)
    bounds = [0.01 * start, 100.0 * start]
    return {"nominal": start, "bounds": bounds, "scale": "log", "prior_sd": 1.0, "targets": [target]}


def signed(value: float, sd: float, target: dict[str, Any]) -> dict[str, Any]:
    """A parameter of any sign."""
    reach, sd = 3.0 * abs(value) + 10.0 * sd, max(abs(value), 3.0 * sd)
    return {"nominal": value, "bounds": [-reach, reach], "prior_sd": sd, "targets": [target]}
