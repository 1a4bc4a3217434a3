"""The posterior of z from a final linearisation of all clips; and how well clips fit under given values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray, sealed, to_host
from amhe_cli.estimation.core.information import (
    Information,
    channel_times,
    clip_weights,
    fitted_noise_scale,
    gauss_newton_step,
    information,
    objective,
    step_within,
)
from amhe_cli.estimation.core.linearise import (
    FirstStates,
    Linearisation,
    Reach,
    bounded,
    changed,
    colours,
    diagonal,
    sampling_sd,
    within,
)
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.problem import Problem, spread_floor
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.matching.cost import MatchingCost, Residuals

#: The last state of a search.
Finding = SearchState | CmaState

#: Mean square of the bend, in noise variances, below which samples hardly bend.
HARDLY = 0.1
#: Most linearisations until the shape of the samples is that of the posterior.
TURNS = 4
#: Information of data, over that of the prior, below which they know hardly anything.
LITTLE = 0.1
#: Sampling sd of the first of them after CMA-ES, in prior sd.
SMALL = 0.05
#: Clips that are enough to draw a cost along a parameter.
PROFILED = 24


#: Shares of the step to the best first states that are tried on each clip.
LINE = np.array([1.0, 0.5, 0.0])


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian approximation of the posterior of z, from some clips and channels.

    Args:
        step: Gauss-Newton step from where the clips were linearised to the posterior's mean, shape (d,).
        hessian: Information of data and prior, shape (d, d).
        scatter: Covariance of the data's score, shape (d, d).
        prior: Information of the prior, shape (d, d).
    """

    step: FloatArray
    hessian: FloatArray
    scatter: FloatArray
    prior: FloatArray

    @cached_property
    def inverse(self) -> FloatArray:
        """H^-1, shape (d, d)."""
        return sealed(np.linalg.inv(self.hessian))

    @property
    def noise(self) -> FloatArray:
        """The part of the covariance that is due to the data, H^-1 B H^-1, shape (d, d)."""
        return self.inverse @ self.scatter @ self.inverse

    @property
    def pull(self) -> FloatArray:
        """Weight of the prior in the estimate, H^-1 P, shape (d, d): 1 where the data say nothing."""
        return self.inverse @ self.prior

    @property
    def covariance(self) -> FloatArray:
        """Posterior covariance of z: the sandwich H^-1 (B + P) H^-1, shape (d, d)."""
        return self.inverse @ (self.scatter + self.prior) @ self.inverse

    @property
    def sd(self) -> FloatArray:
        """Posterior sd of each z, shape (d,)."""
        return np.sqrt(self.covariance.diagonal())

    @property
    def informed(self) -> BoolArray:
        """Parameters of which the data know more than a share of the prior, shape (d,)."""
        return np.diag(self.hessian - self.prior) > LITTLE * np.diag(self.prior)


def posterior(z: FloatArray, found: Information, weight: FloatArray, prior: FloatArray) -> Posterior:
    """Combine the clips' information with the prior of z.

    The scatter of the clips' scores replaces what white noise would give (Huber's sandwich with the clip as
    the independent unit), shrunk towards the scatter of their samples as far as the clips are too few to tell
    the two apart. At the estimate, scores are smaller than at the truth, since the fit has followed each clip
    a little: their mean square is B_c - B_c H^-1 M_c and not B_c (Bell and McCaffrey 2002). What is missing
    of it is added.

    Args:
        z: Where the clips were linearised, from the prior's mean, shape (d,).
        found: Information of c clips.
        weight: Number of times that each clip counts, shape (c,); 0 leaves it out.
        prior: Information of the prior, shape (d, d).
    """
    matrix = np.einsum("c,cij->ij", weight, found.matrix)
    step, _ = gauss_newton_step(matrix, np.einsum("c,ci->i", weight, found.score), prior, z)
    hessian = np.einsum("c,cij->ij", weight, found.curvature) + prior
    score = found.score + np.einsum("cij,j->ci", found.matrix, step)
    centred = score - (weight[:, None] * score).sum(axis=0) / max(weight.sum(), 1e-300)
    followed = found.scatter @ np.linalg.solve(hessian, found.curvature)
    followed = 0.5 * (followed + followed.transpose(0, 2, 1))
    between = np.einsum("c,ci,cj->ij", weight, centred, centred) + np.einsum("c,cij->ij", weight, followed)
    # in coordinates in which the posterior is round
    values, vectors = np.linalg.eigh(hessian)
    to, back = vectors / np.sqrt(values), vectors * np.sqrt(values)
    alone = to.T @ (weight[:, None, None] * found.scatter) @ to
    both = _shrunk(to.T @ between @ to, alone)
    return Posterior(step, hessian, back @ both @ back.T, prior)


