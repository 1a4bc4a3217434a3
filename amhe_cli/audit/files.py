"""A model file against another one, or against what an identification found."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.audit.audit import Line, in_order, verdicts_of
from amhe_cli.audit.claims import sheet_of
from amhe_cli.audit.judge import chances, compared, contradicted
from amhe_cli.audit.weight import anywhere, weights
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, with_prior
from amhe_cli.core.parameters import theta_of
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.init.names import matched
from amhe_cli.system.model.elements import driven_joint, names_of
from amhe_cli.system.numbers import ModelNumber, numbers_of, shape_of
from amhe_cli.system.system import System

#: Share from which two numbers differ: files are written with three digits or more.
_SAME = 2e-3
#: Step of a parameter for its slope, in its sd.
_STEP = 0.1
#: Size below which lengths [m], inertias and others are zero.
_ZERO = 1e-9


@dataclass(frozen=True, slots=True)
class FileDifference:
    """A number that two models have, and do not agree on.

    Args:
        of, what, unit: Whose number it is, and which.
        one, other: Its values, (n,) each.
        weight: Share of the forces along a motion that it is worth; see `weights`.
    """

    of: str
    what: str
    unit: str
    one: tuple[float, ...]
    other: tuple[float, ...]
    weight: float


@dataclass(frozen=True, slots=True)
class FilesCompared:
    """What two models disagree on.

    Args:
        differences: Numbers that differ, the one that matters most first.
        alike: How many numbers agree.
        alone: Names of bodies, joints and actuators that only the first and only the second has.
        masses: Mass of all that moves [kg], of either.
    """

    differences: tuple[FileDifference, ...]
    alike: int
    alone: tuple[tuple[str, ...], tuple[str, ...]]
    masses: tuple[float, float]


def compare(one: mujoco.MjModel, other: mujoco.MjModel) -> FilesCompared:
    """The numbers on which two models of a robot differ; elements are matched by their names."""
    pairs, alone = partners(one, other)
    theirs = {(n.kind, n.of, n.what): n for n in _all(other)}
    found, changed, alike = [], [], 0
    for number in _all(one):
        partner = theirs.get((number.kind, pairs[number.element].get(number.of, ""), number.what))
        if partner is None:
            continue
        mine, its = number.values(one), partner.values(other)
        size = max(np.abs(mine).max(), np.abs(its).max())
        if np.abs(mine - its).max() <= max(_SAME * size, _ZERO):
            alike += 1
            continue
        found.append((number, mine, its))
        changed.append(number.written(one, its))
    worth = weights(one, changed, anywhere(one))
    rows = [
        FileDifference(n.of, n.what, n.unit, tuple(map(float, mine)), tuple(map(float, its)), weight)
        for (n, mine, its), weight in zip(found, worth, strict=True)
    ]
    rows.sort(key=lambda row: -row.weight)
    masses = tuple(float(m.body_mass[m.body_weldid > 0].sum()) for m in (one, other))
    return FilesCompared(tuple(rows), alike, alone, (masses[0], masses[1]))


def _all(model: mujoco.MjModel) -> list[ModelNumber]:
    return [*numbers_of(model, axes=False), *shape_of(model)]


def partners(
    one: mujoco.MjModel, other: mujoco.MjModel
) -> tuple[dict[str, dict[str, str]], tuple[tuple[str, ...], tuple[str, ...]]]:
    """Kind of element -> name in one -> name in the other; and the names that only one has."""
    pairs: dict[str, dict[str, str]] = {}
    mine: list[str] = []
    its: list[str] = []
    for kind in ("body", "joint", "actuator"):
        names = [_named(model, kind) for model in (one, other)]
        pairs[kind] = matched({name: (name,) for name in names[0]}, names[1])
        if kind == "actuator":  # those of other names, by the joints that they drive
            driven = {driven_joint(other, other.actuator(n).id) or n: n for n in names[1]}
            driven = {joint: n for joint, n in driven.items() if n not in pairs[kind].values()}
            left = [name for name in names[0] if name not in pairs[kind]]
            own = {n: (driven_joint(one, one.actuator(n).id) or n,) for n in left}
            pairs[kind] |= {name: driven[joint] for name, joint in matched(own, driven).items()}
        mine += [name for name in names[0] if name not in pairs[kind]]
        its += [name for name in names[1] if name not in pairs[kind].values()]
    return pairs, (tuple(dict.fromkeys(mine)), tuple(dict.fromkeys(its)))


def _named(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of what moves and has a mass, of joints, or of actuators."""
    names = names_of(model, kind)
    if kind != "body":
        return names
    return [n for n in names if model.body_weldid[model.body(n).id] and model.body(n).mass[0] > 0.0]


def held_against(system: System, belief: Belief, file: mujoco.MjModel) -> list[Line]:
    """The numbers of a file that the parameters of a result set, and whether the result contradicts them.

    Args:
        system: The system of the result.
        belief: What it found.
        file: The model of the file; names are matched as between two files.
    """
    space = with_prior(system.space, belief)
    model = system.edits.apply(system.model, space.nominal)
    theirs = {(n.kind, n.of, n.what): n for n in numbers_of(model)}
    moved = list(_moved(system, space.nominal))
    pairs, rows, others = partners(file, model)[0], list[tuple[ModelNumber, FloatArray]](), []
    for number in numbers_of(file):
        own = theirs.get((number.kind, pairs[number.element].get(number.of, ""), number.what))
        sheet = sheet_of(number, file, AssumedSettings())
        if own is None or not sheet:
            continue
        ends, said = np.array([[own.value(end) for end in two] for _, two in moved]), number.value(file)
        slope = (ends[:, 1] - ends[:, 0]) / [step for step, _ in moved]
        sd = float(np.sqrt(slope @ belief.covariance @ slope))
        if sd > 0.0:
            rows.append((number, np.array([own.value(model), said, sd, sheet])))
            others.append(own.written(model, number.values(file)))
    log, said, sd, sheet = np.array([row for _, row in rows]).reshape(-1, 4).T
    # as in an audit of logs: a data sheet errs by a factor, so that one five times too large is not near
    share = np.array([n.kind != "center_of_mass" for n, _ in rows], dtype=bool) & (said > 0.0) & (log > 0.0)
    one, other = np.where(share, log, 1.0), np.where(share, said, 1.0)
    phi, file_phi = np.where(share, np.log(one), log), np.where(share, np.log(other), said)
    right = np.where(share, -np.log1p(-np.minimum(sheet / other, 0.99)), sheet)
    t = compared(phi, sd / one, file_phi, right, share, -np.inf, phi).t
    chance = chances(t)
    verdicts = verdicts_of(contradicted(chance), sd <= sheet)
    worth = weights(model, others, anywhere(model))
    return in_order(
        Line(
            n.of, n.what, n.unit, "", float(said[i]), float(sheet[i]), float(log[i]), float(sd[i]),
            float(t[i]), float(chance[i]), verdicts[i], worth[i], "",
        )
        for i, (n, _) in enumerate(rows)
    )  # fmt: skip


def _moved(
    system: System, theta: FloatArray
) -> Iterator[tuple[float, tuple[mujoco.MjModel, mujoco.MjModel]]]:
    """Of each parameter the models at two values about theta (d,), and their distance on its scale."""
    space = system.space
    for i, p in enumerate(space.parameters):
        ways = np.array([[-1.0], [1.0]]) * _STEP * p.prior_sd * np.eye(len(theta))[i]
        low, high = (
            system.edits.apply(system.model, theta_of(space.log, space.phi_of(theta) + way)) for way in ways
        )
        yield 2.0 * _STEP * p.prior_sd, (low, high)
