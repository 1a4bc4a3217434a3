"""After the search: how well the estimate is known, how well it predicts, and what to show."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray
from amhe_cli.core.parameters import belief_of
from amhe_cli.core.statistics import correlation
from amhe_cli.core.trajectory import Window
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.variants import contact_variants
from amhe_cli.estimation import cma, search
from amhe_cli.estimation.fits import fits
from amhe_cli.estimation.identifiability import SURPRISE, Evidence, combinations, profiles, verdicts
from amhe_cli.estimation.linearised import Information, Linearisation, information, linearise
from amhe_cli.estimation.posterior import (
    Posterior,
    bootstrap_sd,
    by_kind,
    disagreement,
    posterior,
)
from amhe_cli.estimation.problem import ROUGH, Problem, spread_floor
from amhe_cli.estimation.result import ClipCount, HeldOut, Identification
from amhe_cli.matching import MatchingCost

logger = logging.getLogger(__name__)

#: What a search ends with.
Finding = search.State | cma.State

#: Drift within the logs is reported if it is also this share of a prior sd.
DRIFT_SHARE = 0.05
HALVES = "the first and second half of the logs"
#: Iterations that each half gets to find its own estimate, and the clips that it must have.
REFITS, FEWEST_CLIPS = 3, 3


def conclude(
    problem: Problem, finding: Finding, validation: list[Window], interrupted: bool
) -> Identification:
    """Everything that is reported of a finished, or interrupted, search."""
    system, setting = problem.system, problem.settings.identify
    study = _study(problem, finding)
    active = problem.active
    disagreements = _disagreements(problem, finding, study)
    _report_drift(problem, disagreements)
    shifts = _shifts(problem, finding, study)
    covariance = study.posterior.covariance + np.diag(
        systematic(study.posterior, disagreements, shifts) * active
    )
    some = _thinned(problem, np.arange(len(problem.tiles)))
    cost = MatchingCost(system, some, problem.engine, problem.settings.cost)
    evidence = Evidence(
        z=finding.z,
        covariance=covariance,
        active=active,
        step_ratio=_step_ratio(problem, finding, study),
        bootstrap=bootstrap_sd(finding.z, study.found, study.weight, setting.bootstrap, problem.rng(4)),
        disagreements=disagreements,
        shifts=shifts,
        profiles=profiles(
            system.space, cost.costs, finding.z, np.sqrt(np.diag(covariance)), active, setting.profile_points
        ),
    )
    return Identification(
        system=system.name,
        method="cmaes" if isinstance(finding, cma.State) else "linearised",
        parameters=verdicts(system.space, evidence),
        belief=belief_of(system.name, system.space, finding.z, covariance, {}),
        correlations=correlation(covariance),
        combinations=combinations(system.space, covariance, active),
        held_out=validate(problem, validation, finding),
        iterations=finding.record,
        rollouts=sum(i.rollouts for i in finding.record),
        diverged=sum(i.diverged for i in finding.record),
        clips=ClipCount(
            fitted=len(problem.tiles),
            held_out=len(validation),
            motionless=problem.pool.motionless,
            across_gaps=problem.pool.across_gaps,
        ),
        noise_scale=study.scale,
        fits=fits(problem, finding.z, validation or list(problem.tiles), bool(validation)),
        interrupted=interrupted,
        logs=tuple(dict.fromkeys(s.trajectory.source for s in problem.pool.stretches)),
    )


def validate(problem: Problem, windows: list[Window], finding: Finding) -> HeldOut | None:
    """Costs and errors on clips that were not fitted, from their recorded first states."""
    if not windows:
        return None
    cost = MatchingCost(problem.system, windows, problem.engine, problem.settings.cost)
    z = np.stack((finding.z, np.zeros_like(finding.z)))
    costs, position, orientation = cost.costs(z), cost.errors(z, "position"), cost.errors(z, "orientation")
    return HeldOut(
        clips=len(windows),
        cost=float(costs[0]),
        initial_cost=float(costs[1]),
        position_error_m=_mean(position[0]),
        initial_position_error_m=_mean(position[1]),
        orientation_error_rad=_mean(orientation[0]),
        initial_orientation_error_rad=_mean(orientation[1]),
    )


def _mean(errors: FloatArray) -> float:
    return float(errors.mean()) if errors.size and not np.isnan(errors).all() else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class _Study:
    """The final linearisation on the tiles, and what it says."""

    slopes: Linearisation
    found: Information
    weight: FloatArray
    posterior: Posterior
    spread: FloatArray
    scale: Mapping[str, float]


def _study(problem: Problem, finding: Finding) -> _Study:
    """Linearise at the estimate: to learn the noise and how rough the cost is, then at a step that suits."""
    coverage = problem.coverage(problem.tiles)
    spread = spread_floor(problem, np.inf) * problem.active
    slopes = _linearised(problem, finding, finding.scale, spread, 0)
    found = information(slopes)
    if slopes.roughness <= ROUGH:
        sd = posterior(finding.z, found, search.clip_weights(slopes.cost, found) * coverage).sd
        spread = np.clip(2.0 * sd, spread_floor(problem, slopes.roughness), spread) * problem.active
    scale = search.noise_scale(slopes.cost, found, finding.scale)
    slopes = _linearised(problem, finding, scale, spread, 1)
    found = information(slopes)
    weight = search.clip_weights(slopes.cost, found) * coverage
    return _Study(slopes, found, weight, posterior(finding.z, found, weight), spread, scale)


def _step_ratio(problem: Problem, finding: Finding, study: _Study) -> FloatArray:
    """Sqrt of each parameter's information at a doubled step over that at the step, shape (d,)."""
    doubled = information(_linearised(problem, finding, study.scale, 2.0 * study.spread, 2))
    data = np.einsum("c,cii->i", study.weight, study.found.matrix)
    return np.sqrt(np.einsum("c,cii->i", study.weight, doubled.matrix) / np.where(data > 0.0, data, np.nan))


