"""What the data say is missing: candidates that explain more than chance, as rows for a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.estimation.core.result import Missing, MissingRow
from amhe_cli.estimation.explain.candidate import CauseMaker
from amhe_cli.estimation.explain.drives import drive_causes, prior_causes
from amhe_cli.estimation.explain.efforts import evened, unexplained_efforts
from amhe_cli.estimation.explain.inputs import LIKE, mended
from amhe_cli.estimation.explain.joints import joint_causes
from amhe_cli.estimation.explain.regression import DOUBT, CauseColumns, Regression, blocks_of, memory_of
from amhe_cli.estimation.explain.twin import twins
from amhe_cli.estimation.explain.unexplained import Unexplained, stepped, unexplained
from amhe_cli.system.system import System

#: Logs put right whose forces are looked at; steps of the values, and the last of them, in prior sd.
TRIED, TURNS, SHORT = 2, 3, 0.05
#: Kinds of which several are tried at each place, as one more number decides.
SEARCHED = {"stribeck", "force limit", "speed limit", "contact", "cogging", "periodic", "coupling",
            "servo limit", "slew limit", "delay"}  # fmt: skip
#: Share that makes another look at the log as it is needless.
CLEAR = 0.95


def explain(system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator) -> Missing:
    """What is wrong with the logs, and what the model lacks.

    A log that is put right counts where it leaves less of the accelerations than any force explains. What the
    model lacks is then looked for in the log that was put right.

    Args:
        parts: Parts of its logs.
        z: Values of the unknowns, shape (d,).
        rng: Generator of the signs of blocks.
    """
    fitted, suffices = _model_alone(system, parts, z, rng)
    if suffices:
        return Missing(
            untested="with values that a regression finds, the model explains its logs as well as those "
            "that it makes itself; where the misfit is large, the search has not found them"
        )
    if system.match == "effort":  # nearly linear: the regression finds the values beside a cause
        return forced(system, parts, fitted, rng, 0)
    wrong = mended(system, parts, rng)
    clear = bool(wrong) and wrong[0].share > CLEAR
    best, rows = forced(system, parts, z, rng, 0 if clear else TURNS), []
    for one in wrong[:TRIED]:
        mending = {id(part.log): one.mend(part.log) for part in parts}
        put = [replace(part, log=mending[id(part.log)]) for part in parts]
        again = forced(system, put, 0.0 * z, rng, TURNS)
        more = LIKE if len(again.rows) >= len(best.rows) else 1.0  # a row that needs others is no simpler
        if again.left * more < best.left or (best.untested and again.untested):  # rollouts show it alone
            alike = [two.text for two in wrong if two is not one and two.left < LIKE * one.left]
            rows = [MissingRow(one.kind, one.place, one.text, one.share, tuple(alike))]
            best = replace(again, start=best.start)
            break
    return replace(best, rows=(*rows, *best.rows))


def forced(
    system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator, turns: int
) -> Missing:
    """What the model lacks, at the values that leave least beside it; see `explain`."""
    if (found := looked_at(system, parts, z)) is None or not found.stretches:
        off = "no motion was measured where nothing touches; record some with wheels or feet off the ground"
        return Missing(untested=off)
    best, fit, left = _forced(system, parts, z, found, rng)
    if found.weights is not None:
        return _forced(system, parts, z, evened(found, left), rng)[0]
    way = np.inf
    for _ in range(turns if z.size else 0):
        moved = stepped(system, z, fit)
        before, way = way, float(np.abs(moved - z).max())
        if way < SHORT or way > before:  # it has arrived, or goes astray
            break
        if (found := looked_at(system, parts, moved)) is None or not found.stretches:
            break
        best, fit, _ = _forced(system, parts, moved, found, rng)
        z = moved
    return best


def _forced(
    system: System, parts: Sequence[Window], z: FloatArray, found: Unexplained, rng: np.random.Generator
) -> tuple[Missing, FloatArray, FloatArray]:
    """Regress on all causes what a system with some values does not explain.

    Returns:
        What is missing; the values' step, shape (d,); and what all causes leave, weighted, shape (r, k).
    """
    dofs, maker = list(found.motion.dofs), CauseMaker(system, found)
    tried = (*joint_causes(maker), *drive_causes(maker), *prior_causes(maker))
    candidates = [cause for cause in tried if cause.dofs]
    made = _regression(found)
    weights = _weights(found)
    columns = [
        CauseColumns(
            tuple(dofs.index(d) for d in c.dofs),
            found.made_by(c.force) * weights,
            len(c.force) + (c.kind in SEARCHED),
            c.most,
            c.least,
            (c.kind, c.place),
        )
        for c in candidates
    ]
    chosen, chance, left, fit = made.ladder(columns, rng, lambda: _own_error(system, parts, z, found, rng))
    rows, force = [], found.behind(left / np.maximum(weights, 1e-3))
    for one in chosen:
        cause, own = candidates[one.index], candidates[one.index].dofs[0]
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
                float(np.clip(one.share, 0.0, 1.0)),
                tuple(rivals),
                cause.repair(one.coefficients, one.sd) if cause.repair else {},
                (*cause.against(), force[:, own] + explained, explained),
            )
        )
    moved = found.moved
    start, after = (float(np.mean((e**2).mean(axis=0) / moved)) for e in (made.left, left))
    looked = 1.0 if found.weights is not None else float(found.rows.mean())  # contacts are in no effort
    return Missing(tuple(rows), chance, len(candidates), start, after, looked=looked), fit, left


def _model_alone(
    system: System, parts: Sequence[Window], z: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, bool]:
    """The best values of the model alone, and whether it then leaves no more than of a motion of its own."""
    way = np.inf
    for _ in range(TURNS + 1):
        if (found := looked_at(system, parts, z)) is None or not found.stretches:
            return z, False
        *_, left, fit = _regression(found).ladder([], rng)
        moved = stepped(system, z, fit)
        before, way = way, float(np.abs(moved - z).max(initial=0.0))
        if way < SHORT or way > before:
            break
        z = moved
    error = _own_error(system, parts, z, found, rng)
    return z, bool(((left**2).mean(axis=0) <= DOUBT * error).all())


def looked_at(system: System, parts: Sequence[Window], z: FloatArray) -> Unexplained | None:
    """What a system leaves of the accelerations, or of the efforts where these are matched."""
    return (unexplained_efforts if system.match == "effort" else unexplained)(system, parts, z)


def _weights(found: Unexplained) -> FloatArray | float:
    return 1.0 if found.weights is None else found.weights[found.rows]


def _regression(found: Unexplained) -> Regression:
    weights, memory = _weights(found), memory_of(found.residual[found.rows], found.stretches)
    residual, slopes = found.residual[found.rows] * weights, found.slopes[:, found.rows] * weights
    return Regression(residual, slopes, blocks_of(found.stretches, memory), found.toward, memory)


def _own_error(
    system: System, parts: Sequence[Window], z: FloatArray, found: Unexplained, rng: np.random.Generator
) -> FloatArray:
    """Mean square of the acceleration that would be left without any cause, shape (k,).

    It is what is left of logs that the model itself makes: smoothing, noise and the time between commands
    have such an error, which repeats from block to block, so that no test by blocks calls it chance.
    """
    own = looked_at(system, made, z) if (made := twins(system, parts, z, rng)) else None
    if own is None or not own.stretches or own.motion.dofs != found.motion.dofs:
        return np.zeros(found.residual.shape[1])
    like = np.minimum(found.moved / own.moved, 1.0)  # a twin may move more, and is then no scale
    return like * (_regression(own).left ** 2).mean(axis=0)
