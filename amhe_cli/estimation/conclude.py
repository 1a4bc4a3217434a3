"""After the search: how well the estimate is known, how well it predicts, and what to show."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import NOTE
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import part_of
from amhe_cli.estimation.core.result import Against, ClipCount, HeldOut, Identification, Missing
from amhe_cli.estimation.explain.explain import explain
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SETTLED, SearchState, restart
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty import terms
from amhe_cli.estimation.uncertainty.assumed import assumed
from amhe_cli.estimation.uncertainty.derived import body_numbers, combinations, summary_of_efforts
from amhe_cli.estimation.uncertainty.fit import TURNS, FinalFit, Finding, doubled_prior, final_fit
from amhe_cli.estimation.uncertainty.hierarchy import WithMeans, with_common_means
from amhe_cli.estimation.uncertainty.ledger import LEAST, Ledger
from amhe_cli.estimation.uncertainty.minimum import SHARE, Rival, better, report_minima, second_minimum
from amhe_cli.estimation.uncertainty.misfit import (
    ASKED,
    blamed,
    left_out,
    misfits,
    report_misfit,
    still_moving,
    unexplained,
)
from amhe_cli.estimation.uncertainty.parts import REFITS, estimates, parts, report_drift
from amhe_cli.estimation.uncertainty.verdicts import Evidence, verdicts
from amhe_cli.estimation.validation.held_out import fits, judge, validate, with_own_values
from amhe_cli.estimation.validation.prediction import HORIZONS, STARTS, horizon_errors
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

#: Parts of a conclusion, for its progress.
PARTS = 9
#: Linearisations of all clips that a conclusion needs at least.
RESERVE = 3
#: Steps that a settled search may still take with the noise that it has left.
STEPS = 2


@dataclass(frozen=True, eq=False)
class Search:
    """A search that ended.

    Args:
        problem, finding: The problem and where the search ended.
        validation: Clips that were not fitted.
        watch: Shows progress of what follows, and has the time that is left.
        model: Parameters of the model, with their prior; logs may have values of their own of some.
        without: The search that did not fit the clips to validate on, if this one fits them too.
    """

    problem: Problem
    finding: Finding
    validation: list[Window]
    watch: Watch
    model: ParameterSpace
    without: Search | None = None

    @cached_property
    def fit(self) -> FinalFit:
        """The linearisation of all clips where it ended."""
        return final_fit(self.problem, self.finding, self.watch)

    def again(self, problem: Problem) -> SearchState:
        """Where a search with the same parameters under other priors begins."""
        before, space, ended = self.problem.system.space, problem.system.space, self.finding
        z, wider = space.clip(space.z_of(before.theta_of(ended.z))), before.prior_sd / space.prior_sd
        shape = wider[:, None] * ended.shape if isinstance(ended, SearchState) and ended.straight else None
        return restart(problem, z, shape, scale=ended.scale if problem.quick else None)


def conclude(search: Search, *, quick: bool = False) -> Identification:
    """All results of a finished, or interrupted, search.

    Its watch decides for which of the slow checks there is time: held-out clips from fitted first states, the
    comparison of the logs' halves, what rests on assumed values, a second minimum. After an
    interruption there is for none. `quick`: halves of the logs have no searches of their own.
    """
    problem, system, watch = search.problem, search.problem.system, search.watch
    watch.enter("covariance")
    fit, rival = _best(_settled(search.fit, watch), watch)
    finding = fit.finding
    apart = search.without.fit if search.without else fit
    validation, held_out, misfit = _judged(fit, apart, search.validation, watch)
    missing = _missing(fit, watch)
    ledger, exact = _ledger(fit, rival, watch, quick)
    lines = with_common_means(system.space, search.model, fit.z, ledger)
    space, covariance = lines.space, lines.ledger.covariance
    evidence = _evidence(fit, lines, misfit, rival)
    _report_budget(system, ledger)
    watch.report_skipped()
    watch.enter("predictions for the report")
    belief = belief_of(
        replace(system, space=space),
        lines.z,
        covariance + np.diag(lines.next_log),
        systematic=part_of(covariance, lines.ledger.shared),
        owed=lines.ledger.owed,
    )
    return Identification(
        system=system.name,
        method="cmaes" if isinstance(finding, CmaState) else "linearised",
        parameters=verdicts(space, evidence),
        belief=belief,
        validated=replace(belief, estimate=space.theta_of(lines.of(apart.z))),
        correlations=evidence.correlations,
        combinations=combinations(space, covariance, evidence.active),
        spreads=lines.spreads,
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
            refitted=search.without is not None,
        ),
        noise_scale=fit.scale,
        unexplained=tuple(evidence.misfit),
        exact=exact,
        fits=fits(problem, apart.z, validation or list(problem.clips), bool(validation)),
        interrupted=watch.interrupted,
        settled=not (watch.cut_short or still_moving(fit)),
        bodies=body_numbers(system, fit.z, ledger, problem.rng(5), misfit),
        logs=tuple(dict.fromkeys(part.log.source for part in problem.pool.parts)),
        runs=estimates(fit),
        missing=missing,
        determined=summary_of_efforts(fit, ledger.covariance, held_out) if system.match == "effort" else (),
        information=fit.posterior.hessian - fit.posterior.prior,
        unbounded=fit.z + fit.posterior.step,
    )


def _evidence(fit: FinalFit, lines: WithMeans, misfit: Sequence[Against], rival: Rival | None) -> Evidence:
    """Evidence for the verdict of each line; of a common mean the same is said as of its first value."""
    problem, against = fit.problem, blamed(fit) if fit.finding.done else {}
    moves, alone = doubled_prior(fit), [len(rows) == 1 for rows in lines.rows]
    firsts = [rows[0] for rows in lines.rows]
    names = {name: fit.space.names[i] for name, i in zip(lines.space.names, firsts, strict=True)}
    return Evidence(
        z=lines.z,
        ledger=lines.ledger,
        active=lines.of(problem.active) > 0.0,
        idle={name: problem.idle[unknown] for name, unknown in names.items() if unknown in problem.idle},
        misfit=misfit,
        blamed={name: against[unknown] for name, unknown in names.items() if unknown in against},
        rival=rival and replace(rival, z=lines.of(rival.z), differs=lines.of(rival.differs) > 0.0),
        doubled_prior=np.where(alone, moves[firsts], np.nan),
        non_smooth=problem.non_smooth,
        means=lines.means,
        unbounded=lines.of(fit.z + fit.posterior.step),
    )


def _settled(fit: FinalFit, watch: Watch) -> FinalFit:
    """The search's result and its linearisation, after the steps that this still shows.

    The noise that the last iteration of a search assumed is not yet the one that is left after it.
    """
    for _ in range(STEPS):
        finding, short = fit.finding, (np.abs(fit.left) < SETTLED * fit.posterior.sd).all()
        smooth = isinstance(finding, SearchState) and finding.settled and not fit.problem.touches
        if short or not smooth or not watch.affords(2 * fit.slopes.rollouts):
            break
        fit = final_fit(fit.problem, replace(finding, z=fit.space.clip(fit.z + fit.left)), watch)
    return fit


def _best(fit: FinalFit, watch: Watch) -> tuple[FinalFit, Rival | None]:
    """The better one of two minima, and the other one; None where there is no other."""
    searched = SHARE * sum(entry.rollouts for entry in fit.finding.record)
    if not watch.allows("search for a second minimum", searched):
        return fit, None
    rival = second_minimum(fit)
    if rival is not None and rival.share > 0.5:
        there, rival = rival.z, rival.against(fit.z)
        fit = _settled(final_fit(fit.problem, better(fit, there, watch), watch), watch)
    if rival is not None:
        report_minima(fit, rival)
    return fit, rival


def _judged(
    fit: FinalFit, apart: FinalFit, windows: Sequence[Window], watch: Watch
) -> tuple[list[Window], HeldOut | None, tuple[Against, ...]]:
    """Clips held out of the fit `apart`, costs and errors on them, and what speaks against every value."""
    validation, notes = with_own_values(apart, windows)
    for text in notes:
        logger.log(NOTE, text)
    problem, held_out, against = apart.problem, validate(apart, validation), left_out(fit)
    if held_out and watch.allows("held-out clips from fitted first states", problem.linearisation):
        held_out, worse = judge(apart, validation, held_out)
        against = (*against, *worse)
    shown = unexplained(fit)
    if fit.finding.done:
        advice = "; compare measured with predicted in the report, and free what the model may lack"
        report_misfit(fit)
        if moving := still_moving(fit):
            logger.warning(
                f"the search stopped before it settled ({moving} was still moving): give it more with "
                "`identify.iterations`"
            )
    else:  # of a search that was cut short, misfit says nothing of the model
        against, shown, advice = (Against("short", watch.short),) * bool(against or shown), (), ""
    for one in against:
        logger.warning(f"{one.text}: no value is called identified{advice}")
    forwards = problem.system.match != "effort"
    if held_out and forwards and watch.allows("error against horizon", _predictions(problem, validation)):
        held_out = replace(held_out, horizons=horizon_errors(problem, validation, apart.z))
    return validation, held_out, (*against, *shown)


def _missing(fit: FinalFit, watch: Watch) -> Missing | None:
    """Missing causes of a model that misses the logs by more than twice their noise."""
    problem = fit.problem
    missed = any(scale > ASKED and not white for scale, white in misfits(fit).values())
    missed &= not problem.touches  # forces along a motion know no contacts; `amhe explain` looks between them
    if not (missed and fit.finding.done):
        watch.omits()
        return None
    if not watch.allows("what the model lacks", problem.linearisation):
        return None
    # from the prior: the fitted values make up for what is missing, and hide it
    explained = explain(problem.system, problem.pool.parts, 0.0 * fit.z, problem.rng(9))
    for row in explained.rows[:1]:
        logger.warning(
            f"{row.place}: {row.text}: so the logs say, it explains {100.0 * row.share:.0f} % of the motion "
            "there that the model does not"
        )
    return explained


def _report_budget(system: System, ledger: Ledger) -> None:
    """Log what each parameter's variance is made of."""
    for i, name in enumerate(system.space.names):
        shares = sorted(ledger.budget(i).items(), key=lambda item: -item[1])
        listed = ", ".join(f"{kind} {100.0 * share:.0f} %" for kind, share in shares if share >= LEAST)
        logger.info(f"{name}: its variance is {listed}")