def _linearised(
    problem: Problem, finding: Finding, scale: Mapping[str, float], spread: FloatArray, place: int
) -> Linearisation:
    cost = problem.cost(problem.tiles, scale)
    first = np.zeros((len(problem.tiles), cost.nx if problem.settings.identify.first_state else 0))
    samples = problem.settings.identify.samples
    return linearise(cost, finding.z, first, spread, samples, problem.rng(3, place))


def _disagreements(
    problem: Problem, finding: Finding, study: _Study
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Estimates from one part of the data against another: under a right model they agree.

    Returns:
        What is compared -> (difference, its sd), each (d,) in z.
    """
    kinds = [_kind(o.channel.key) for o in study.slopes.cost.clips.observed]
    alone = by_kind(finding.z, study.slopes, study.weight, kinds)
    names = list(alone)
    compared = {
        f"{one} and {other} data": disagreement(alone[one], alone[other])
        for i, one in enumerate(names)
        for other in names[i + 1 :]
    }
    if (parts := _halves(problem, finding)) is not None:
        compared[HALVES] = parts
    logs = _later_logs(problem.tiles)
    if _both(logs):
        earlier, later = (posterior(finding.z, study.found, study.weight * side) for side in (~logs, logs))
        compared["the earlier and the later logs"] = disagreement(later, earlier)
    return compared


def _halves(problem: Problem, finding: Finding) -> tuple[FloatArray, FloatArray] | None:
    """What the second half of the logs wants more than the first, and the sd of that, each (d,).

    Each half is searched by itself: where they differ much, the misfit of their compromise looks like
    noise, and would hide that they do.
    """
    late = np.array([w.start + 0.5 * w.length > 0.5 * (w.trajectory.steps - 1) for w in problem.tiles])
    if not _both(late):
        return None
    means, variances = [], []
    for side in (late, ~late):
        part = replace(problem, only=_thinned(problem, np.flatnonzero(side)))
        state = search.restart(part, finding.z)
        for _ in range(REFITS):
            state = search.advance(part, state)
        found = _study(part, state).posterior
        means.append(state.z + found.step)
        variances.append(np.diag(found.data_covariance))
    return means[0] - means[1], np.sqrt(variances[0] + variances[1])


def _thinned(problem: Problem, rows: IntArray) -> tuple[Window, ...]:
    """The tiles of these rows, evenly thinned to what one iteration takes."""
    most = problem.settings.clips.count
    if len(rows) > most:
        rows = rows[np.linspace(0, len(rows) - 1, most).round().astype(int)]
    return tuple(problem.tiles[i] for i in rows)


def _both(side: BoolArray) -> bool:
    """Enough clips on either side to compare them."""
    return min(side.sum(), (~side).sum()) >= FEWEST_CLIPS


def _later_logs(tiles: Sequence[Window]) -> BoolArray:
    """Which clips are of the second half of the logs; none where there is one log."""
    order = {source: i for i, source in enumerate(dict.fromkeys(w.trajectory.source for w in tiles))}
    return np.array([2 * order[w.trajectory.source] >= len(order) > 1 for w in tiles])


def systematic(
    found: Posterior,
    disagreements: Mapping[str, tuple[FloatArray, FloatArray]],
    shifts: Mapping[str, FloatArray],
) -> FloatArray:
    """Variance of z beyond what noise explains, shape (d,).

    Where parts of the data disagree by more than chance, or details of contact that nobody measured move
    the estimate, no part is known to be right: half the difference is added as a standard deviation, as
    random-effects models do.
    """
    extra = np.zeros(len(found.step))
    sd = np.sqrt(np.diag(found.covariance))
    for difference, chance in (*disagreements.values(), *((shift, sd) for shift in shifts.values())):
        beyond = np.maximum(difference**2 - (SURPRISE * chance) ** 2, 0.0)
        extra = np.maximum(extra, 0.25 * beyond)
    return extra


def _kind(key: str) -> str:
    return key.rsplit(".", 1)[1].replace("_", " ")


def _shifts(problem: Problem, finding: Finding, study: _Study) -> dict[str, FloatArray]:
    """Where the estimate would move if unmeasured details of contact were others."""
    system = problem.system
    shifts = {}
    for name, model in contact_variants(system.model).items():
        engine = CpuEngine(model, system.edits, system.input_spec, problem.threads, system.senses)
        cost = MatchingCost(system, problem.tiles, engine, problem.settings.cost, study.scale)
        residuals = cost.residuals(finding.z[None])
        both = study.slopes.completed & residuals.completed[0]
        moved = information(replace(study.slopes, residual=residuals.flat[0], completed=both))
        there = posterior(finding.z, moved, study.weight * both)
        shifts[name] = there.step - study.posterior.step
    return shifts


def _report_drift(problem: Problem, disagreements: Mapping[str, tuple[FloatArray, FloatArray]]) -> None:
    """Warn where the logs' first and second half want different parameters."""
    if HALVES not in disagreements:
        return
    difference, sd = disagreements[HALVES]
    space = problem.system.space
    for i in np.flatnonzero((np.abs(difference) > SURPRISE * sd) & (np.abs(difference) > DRIFT_SHARE)):
        p = space.parameters[i]
        size = (
            f"{np.expm1(difference[i] * p.prior_sd):+.0%}"
            if p.log
            else f"{difference[i] * p.prior_sd:+.2g} {p.unit}"
        )
        logger.warning(
            f"{p.name} drifts within the logs: their second half wants {size} against the first "
            f"({abs(difference[i]) / sd[i]:.1f} sd): one constant value does not describe them"
        )
