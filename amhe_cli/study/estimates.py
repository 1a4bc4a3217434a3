"""Accuracy of a study's online estimates: errors and intervals, from the traces of its runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.statistics import Z90
from amhe_cli.study.results import CellResult
from amhe_cli.study.summary import Group

#: The product of these is the resistance of a box that is pushed; each by itself is harder to determine.
PAIR = ("box_mass", "floor_friction")
#: Estimates count from this long after the change; where nothing changes, from this long after the start [s].
SETTLED, BEGUN = 1.5, 3.0
#: From this long after the same instants, each parameter should be this near, or its interval hold the truth
#: [s].
RESOLVED, NEAR = 5.0, 0.15


@dataclass(frozen=True, slots=True)
class Estimates:
    """Accuracy of one group of runs; errors are rms, relative, over time and seeds.

    Args:
        task, mode: Task and mode of the group.
        n: Number of runs.
        product: Error of mass times friction.
        mass, friction: Errors of mass and of friction.
        mass_held, friction_held: Share of the time that the 90 % interval holds the truth.
        resolved: Share of runs in which 5 s after the change mass and friction are each within 15 % of the
            truth, or their interval holds it.
    """

    task: str
    mode: str
    n: int
    product: float
    mass: float
    friction: float
    mass_held: float
    friction_held: float
    resolved: float


def estimates(group: Group) -> Estimates | None:
    """The accuracy of a group; None where nothing was estimated, or not for long enough."""
    rows = [_judged(result) for result in group.results if f"belief_sd/{PAIR[0]}" in result.trace]
    rows = [row for row in rows if row is not None]
    if not rows:
        return None
    mass, friction, product = _rms(np.concatenate([errors for errors, _, _ in rows]))
    mass_held, friction_held = np.concatenate([held for _, held, _ in rows]).mean(axis=0).tolist()
    resolved = float(np.mean([done for *_, done in rows]))
    return Estimates(
        group.task, group.mode, len(rows), product, mass, friction, mass_held, friction_held, resolved
    )


def _rms(errors: FloatArray) -> list[float]:
    """Rms of each column of errors (m, k)."""
    return np.sqrt((errors**2).mean(axis=0)).tolist()


def change_of(result: CellResult) -> float | None:
    """Time of the first change of box or floor [s]; None: nothing changed."""
    truth = [values for name, values in result.trace.items() if name.startswith("truth/")]
    rows = [row for values in truth for row in np.flatnonzero(np.diff(values))]
    return float(result.trace["time"][min(rows) + 1]) if rows else None


def deviations(result: CellResult) -> tuple[FloatArray, FloatArray]:
    """Logarithms of believed over true mass and friction, and their sd, over time; shape (n, 2) each."""
    trace = result.trace
    believed, sd, truth = (
        np.stack([trace[f"{of}/{name}"] for name in PAIR], axis=1) for of in ("belief", "belief_sd", "truth")
    )
    return np.log(believed / truth), sd / believed


def _judged(result: CellResult) -> tuple[FloatArray, BoolArray, bool] | None:
    """Errors of mass, friction, product (m, 3); whether mass and friction are held (m, 2); if resolved."""
    off, sd = deviations(result)
    change = change_of(result)
    since = result.trace["time"] - (BEGUN - SETTLED if change is None else change)
    late = since >= SETTLED
    if not late.any():
        return None
    held = np.abs(off) <= Z90 * sd  # the intervals are those of the logarithms
    errors = np.expm1(np.column_stack((off, off.sum(axis=1))))
    at = int(np.argmin(np.abs(since - RESOLVED)))
    resolved = bool((held[at] | (np.abs(errors[at, :2]) <= NEAR)).all())
    return errors[late], held[late], resolved
