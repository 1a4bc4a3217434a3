"""Quantities derived from an estimate and its covariance: products, inertias, efforts of joints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import correlation
from amhe_cli.estimation.core.result import Against, Combination, HeldOut, ParameterResult, Reason, SpanError
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty.fit import FinalFit
from amhe_cli.estimation.uncertainty.ledger import Ledger
from amhe_cli.estimation.uncertainty.verdicts import TOGETHER, verdict_of
from amhe_cli.matching.efforts import path_of
from amhe_cli.system.model.elements import dofs_of
from amhe_cli.system.parameters.inertia import inertia_of
from amhe_cli.system.system import System

#: Draws of the posterior.
_DRAWS = 2000


#: Smallest exponent of a combination: a smaller one rounds to 0.
EXPONENT = 0.05
#: A number is known where its sd is below this share of its prior's.
_KNOWN = 0.5
#: Numbers of friction.
_RUBS = ("dof_damping", "dof_frictionloss")
#: Step of a parameter, in its prior sd, for its slope.
_STEP = 1e-4
#: Slopes below this share of a body's largest number of the kind are rounding.
_ROUNDING = 1e-9


def body_numbers(
    system: System, z: FloatArray, ledger: Ledger, rng: np.random.Generator, misfit: Sequence[Against]
) -> tuple[ParameterResult, ...]:
    """Mass, centre of mass and inertia of each body whose `pseudo_inertia` is a parameter.

    The axes are the body's; the inertia is about its centre of mass. Sd and intervals are those of draws of
    the posterior, since they are no linear function of z; verdicts and budgets are read from the ledger along
    their slopes.

    Args:
        system: The system; its space is that of the search.
        z: The estimate, shape (d,).
        ledger: Its ledger.
        rng: Source of the draws.
        misfit: What speaks against every value.
    """
    if not system.edits.bodies:
        return ()
    space, count = system.space, len(z)
    draws = rng.multivariate_normal(z, ledger.covariance, _DRAWS, method="cholesky")
    theta = _model_values(system, np.stack((z, np.zeros(count), *z + _STEP * np.eye(count), *draws)))
    found = []
    for name, numbers in system.edits.inertias(theta):
        own = [one for one in space.names if inertia_of(one) == name]
        for label, (estimate, prior, *values) in numbers.items():
            near, drawn = np.split(np.array(values), [count])
            slope, line = (near - estimate) / _STEP, f"{name}.{label}"
            like = max(abs(values[0]) for other, values in numbers.items() if other[0] == label[0])
            slope[np.abs(slope) < _ROUNDING * like] = 0.0
            before = float(np.sqrt(slope @ space.prior_covariance @ slope))
            known, verdict, given = ledger.mapped(slope[None] / (before or 1.0)), "prior", ""
            if before:  # else it is fixed
                verdict, given = verdict_of(known, 0, own, misses=bool(misfit))
            lower, upper = np.quantile(drawn, (0.05, 0.95)).tolist()
            found.append(
                ParameterResult(
                    name=line,
                    unit="kg" if label == "mass" else "m" if label.startswith("com") else "kg m^2",
                    estimate=estimate,
                    prior=prior,
                    prior_sd=before,
                    sd=float(np.std(drawn)) if before else 0.0,
                    lower=lower,
                    upper=upper,
                    bounds=(0.0 if label == "mass" else -np.inf, np.inf),
                    shrinkage=1.0 - float(known.sd[0]) if before else 0.0,
                    verdict=verdict,
                    reasons=(
                        *(Reason("misfit", (line,), 1.0, one.text) for one in misfit),
                        *([Reason("prior", (line,), 1.0, f"given {given}")] if given else []),
                    ),
                    budget=known.budget(0),
                    given=given,
                )
            )
    return tuple(found)


def _model_values(system: System, z: FloatArray) -> FloatArray:
    """The model's free parameters at points (n, d) of the search; what is not searched is nominal."""
    model = system.edits.space
    places = {name: place for place, name in enumerate(model.names)}
    own = [i for i, name in enumerate(system.space.names) if name in places]
    values = np.tile(model.nominal, (len(z), 1))
    values[:, [places[system.space.names[i]] for i in own]] = system.space.theta_of(z)[:, own]
    return values


def combinations(
    space: ParameterSpace, covariance: FloatArray, active: np.ndarray
) -> tuple[Combination, ...]:
    """Products of log-scaled parameters that are known much better, or worse, than each alone.

    A share k on the linear scale, such as friction's of a load, is in them as 1 + k. For every strongly
    correlated pair, the eigenvectors of its covariance in logarithms: the sharp one is what the data
    determine, the blunt one what they leave open.
    """
    matrix = correlation(covariance)
    shares = [p.unit == "-" and -1.0 < p.lower < 0.0 and not p.log for p in space.parameters]
    relative = space.prior_sd / np.where(shares, 1.0 + space.nominal, 1.0)
    scale, factors = np.outer(relative, relative), space.log | shares
    names = [f"(1 + {name})" if share else name for name, share in zip(space.names, shares, strict=True)]
    phi, prior = covariance * scale, space.prior_covariance * scale
    found = []
    for i in range(len(space)):
        for j in range(i + 1, len(space)):
            together = active[i] and active[j] and abs(matrix[i, j]) > TOGETHER
            if together and factors[i] and factors[j]:
                found += _pair(space.names, names, phi, prior, (i, j))
    return tuple(found)