def _shrunk(between: FloatArray, alone: FloatArray) -> FloatArray:
    """The scatter between clips, shrunk towards that within them (Ledoit and Wolf 2004), shape (d, d).

    If both are the same, the former misses the latter by what chance makes of few clips, and says no more;
    what it misses beyond that is real.

    Args:
        between: Scatter between c clips, shape (d, d).
        alone: Scatter within each clip, whose sum is the same if clips scatter as their own residuals do,
            shape (c, d, d).
    """
    within = alone.sum(axis=0)
    chance = float((np.einsum("cii->c", alone) ** 2).sum() + (alone**2).sum())  # of normal scores
    missed = float(((between - within) ** 2).sum())
    return within + max(0.0, 1.0 - chance / max(missed, 1e-300)) * (between - within)


@dataclass(frozen=True, slots=True, eq=False)
class FinalFit:
    """Linearisation of all clips at the estimate.

    Args:
        slopes: Residuals of c clips and their slopes.
        found: Information of the clips.
        weight: Number of times that each clip counts, shape (c,).
        posterior: Posterior of z.
        shape: Shape of the samples of z, (d, d).
        scale: Channel -> residual sd over declared noise sd.
        z: The estimate, shape (d,).
        left: The step that a search would take from there, shape (d,).
    """

    slopes: Linearisation
    found: Information
    weight: FloatArray
    posterior: Posterior
    shape: FloatArray
    scale: Mapping[str, float]
    z: FloatArray
    left: FloatArray

    @property
    def times(self) -> tuple[float, ...]:
        """Autocorrelation time of each channel's residuals, in samples."""
        return channel_times(self.slopes.cost, self.found.residual, self.slopes.completed)

    def costs_along(self, rows: IntArray, values: FloatArray, reach: Reach | None) -> FloatArray:
        """Mean cost of some clips with one parameter moved at a time, first states fitted along.

        Parameters that move different measurements are moved in the same rollouts, and their costs put
        together from what each of them moves.

        Args:
            rows: Which parameters, shape (m,).
            values: What each of them is set to, in z, shape (m, p).
            reach: What the parameters move, where they do not move everything.

        Returns:
            Costs, shape (m, p).
        """
        clips = np.arange(len(self.weight))[:: -(-len(self.weight) // PROFILED)]
        cost, costs = self.slopes.cost.of(clips), np.empty_like(values)
        counted = (self.weight[clips] > 0.0).astype(float)
        together, here = np.arange(len(rows)), ()

        def first_states(z: FloatArray) -> FloatArray | None:
            first = self.found.first(z - self.z)[:, clips]
            return first if first.shape[2] else None

        if reach is not None:
            together = colours(reach.residuals(cost, False)[rows])
            here = cost.residuals(self.z[None], first_states(self.z[None])).values
        for colour in range(together.max() + 1):
            some = np.flatnonzero(together == colour)
            z = np.repeat(self.z[None], values.shape[1], axis=0)
            z[:, rows[some]] = values[some].T
            found = cost.residuals(z, first_states(z))
            for i in some:
                own = found if reach is None else reach.alone(rows[i], cost, found, here)
                alone = np.repeat(self.z[None], len(z), axis=0)
                alone[:, rows[i]] = values[i]
                first = self.found.first(alone - self.z)[:, clips]
                costs[i] = objective(cost, own, first, (1.0,) * len(own.values), counted)
        return costs / max(float((counted * cost.clips.counts).sum()), 1.0)


def final_fit(problem: Problem, finding: Finding, watch: Watch | None = None) -> FinalFit:
    """Linearise all clips at the estimate.

    Samples have the shape of the posterior, which depends on the linearisation: this is repeated until the
    shape no longer changes, or a watch has no time for more.
    """
    prior = problem.system.space.prior_precision
    coverage = problem.coverage(problem.clips)
    floor = spread_floor(problem)
    searched = isinstance(finding, SearchState)
    shape = finding.shape if searched else diagonal(SMALL, problem.active)
    scale, first = finding.scale, finding.first if searched else None
    # the last steps of the search have sampled in this shape and fitted the first states
    known = searched and first is not None and (problem.rough or finding.settled)
    for turn in range(TURNS):
        slopes = _linearised(problem, finding, scale, shape, first, turn)
        found = information(slopes)
        weight = clip_weights(slopes, found) * coverage
        own = posterior(finding.z, found, weight, prior)
        left = step_within(finding.z, own.step, own.hessian, problem.system.space)
        fit = FinalFit(slopes, found, weight, own, shape, scale, finding.z, left)
        covariance = within(fit.posterior.covariance, problem.alike)
        wanted = bounded(4.0 * covariance, floor, problem.active, problem.alike)
        # slopes from samples that hardly bend are those of wider ones, too
        straight = not problem.touches and float(slopes.bend.mean()) < HARDLY
        if known and (straight or not changed(sampling_sd(shape), sampling_sd(wanted))):
            break
        if watch is not None:
            watch.measured(slopes.rollouts)
            if not watch.affords(2 * slopes.rollouts):
                break
        shape, scale, known = wanted, fitted_noise_scale(slopes, found, scale), True
        first = problem.first_states(found, np.zeros_like(finding.z))
    return fit


def doubled_step(problem: Problem, finding: Finding, fit: FinalFit) -> Posterior:
    """Posterior from samples twice as wide: the same where the model is linear."""
    first = fit.slopes.first
    found = information(_linearised(problem, finding, fit.scale, 2.0 * fit.shape, first, TURNS))
    return posterior(finding.z, found, fit.weight, problem.system.space.prior_precision)


def doubled_prior(fit: FinalFit, active: BoolArray) -> FloatArray:
    """Where each estimate would move if the sd of its own prior were twice as large, shape (d,).

    Args:
        fit: The linearisation at the estimate.
        active: Parameters that the logs depend on, shape (d,).
    """
    prior, moves = fit.posterior.prior, np.zeros_like(fit.z)
    known = fit.posterior.hessian - prior
    score = np.einsum("c,ci->i", fit.weight, fit.found.score)
    for i in np.flatnonzero(active):
        wider = np.array(prior)
        wider[i] *= 0.5  # row and column: the diagonal becomes a quarter
        wider[:, i] *= 0.5
        moves[i] = gauss_newton_step(known, score, wider, fit.z)[0][i] - fit.posterior.step[i]
    return moves


def _linearised(
    problem: Problem,
    finding: Finding,
    scale: Mapping[str, float],
    shape: FloatArray,
    first: FirstStates | None,
    place: int,
) -> Linearisation:
    cost = problem.cost(problem.clips, scale)
    return problem.linearised(cost, finding.z, first or problem.recorded(cost), shape, problem.rng(3, place))


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """c clips under one z, their first states fitted.

    Args:
        residuals: Residuals in the noise of the cost that was given, each channel (1, c, samples, k).
        losses: Robust loss of each channel, shape (c,) each; infinite where the clip diverged.
        first: Squared first-state errors, shape (c,).
        times: Autocorrelation time of each channel's residuals, in samples.
        information: What the clips know of z.
    """

    residuals: Residuals
    losses: list[FloatArray]
    times: tuple[float, ...]
    first: FloatArray
    information: Information

    def misfit(self, times: Sequence[float]) -> FloatArray:
        """Losses as of independent samples for some autocorrelation times, and first-state errors, (c,)."""
        return self.first + np.sum(
            [loss / time for loss, time in zip(self.losses, times, strict=True)], axis=0
        )


def scored(problem: Problem, cost: MatchingCost, z: FloatArray, shape: FloatArray) -> Scored:
    """Fit the first states of clips under z (d,): the step that a linearisation gives, as far as it helps.

    Args:
        problem: The problem.
        cost: Cost on the clips.
        z: The values.
        shape: Shape of the samples of z, (d, d).
    """
    slopes = problem.linearised(
        cost, z, problem.recorded(cost), shape, problem.rng(5), straight=not problem.touches
    )
    found = information(slopes)
    tried = LINE[:, None, None] * found.nuisance
    residuals = cost.residuals(np.repeat(z[None], len(LINE), axis=0), tried if tried.size else None)
    losses = cost.losses(residuals)
    errors = np.einsum("pcx,pcx->pc", tried, tried)
    total, times = errors, channel_times(cost, found.residual, slopes.completed)
    for loss, time in zip(losses, times, strict=True):
        total = total + loss / time
    total = np.where(residuals.completed, total, np.inf)
    best = total.argmin(axis=0), np.arange(total.shape[1])
    done = residuals.completed[best]
    kept = tuple(to_host(values)[best][None] for values in residuals.values)
    own = [np.where(done, one[best], np.inf) for one in losses]
    return Scored(Residuals(kept, done[None]), own, times, errors[best], found)
