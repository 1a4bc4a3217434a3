"""After the search: how well the estimate is known, how well it predicts, and what to show."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import NOTE
from amhe_cli.core.log import Window
from amhe_cli.core.statistics import correlation, part_of, positive
from amhe_cli.estimation.offline.bodies import body_numbers
from amhe_cli.estimation.offline.checks import (
    REFITS,
    blamed,
    disagreements,
    left_out,
    report_drift,
    report_misfit,
    report_unsettled,
    unexplained,
)
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.combinations import combinations
from amhe_cli.estimation.offline.fits import fits, profiles
from amhe_cli.estimation.offline.held_out import judge, validate, with_own_values
from amhe_cli.estimation.offline.horizon import HORIZONS, STARTS, horizon_errors
from amhe_cli.estimation.offline.minima import SHARE, second_minimum
from amhe_cli.estimation.offline.mount import report_mount
from amhe_cli.estimation.offline.posterior import (
    PROFILED,
    TURNS,
    Disagreement,
    FinalFit,
    Finding,
    bootstrap,
    doubled_step,
    final_fit,
)
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.result import ClipCount, HeldOut, Identification, Sampled
from amhe_cli.estimation.offline.runs import each_run, estimates, runs_that_differ, spread_between
from amhe_cli.estimation.offline.sampled import ENOUGH, USUAL, SampledPosterior, sampled_posterior
from amhe_cli.estimation.offline.shifts import shifts_of
from amhe_cli.estimation.offline.verdicts import Evidence, Shift, interval, verdicts
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.offline.widening import (
    along_vectors,
    contradicted,
    directions,
    in_directions,
    of_one_cause,
    repeated,
    scattered,
    variances,
)

logger = logging.getLogger(__name__)

#: Parts of a conclusion, for its progress, and linearisations of all clips that it needs at least.
PARTS, RESERVE = 10, 3
#: Clips from which a bootstrap widens.
FEWEST_RESAMPLED = 10


def conclude(
    problem: Problem, finding: Finding, validation: list[Window], watch: Watch, *, sampled: bool = False
) -> Identification:
    """All results of a finished, or interrupted, search.

    Args:
        problem: The problem that was searched.
        finding: Result of the search.
        validation: Clips that were not fitted.
        watch: Shows progress, and decides for which of the slow checks there is time: held-out clips from
            fitted first states, the comparison of the logs' halves, shifts under other models, profiles.
            After an interruption there is for none.
        sampled: Draw from the posterior under the true cost, too, and take the intervals from the draws.
    """
    system = problem.system
    watch.enter("covariance")
    fit = final_fit(problem, finding, watch)
    validation, own = with_own_values(problem, validation, fit.z, fit.shape, fit.scale)
    for text in own:
        logger.log(NOTE, text)
    held_out, against = _validated(problem, finding, fit, validation, watch)
    shown = unexplained(system, fit)
    if finding.done:
        advice = "; compare measured with predicted in the report, and free what the model may lack"
        report_misfit(system, fit)
        report_unsettled(problem, finding, fit)
    else:  # of a search that was cut short, misfit says nothing of the model
        against, shown, advice = (watch.short,) * bool(against or shown), (), ""
    for text in against:
        logger.warning(f"{text}: no value is called identified{advice}")
    if held_out and watch.allows("error against horizon", _predictions(problem, validation)):
        held_out = replace(held_out, horizons=horizon_errors(problem, validation, finding.z))
    if finding.done and watch.allows("residuals of a mount", len(problem.clips)):
        report_mount(problem, fit)
    evidence, systematic, drawn = _evidence(problem, finding, fit, (*against, *shown), watch, sampled)
    watch.report_skipped()
    watch.enter("predictions for the report")
    return Identification(
        system=system.name,
        method="cmaes" if isinstance(finding, CmaState) else "linearised",
        parameters=verdicts(system.space, evidence),
        belief=belief_of(system, finding.z, evidence.covariance, systematic=systematic),
        correlations=correlation(evidence.covariance),
        combinations=combinations(system.space, evidence.covariance, problem.active),
        held_out=held_out,
        iterations=finding.record,
        rollouts=sum(i.rollouts for i in finding.record),
        diverged=sum(i.diverged for i in finding.record),
        clips=ClipCount(
            fitted=len(problem.clips),
            held_out=len(validation),
            motionless=problem.pool.motionless,
            across_gaps=problem.pool.across_gaps,
            thinned=problem.thinned,
        ),
        noise_scale=fit.scale,
        unexplained=tuple(evidence.unexplained),
        exact=evidence.exact,
        fits=fits(problem, finding.z, validation or list(problem.clips), bool(validation)),
        interrupted=watch.interrupted,
        bodies=body_numbers(system, finding.z, evidence.covariance, problem.rng(5)),
        logs=tuple(dict.fromkeys(part.log.source for part in problem.pool.parts)),
        runs=estimates(system.space, finding.z, each_run(problem, finding.z, fit)),
        sampled=drawn,
    )


def _validated(
    problem: Problem, finding: Finding, fit: FinalFit, validation: Sequence[Window], watch: Watch
) -> tuple[HeldOut | None, tuple[str, ...]]:
    """Costs and errors on held-out clips, and what speaks against every value, in words."""
    held_out, against = validate(problem, validation, finding), left_out(fit)
    if not held_out or not watch.allows("held-out clips from fitted first states", problem.linearisation):
        return held_out, against
    judged = judge(problem, validation, fit)
    held_out = replace(
        held_out,
        fitted_cost=judged.cost,
        initial_fitted_cost=judged.initial_cost,
        noise_scale=judged.noise_scale,
        errors=judged.errors,
    )
    return held_out, (*against, *judged.against)


def _predictions(problem: Problem, validation: Sequence[Window]) -> int:
    """Rollouts of errors against the horizon, counted in clips."""
    seconds = STARTS * sum(HORIZONS) + sum(part.duration for part in validation)
    return round(2.0 * seconds * len(problem.clips) / sum(clip.duration for clip in problem.clips))


def _sampled(problem: Problem, fit: FinalFit, watch: Watch) -> SampledPosterior | None:
    """Draws from the posterior under the true cost; None where there is no time, or they did not settle."""
    draws = problem.settings.identify.draws
    if not watch.allows("sampled posterior", USUAL * draws * len(problem.clips)):
        return None
    found = sampled_posterior(problem, fit)
    if found.effective >= ENOUGH * draws:
        return found
    logger.warning(
        f"the sampled posterior did not settle ({found.effective:.0f} of {draws} draws are effective), as "
        f"where a cost jitters behind contacts: the intervals are the linearised ones"
    )
    return None


def _evidence(
    problem: Problem,
    finding: Finding,
    fit: FinalFit,
    against: Sequence[str],
    watch: Watch,
    sampled: bool,
) -> tuple[Evidence, FloatArray, Sampled | None]:
    """All that is known about how accurate the estimate is, and draws of the posterior if there are any.

    Between the two is the part of the covariance that comes from the model, shape (d, d).
    """
    space, setting, once = problem.system.space, problem.settings.identify, problem.linearisation
    own = fit.posterior.covariance
    doubled = own
    drawn = _sampled(problem, fit, watch) if sampled else None
    if drawn is None and watch.affords(once):
        watch.enter("covariance from wider samples")
        doubled = doubled_step(problem, finding, fit).covariance
    halves = watch.allows("comparison of the logs' halves", (REFITS + TURNS) * once)
    compared = disagreements(problem, finding, fit, with_halves=halves)
    alone = each_run(problem, finding.z, fit)
    differing = runs_that_differ(problem, alone)
    between = spread_between(alone, differing) if differing else np.zeros(len(space))
    report_drift(space, compared)
    shifts, exact = [], ()
    if watch.allows("shifts under other models", once):
        shifts, exact = shifts_of(problem, fit)
    again = repeated(fit, space.loose_precision)
    prior, resamples = space.prior_precision, setting.bootstrap
    resampled = bootstrap(finding.z, fit.found, fit.weight, prior, resamples, problem.rng(4))
    widening, systematic, causes = _widened(
        problem, fit, compared, between, shifts, doubled, resampled, again
    )
    if space.prior_systematic is not None:
        # the prior errs as these logs do, each by its share of the estimate
        share = np.linalg.solve(fit.posterior.hessian, prior)
        carried = share @ np.array(space.prior_systematic) @ share.T
        rest = np.eye(len(space)) - share
        joined = of_one_cause(carried, rest @ systematic @ rest.T)
        widening = positive(widening - systematic) + joined - carried
        systematic = joined
    covariance, rival = own + widening, None
    searched = SHARE * sum(entry.rollouts for entry in finding.record)
    if drawn is None and watch.allows("search for a second minimum", searched):  # draws find it
        rival = second_minimum(problem, finding, fit, covariance)
    if rival is not None:
        away = rival.share * np.outer(rival.z - fit.z, rival.z - fit.z)
        covariance, causes = covariance + away, causes | {"another minimum explains the logs": np.diag(away)}
    draws, beside = None, None
    if drawn is not None:
        draws, beside = _spread(problem, fit, drawn, covariance)
        covariance = (draws - finding.z).T @ (draws - finding.z) / len(draws)
    evidence = Evidence(
        z=finding.z,
        covariance=covariance,
        own_sd=fit.posterior.sd,
        active=problem.active,
        idle=problem.idle,
        step_ratio=np.where(
            problem.active & (drawn is None), np.sqrt(np.diag(own) / np.diag(doubled)), np.nan
        ),
        bootstrap=resampled.std(axis=0),
        disagreements=compared | differing,
        shifts=shifts,
        profiles=_profiles(problem, fit, np.sqrt(np.diag(covariance)), watch),
        unexplained=against,
        rough=problem.rough,
        repeats=np.sqrt(1.0 + np.diag(again) / np.diag(own)),
        causes=causes,
        rival=rival,
        draws=draws,
        exact=exact,
        blamed=blamed(problem.system, fit) if finding.done else {},
    )
    return evidence, part_of(covariance, systematic), beside


def _spread(
    problem: Problem, fit: FinalFit, drawn: SampledPosterior, covariance: FloatArray
) -> tuple[FloatArray, Sampled]:
    """Draws of z with a covariance (d, d), shape (n, d), and what a report shows of them."""
    space, sds = problem.system.space, np.sqrt(np.diag(covariance))
    draws = drawn.spread(problem, fit, covariance)
    linearised = {name: interval(space, fit.z, sds[i], i) for i, name in enumerate(space.names)}
    return draws, Sampled(space.theta_of(draws), drawn.effective, drawn.rollouts, linearised)


def _profiles(
    problem: Problem, fit: FinalFit, sd: FloatArray, watch: Watch
) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Cost along each parameter, as far as its sd of z (d,) demands; none where there is no time."""
    points = problem.settings.identify.profile_points
    unknowns = problem.active.sum() if problem.reach is None else problem.reach.unknowns(False)
    rollouts = points * int(unknowns) * min(len(problem.clips), PROFILED)
    return profiles(
        problem.system.space,
        lambda rows, values: fit.costs_along(rows, values, problem.reach),
        fit.z,
        sd,
        problem.active,
        points if watch.allows("cost profiles", rollouts) else 0,
    )