def _predictions(problem: Problem, validation: Sequence[Window]) -> int:
    """Rollouts of errors against the horizon, counted in clips."""
    seconds = STARTS * sum(HORIZONS) + sum(part.duration for part in validation)
    return round(2.0 * seconds * len(problem.clips) / sum(clip.duration for clip in problem.clips))


def _ledger(fit: FinalFit, rival: Rival | None, watch: Watch, quick: bool) -> tuple[Ledger, tuple[str, ...]]:
    """All terms of the estimate's error, and what the settings take as exact.

    Terms for which there is no time are left out, and named.
    """
    once, exact = fit.problem.linearisation, ()
    doubts = [terms.noise(fit), terms.prior(fit), terms.repeats(fit), terms.search(fit), terms.declared(fit)]
    if watch.allows("covariance from wider samples", 0 if fit.problem.non_smooth else once):
        doubts.append(terms.curvature(fit))
    with_halves = watch.allows("comparison of the logs' halves", 0 if quick else (REFITS + TURNS) * once)
    doubts.append(parts(fit, with_halves=with_halves, refitted=not quick))
    report_drift(fit, doubts[-1])
    if watch.allows("what rests on assumed values", once):
        term, exact = assumed(fit)
        doubts.append(term)
    doubts = terms.inherited(fit, doubts)
    return Ledger((*doubts, rival.term(fit.z)) if rival else tuple(doubts)), exact
