"""Is there a second minimum? Descents from the prior's corners, on few clips.

A search ends in the minimum that is nearest to the prior. Frictions that trade places, or a length of which
the logs show the square, may have another one, and an interval around the first would hide it. If the other
one is better, the search goes on from there.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.each_log import acting
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.engine.inverse import linear_in
from amhe_cli.estimation.core.agreement import SURPRISE
from amhe_cli.estimation.core.information import gauss_newton_step, step_within
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty.fit import FinalFit, scored
from amhe_cli.estimation.uncertainty.ledger import Term
from amhe_cli.matching.cost import MatchingCost

logger = logging.getLogger(__name__)

#: Share of the search's rollouts that descents from the corners may take.
SHARE = 0.15
#: Probability of values whose -2 log posterior is higher by SURPRISE squared than that of others.
EXCLUDED = 1.0 / (1.0 + np.exp(0.5 * SURPRISE**2))
#: Clips that they fit.
FEW = 2
#: Most iterations of one of them.
TURNS = 6
#: Distance of a corner from the prior's mean along each parameter, in prior sd.
CORNER = 1.0
#: Corners that are tried.
CORNERS = 16
#: Places on the line from a corner to the estimate, its ends included.
STOPS = 6
#: Factor by which the cost rises between two minima.
RISE = 1.1


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """Other values that fit the logs as well as the estimate does.

    Args:
        z: These values, shape (d,).
        share: Probability that they are meant, and not the estimate.
        differs: The parameters in which the two differ by more than chance, shape (d,).
        costs: Cost of the estimate, and theirs, in units of the declared noise.
    """

    z: FloatArray
    share: float
    differs: BoolArray
    costs: tuple[float, float]

    def term(self, z: FloatArray) -> Term:
        """The error of an estimate z (d,) where these values may be meant."""
        return Term("minimum", np.sqrt(self.share) * (self.z - z)[:, None])

    def against(self, z: FloatArray) -> Rival | None:
        """The estimate z (d,) whose place these values take; None where the logs exclude it then."""
        share = 1.0 - self.share
        costs = self.costs[1], self.costs[0]
        return Rival(z, share, self.differs, costs) if share > EXCLUDED else None

    def text(self, space: ParameterSpace, i: int) -> str:
        """The other value of one parameter, in words."""
        cost = " against ".join(f"{cost:.3g}" for cost in reversed(self.costs))
        value = f"{space.theta_of(self.z)[i]:.3g} {space.parameters[i].unit}".strip()
        return f"another minimum explains the logs too: {value} (cost {cost} here)"


def better(fit: FinalFit, z: FloatArray, watch: Watch) -> SearchState:
    """A search from values z (d,) that fit the logs better than those where the one before ended."""
    state = replace(search.restart(fit.problem, z), record=fit.finding.record)
    while not (state.done or watch.stopped):
        state = search.advance(fit.problem, state)
        watch.saw(state.record[-1], search.total(fit.problem, state))
    return state


def second_minimum(fit: FinalFit) -> Rival | None:
    """Other values that the logs allow, although the covariance of the estimate excludes them.

    Where contacts jitter, none are looked for; efforts that are linear in the unknowns have one minimum.
    """
    problem = fit.problem
    linear = problem.system.match == "effort" and linear_in(problem.system.edits)
    if linear or problem.non_smooth:  # contacts that jitter make rises everywhere
        return None
    part, space, covariance = _part(fit), fit.space, fit.posterior.covariance
    cost = part.cost(part.clips)
    felt = np.any([acting(clip.log, problem.system.edits.space, space) for clip in part.clips], axis=0)
    starts, rollouts = _beyond_a_rise(cost, fit.z, _corners(problem))
    left = SHARE * sum(entry.rollouts for entry in fit.finding.record) - rollouts
    for z in starts:
        state = search.restart(part, z)
        while left > 0.0 and not state.done and state.number < TURNS:
            state = search.advance(part, state)
            left -= state.record[-1].rollouts
        if left <= 0.0:
            break
        end = np.where(felt, state.z, fit.z)
        here, there = cost.costs(np.stack((fit.z, end)))
        # two clips know less than all do; the samples are two of their sd wide
        width = covariance + state.shape @ state.shape.T
        away = (end - fit.z) @ np.linalg.solve(width, end - fit.z)
        if away <= SURPRISE**2 or there > RISE * here:
            continue
        if (rival := _confirmed(fit, end)) is not None:
            return rival
    return None


def _beyond_a_rise(cost: MatchingCost, z: FloatArray, corners: FloatArray) -> tuple[FloatArray, int]:
    """The lowest places (n, d) that a rise of the cost separates from z (d,), the lowest of all first.

    They are looked for on the lines to z from the corners; down a line without a rise, a descent would end
    where the search did. The second value is the number of rollouts.
    """
    shares = np.linspace(0.0, 1.0, STOPS)[:-1]
    places = corners[:, None] + shares[:, None] * (z - corners[:, None])  # (n, k, d)
    costs = cost.costs(places.reshape(-1, z.size)).reshape(places.shape[:2])
    lowest = np.minimum.accumulate(costs, axis=1)
    rises = costs[:, 1:] > RISE * lowest[:, :-1]
    found = []
    for line in np.flatnonzero(rises.any(axis=1)):
        at = int(costs[line, : int(rises[line].argmax()) + 1].argmin())
        found.append((costs[line, at], places[line, at]))
    found.sort(key=lambda pair: pair[0])
    return np.array([place for _, place in found]).reshape(-1, z.size), costs.size * len(cost.clips.windows)


def _part(fit: FinalFit) -> Problem:
    """The clips that show most, from their recorded first states."""
    information = np.einsum("ij,cji->c", fit.posterior.covariance, fit.information.matrix) * fit.weight
    problem, part = fit.problem, fit.problem.part(np.sort(np.argsort(-information)[:FEW]))
    settings = problem.settings
    few = settings.identify.model_copy(update={"first_state": "never", "samples": 4})
    system = replace(problem.system, settings=settings.model_copy(update={"identify": few}))
    return replace(part, system=system)


def _corners(problem: Problem) -> FloatArray:
    """Corners of the prior (n, d): all where there are few, else opposite pairs of random ones."""
    active = np.flatnonzero(problem.active)
    if 2**active.size <= CORNERS:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=active.size)))
    else:
        half = problem.rng(6).choice((-1.0, 1.0), (CORNERS // 2, active.size))
        signs = np.concatenate((half, -half))
    corners = np.zeros((len(signs), problem.active.size))
    corners[:, active] = CORNER * signs
    return problem.system.space.clip(corners)


def _confirmed(fit: FinalFit, z: FloatArray) -> Rival | None:
    """Whether all clips, their first states fitted, allow a minimum near z (d,) as well as the estimate."""
    cost, prior = fit.slopes.cost, fit.posterior.prior
    # a few clips have led to z: the minimum of all of them is a step away
    info = scored(fit.problem, cost, z, fit.shape, by_z=True).information.summed(fit.weight)
    step = step_within(z, *gauss_newton_step(*info, prior, z), fit.space)
    places = fit.z, fit.space.clip(z + step)
    differs = np.abs(places[1] - places[0]) > SURPRISE * fit.posterior.sd
    both = [scored(fit.problem, cost, place, fit.shape) for place in places]
    misfits = [np.where(fit.weight > 0.0, each.misfit(fit.times), 0.0) @ fit.weight for each in both]
    here, there = (misfit + place @ prior @ place for misfit, place in zip(misfits, places, strict=True))
    if not (there - here < SURPRISE**2 and differs.any()):
        return None
    costs = [float(cost.as_declared(each.residuals)[0]) for each in both]
    return Rival(places[1], float(1.0 / (1.0 + np.exp(0.5 * (there - here)))), differs, (costs[0], costs[1]))


def report_minima(fit: FinalFit, rival: Rival) -> None:
    """Warn of two minima, with the values in which they differ."""
    both, space = [], fit.space
    for theta, cost in zip((space.theta_of(fit.z), space.theta_of(rival.z)), rival.costs, strict=True):
        values = (f"{space.names[i]} {theta[i]:.3g}" for i in np.flatnonzero(rival.differs))
        both.append(f"{', '.join(values)} (cost {cost:.3g})")
    logger.warning(
        f"two minima explain the logs: {both[0]}, and {both[1]}; narrow the prior to the one that can be "
        f"true, or record a motion in which they differ"
    )
