"""What a log will say of each parameter, before it is fitted: expected sd and verdicts, in seconds.

A few of the log's clips are searched for a few iterations, which leads near the estimate; there the ledger of
an identification is made of the terms that need no further search, as if all clips had been fitted.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.errors import EstimationError
from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.result import VERDICTS, Combination, ParameterResult, with_bodies
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, evenly, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.uncertainty import terms
from amhe_cli.estimation.uncertainty.assumed import assumed
from amhe_cli.estimation.uncertainty.derived import body_numbers, combinations
from amhe_cli.estimation.uncertainty.fit import FinalFit, doubled_prior, fit_of, posterior
from amhe_cli.estimation.uncertainty.ledger import Ledger
from amhe_cli.estimation.uncertainty.verdicts import Evidence, verdicts
from amhe_cli.system.system import System

#: Clips that are looked at. Numbers of the model that are no parameters act otherwise in each clip: of eight,
#: their share of an error scattered by half.
CLIPS = 12
#: Fewer, but never below this, where one linearisation would take more steps of the simulation than that.
FEWEST, STEPS = 4, 200_000
#: Iterations of the search that lead near the estimate, at most; it is near where an iteration leaves more
#: than this share of the cost of the one before.
ITERATIONS, NEAR = 6, 0.9
#: Or where a step [posterior sd] is shorter than this, and its slopes hold where it ends.
CLOSE = 1.0
#: Linearisations of all clips that an identification takes, half of them its search: those of the examples.
_LINEARISATIONS = 17.0


@dataclass(frozen=True, slots=True)
class Expected:
    """What an identification is expected to say.

    Args:
        parameters, bodies: As in its result; estimates are rough.
        combinations: What would be known together only.
        idle: Parameters that the logs do not depend on -> why.
        seconds: CPU time that it would take at the pace of this look [s], about.
    """

    parameters: tuple[ParameterResult, ...]
    bodies: tuple[ParameterResult, ...]
    combinations: tuple[Combination, ...]
    idle: dict[str, str]
    seconds: float

    @property
    def lines(self) -> tuple[ParameterResult, ...]:
        """What people read, as of an identification, the least known first."""
        worst = [*VERDICTS][::-1]
        return tuple(sorted(with_bodies(self.parameters, self.bodies), key=lambda p: worst.index(p.verdict)))


def expected(system: System, logs: Sequence[Log], *, threads: int = 1, seed: int = 0) -> Expected:
    """Expected sd and verdict of each parameter.

    Args:
        logs: The logs that would be fitted.
        threads: CPU threads of the rollouts.
        seed: Seed of all draws.

    Raises:
        EstimationError: No clip of the logs can be used.
    """
    settings = system.settings.clips
    pool = ClipPool(system, [whole(log) for log in logs], settings)
    clips = pool.cut(0.5 * sum(settings.length))
    if not clips:
        raise EstimationError("no clip of these logs can be used: too short, motionless, or across gaps")
    engine = open_engine(system, threads=threads)
    rough = Problem(system, pool, engine, seed, only=tuple(evenly(clips, FEWEST)), threads=threads)
    steps = rough.linearisation // len(rough.clips) * max(clip.length for clip in rough.clips)
    problem = replace(rough, only=tuple(evenly(clips, min(max(FEWEST, STEPS // steps), CLIPS))), whole=rough)
    began = time.process_time()
    fit, rollouts = _near(problem)
    pace = (time.process_time() - began) / max(rollouts, 1)
    few = problem.clips
    share = (1.0 - settings.held_out) * min(len(clips), settings.most) / len(few)
    fit = _as_if(fit, max(share, 1.0 / len(few)))
    term, _ = assumed(fit)
    space = system.space
    found = [terms.noise(fit), terms.prior(fit), terms.repeats(fit), terms.declared(fit), term]
    ledger = Ledger(tuple(terms.inherited(fit, found)))
    evidence = Evidence(
        z=fit.z,
        ledger=ledger,
        active=problem.active,
        idle=problem.idle,
        misfit=(),
        blamed={},
        rival=None,
        doubled_prior=doubled_prior(fit),
        non_smooth=problem.non_smooth,
    )
    each = problem.linearisation / len(few) * min(len(clips), settings.most)
    return Expected(
        verdicts(space, evidence),
        body_numbers(system, fit.z, ledger, problem.rng(5), ()),
        tuple(combinations(space, ledger.covariance, problem.active)),
        dict(problem.idle),
        _LINEARISATIONS * each * pace,
    )


def _near(problem: Problem) -> tuple[FinalFit, int]:
    """A linearisation near the estimate, and the rollouts of the way there.

    The first steps of a search are by few of the clips, the others by all of them. Where nothing touches, the
    slopes of the last one hold where it ends, too.
    """
    few = replace(problem, only=tuple(evenly(problem.clips, FEWEST // 2)))
    state = search.restart(few, np.zeros(len(problem.system.space)))
    part, before, near = few, np.inf, not problem.active.any()
    while not near:
        # where nothing touches, short steps to one side suffice to come near: half of the rollouts
        state = replace(state, straight=state.straight or (part is few and not problem.touches))
        slopes = search.slopes_at(part, state)
        info = information(slopes, steps=True)
        taken = search.gauss_newton(part, state, slopes, info)
        state = search.stepped(part, state, slopes, info, taken)
        most = search.ROUGHLY if part is few else ITERATIONS
        near = state.done or state.number >= most or taken.cost > NEAR * before
        # where the cost falls as the slopes predict they hold where it ends, if that is not far
        held = taken.predicted and (part is few or taken.moved < CLOSE) and not problem.touches
        near, before = near or held, taken.cost
        if part is few and near:
            part, before, near = problem, np.inf, False
            state = replace(state, stage="polish", first=None)
    if problem.touches or not problem.active.any():
        slopes = search.slopes_at(problem, state)
    else:
        first = state.first or problem.recorded(slopes.cost)
        mean = first.mean[None] if first.mean.size else None
        there = slopes.cost.residuals(state.z[None], mean).flat[0]
        slopes = replace(slopes, residual=there, first=first)
    rollouts = sum(one.rollouts for one in state.record) + slopes.rollouts
    return fit_of(problem, state, slopes, state.shape, state.scale), rollouts


def _as_if(fit: FinalFit, times: float) -> FinalFit:
    """The linearisation as if there were so many times as many clips of its kind."""
    weight = times * fit.weight
    return replace(
        fit, weight=weight, posterior=posterior(fit.z, fit.information, weight, fit.posterior.prior)
    )
