"""What the data say is missing: candidates that explain more than chance, as rows for a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.estimation.core.result import Missing, MissingRow
from amhe_cli.estimation.explain.causes import SEARCHED, causes
from amhe_cli.estimation.explain.inputs import mended
from amhe_cli.estimation.explain.regression import CauseColumns, Regression, blocks_of, memory_of
from amhe_cli.estimation.explain.unexplained import accelerations, stepped, unexplained
from amhe_cli.system.system import System

#: Logs put right whose forces are looked at; steps of the values, and the last of them, in prior sd.
TRIED, TURNS, SHORT = 2, 3, 0.05
#: Share that makes another look at the log as it is needless.
CLEAR = 0.95
#: What is left of two logs put right that are alike, at most a factor.
LIKE = 1.1


def explain(system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator) -> Missing:
    """What is wrong with the logs, and what the model lacks.

    A log that is put right counts where it leaves less of the accelerations than any force explains. What the
    model lacks is then looked for in the log that was put right.

    Args:
        system: The system.
        parts: Parts of its logs.
        z: Values of the unknowns, shape (d,).
        rng: Generator of the signs of blocks.
    """
    if system.match == "effort":
        return Missing(untested="efforts are matched, and no motion is predicted")
    wrong = mended(system, parts, rng)
    clear = bool(wrong) and wrong[0].share > CLEAR
    best, rows = forced(system, parts, z, rng, 0 if clear else TURNS), []
    for one in wrong[:TRIED]:
        mending = {id(part.log): one.mend(part.log) for part in parts}
        put = [replace(part, log=mending[id(part.log)]) for part in parts]
        again = forced(system, put, 0.0 * z, rng, TURNS)
        if again.left < best.left:
            alike = [two.text for two in wrong if two is not one and two.left < LIKE * one.left]
            rows = [MissingRow(one.kind, one.place, one.text, one.share, tuple(alike))]
            best = replace(again, start=best.start)
            break
    return replace(best, rows=(*rows, *best.rows))


def forced(
    system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator, turns: int
) -> Missing:
    """What the model lacks, at the values that leave least beside it; see `explain`."""
    best, fit = _forced(system, parts, z, rng)
    way = np.inf
    for _ in range(turns if z.size and not best.untested else 0):
        moved = stepped(system, z, fit)
        before, way = way, float(np.abs(moved - z).max())
        if way < SHORT or way > before:  # it has arrived, or goes astray
            break
        other, fit = _forced(system, parts, moved, rng)
        if other.untested:
            break
        best, z = other, moved
    return best


def _forced(
    system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator
) -> tuple[Missing, FloatArray]:
    """Regress what a system with some values does not explain on the dictionary; and the values' step.

    Args:
        system: The system.
        parts: Parts of its logs.
        z: Values of the unknowns, shape (d,).
        rng: Generator of the signs of blocks.
    """
    found = unexplained(system, parts, z)
    if found is None or not found.stretches:
        return Missing(untested="no motion was measured away from contacts"), 0.0 * z
    dofs = list(found.motion.dofs)
    candidates = causes(system, found, found.forces.by - found.uncommanded)
    residual, slopes, mass = (
        found.residual[found.rows],
        found.slopes[:, found.rows],
        found.forces.mass[found.rows],
    )
    stretches = found.stretches
    columns = [
        CauseColumns(
            tuple(dofs.index(d) for d in c.dofs),
            accelerations(mass, c.force, dofs),
            len(c.force) + (c.kind in SEARCHED),
            c.most,
        )
        for c in candidates
    ]
    memory = memory_of(residual, stretches)
    made = Regression(residual, slopes, blocks_of(stretches, memory), found.toward, memory)
    chosen, chance, left, fit = made.ladder(columns, rng)
    rows = []
    for one in chosen:
        cause = candidates[one.index]
        own = cause.dofs[0]
        explained = np.tensordot(one.coefficients, cause.force[..., own], 1)
        rivals = dict.fromkeys(
            candidates[i].kind + " of " + candidates[i].place for i in one.rivals
            if (candidates[i].kind, candidates[i].place) != (cause.kind, cause.place)
        )  # fmt: skip
        rows.append(
            MissingRow(
                cause.kind,
                cause.place,
                cause.words(one.coefficients, one.sd),
                min(one.share, 1.0),
                tuple(rivals),
                cause.repair(one.coefficients, one.sd) if cause.repair else {},
                (*cause.against, _force(mass, left, dofs)[:, own] + explained, explained),
            )
        )
    moved = (found.motion.filtered(found.motion.qacc)[found.rows][:, dofs] ** 2).mean(axis=0)
    start, after = (float(np.mean((e**2).mean(axis=0) / moved)) for e in (made.left, left))
    return Missing(tuple(rows), chance, len(candidates), start, after), fit


def _force(mass: FloatArray, acceleration: FloatArray, dofs: Sequence[int]) -> FloatArray:
    """Force (n, nv) behind accelerations (n, k) of some degrees of freedom."""
    found = np.zeros(mass.shape[:2])
    found[:, dofs] = np.einsum("nij,nj->ni", mass[:, dofs][:, :, dofs], acceleration)
    return found