def _widened(
    problem: Problem,
    fit: FinalFit,
    compared: Mapping[str, Disagreement],
    between: FloatArray,
    shifts: Sequence[Shift],
    doubled: FloatArray,
    resampled: FloatArray,
    again: FloatArray,
) -> tuple[FloatArray, FloatArray, dict[str, FloatArray]]:
    """Covariance of z beyond what noise explains (d, d), what of it comes from the model, and its causes.

    The causes are in words, with their variances (d,). What comes from the model is the same in other logs.

    Args:
        problem: The problem that was searched.
        fit: Its final linearisation.
        compared: Differences between parts of the data.
        between: Sd of z from run to run, shape (d,).
        shifts: What changes of the model would do to the estimate.
        doubled: Posterior covariance from samples twice as wide, shape (d, d).
        resampled: Steps to the estimates from resampled clips, shape (b, d).
        again: What residuals that repeat add, shape (d, d).
    """
    space, own, active = problem.system.space, fit.posterior.covariance, problem.active
    found = directions(own, active)
    declared = space.in_z([problem.settings.identify.model_error.get(name, 0.0) for name in space.names])
    known, runs = np.zeros((2, len(found.rows)))
    known[: active.sum()], runs[: active.sum()] = declared[active] ** 2, between[active] ** 2
    sizes = {
        "parts of the data disagree": np.maximum(contradicted(found.rows, compared.values()), runs),
        "it grows when the step is doubled": np.maximum(variances(found.rows, doubled - own), 0.0),
        "`identify.model_error` says so": known,
    }
    # of a few clips, resamples lack whole directions
    steps = resampled if np.count_nonzero(fit.weight) >= FEWEST_RESAMPLED else np.full_like(resampled, np.nan)
    excess = scattered(found.rows, steps, own)
    wanted = np.maximum(sum(sizes.values()), excess)
    spreads = [shift.spread for shift in shifts]
    causes = {cause: _of_all(size, active) for cause, size in sizes.items()} | {
        "clips differ by more than noise": _of_all(excess, active),
        "residuals repeat, which noise does not": np.diag(again),
        "it depends on details of the model": sum((s**2 for s in spreads), np.zeros(active.size)),
        "the search was still moving": fit.left**2,
    }
    total = in_directions(found, wanted, again) + along_vectors(own, [*spreads, fit.left])
    return total, in_directions(found, known, again) + along_vectors(own, spreads), causes


def _of_all(sizes: FloatArray, active: BoolArray) -> FloatArray:
    """Variances of all parameters (d,) from those of `directions` (m,), the first of which are the active."""
    of_all = np.zeros(active.size)
    of_all[active] = sizes[: active.sum()]
    return of_all