def _pair(
    names: Sequence[str], factors: Sequence[str], phi: FloatArray, prior: FloatArray, pair: tuple[int, int]
) -> list[Combination]:
    """Combinations of two parameters, from posterior and prior covariance of all logarithms, (d, d)."""
    block = np.ix_(pair, pair)
    values, vectors = np.linalg.eigh(phi[block])
    result = []
    for value, vector in zip(values, vectors.T, strict=True):
        powers = vector / vector[np.argmax(np.abs(vector))]
        before = float(np.sqrt(powers @ prior[block] @ powers))
        sd = float(np.sqrt(value) * np.linalg.norm(powers))
        if np.abs(powers).min() >= EXPONENT:
            text = _product([factors[i] for i in pair], powers)
            result.append(Combination(text, sd, 1.0 - sd / before, tuple(names[i] for i in pair)))
    return result


def _product(names: Sequence[str], powers: FloatArray) -> str:
    """'mass * friction^0.9', 'gain / mass'."""
    factors = sorted(zip(map(float, powers), names, strict=True), reverse=True)
    text = _power(factors[0][1], factors[0][0])
    for power, name in factors[1:]:
        text += f" {'*' if power > 0.0 else '/'} {_power(name, abs(power))}"
    return text


def _power(name: str, power: float) -> str:
    return name if abs(power - 1.0) < 0.05 else f"{name}^{power:.1f}"


def summary_of_efforts(fit: FinalFit, covariance: FloatArray, held_out: HeldOut | None) -> tuple[str, ...]:
    """How many numbers the motion determines and how well it tells them apart; then a verdict on each joint.

    Where efforts are linear in the unknowns, those numbers are the base parameters (Gautier and Khalil 1990).

    Args:
        fit: The linearisation at the estimate.
        covariance: The estimate's covariance, shape (d, d).
        held_out: Errors on clips that were not fitted.
    """
    problem, system = fit.problem, fit.problem.system
    path = path_of(system, problem.clips[0].log)
    known = np.linalg.eigvalsh(fit.posterior.hessian - fit.posterior.prior)
    better = known[known > 1.0]
    band, rate = float(path.motion.band.max()), 1.0 / (path.every * system.dt)
    speed = np.sqrt((path.motion.qvel**2).mean(axis=0))
    return (
        f"this motion determines {better.size} of {known.size} numbers better than their priors do "
        f"(condition number {np.sqrt(better.max(initial=1.0) / better.min(initial=1e300)):.0f}); it reaches "
        f"{band:.2g} Hz, and efforts are compared {rate:.2g} times a second",
        *_joints(system, fit.z, covariance, speed, _missed(problem, held_out)),
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
    """'elbow: friction known to 4 %, inertia in 3 of 10 combinations, torque error 0.3 N m (1.2 before)'."""
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
            parts.append(f"friction known to {100.0 * share:.2g} %" if share < 1.0 else "friction not known")
        if inert:
            values = np.linalg.eigvalsh(covariance[np.ix_(inert, inert)])
            count = int((values < _KNOWN**2).sum())
            several = f"inertia in {count} of {len(inert)} combinations" if count else "inertia as given"
            parts.append("inertia known" if count == len(inert) else several)
        if (error := missed[dof]) is not None:
            parts.append(f"torque error {error.identified:.2g} {unit} ({error.initial:.2g} before)")
        if parts:
            yield f"{one.name}: {', '.join(parts)}"


def _friction(
    system: System, z: FloatArray, covariance: FloatArray, rows: list[int], dof: int, speed: float
) -> float:
    """Sd of a joint's friction at its usual speed, as a share of it."""
    theta = system.space.theta_of(np.concatenate((z[None], z + _STEP * np.eye(len(z))[rows])))
    fields: dict[str, FloatArray] = {field: getattr(system.model, field)[None] for field in _RUBS}
    fields |= system.edits.written(theta)
    viscous, dry = (np.broadcast_to(fields[field][:, dof], len(theta)) for field in _RUBS)
    size, *near = viscous * speed + dry
    slopes = (np.array(near) - size) / _STEP
    variance = slopes @ covariance[np.ix_(rows, rows)] @ slopes
    return float(np.sqrt(variance) / size) if size > 0.0 else np.inf
