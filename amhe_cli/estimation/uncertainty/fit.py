"""The posterior of z from a final linearisation of all clips; and how well clips fit under given values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed, to_host
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.estimation.core.information import (
    Information,
    channel_times,
    clip_objectives,
    clip_weights,
    fitted_noise_scale,
    gauss_newton_step,
    information,
    step_within,
)
from amhe_cli.estimation.core.linearise import (
    FirstStates,
    Linearisation,
    bent_by_z,
    bounded,
    changed,
    diagonal,
    sampling_sd,
    within,
)
from amhe_cli.estimation.offline.cma import CmaState
from amhe_cli.estimation.offline.problem import Problem, spread_floor
from amhe_cli.estimation.offline.search import SearchState, last_step
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
#: Slopes from so many posterior sd away are those of the estimate.
CLOSE = 1.0
#: Factor on the samples by which curvature is judged.
DOUBLED = 2.0
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


def posterior(z: FloatArray, info: Information, weight: FloatArray, prior: FloatArray) -> Posterior:
    """Combine the clips' information with the prior of z.

    The scatter of the clips' scores replaces what white noise would give (Huber's sandwich with the clip as
    the independent unit), shrunk towards the scatter of their samples as far as the clips are too few to tell
    the two apart. At the estimate, scores are smaller than at the truth, since the fit has followed each clip
    a little: their mean square is B_c - B_c H^-1 M_c and not B_c (Bell and McCaffrey 2002). What is missing
    of it is added.

    Args:
        z: Where the clips were linearised, from the prior's mean, shape (d,).
        info: Information of c clips.
        weight: Number of times that each clip counts, shape (c,); 0 leaves it out.
        prior: Information of the prior, shape (d, d).
    """
    step, _ = gauss_newton_step(*info.summed(weight), prior, z)
    hessian = np.einsum("c,cij->ij", weight, info.curvature) + prior
    score = info.score + np.einsum("cij,j->ci", info.matrix, step)
    centred = score - (weight[:, None] * score).sum(axis=0) / max(weight.sum(), 1e-300)
    followed = info.scatter @ np.linalg.solve(hessian, info.curvature)
    followed = 0.5 * (followed + followed.transpose(0, 2, 1))
    between = np.einsum("c,ci,cj->ij", weight, centred, centred) + np.einsum("c,cij->ij", weight, followed)
    # in coordinates in which the posterior is round
    values, vectors = np.linalg.eigh(hessian)
    to, back = vectors / np.sqrt(values), vectors * np.sqrt(values)
    alone = to.T @ (weight[:, None, None] * info.scatter) @ to
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
        problem, finding: The problem, and where its search ended.
        slopes: Residuals of c clips and their slopes.
        information: What the clips know of z.
        weight: Number of times that each clip counts, shape (c,).
        posterior: Posterior of z.
        shape: Shape of the samples of z, (d, d).
        scale: Channel -> residual sd over declared noise sd.
        left: The step that a search would take from there, shape (d,).
    """

    problem: Problem
    finding: Finding
    slopes: Linearisation
    information: Information
    weight: FloatArray
    posterior: Posterior
    shape: FloatArray
    scale: Mapping[str, float]
    left: FloatArray

    @property
    def z(self) -> FloatArray:
        """The estimate, shape (d,)."""
        return self.finding.z

    @property
    def space(self) -> ParameterSpace:
        """The unknowns."""
        return self.problem.system.space

    @property
    def times(self) -> tuple[float, ...]:
        """Autocorrelation time of each channel's residuals, in samples."""
        return channel_times(self.slopes.cost, self.information.residual, self.slopes.completed)


def final_fit(problem: Problem, finding: Finding, watch: Watch | None = None) -> FinalFit:
    """Linearise all clips at the estimate.

    Samples have the shape of the posterior, which depends on the linearisation: this is repeated until the
    shape no longer changes, or a watch has no time for more. After a rough search one linearisation is
    enough, and after a quick one by steps to one side if the search took such steps, or by its last slopes.
    """
    for known in problem.newest:
        near = known.record is finding.record and (problem.rough or known.way < CLOSE)
        if near and isinstance(finding, SearchState):
            return fit_of(problem, finding, known.slopes, finding.shape, finding.scale)
    floor, rough = spread_floor(problem), problem.rough
    searched = isinstance(finding, SearchState)
    shape = finding.shape if searched else diagonal(SMALL, problem.active)
    scale, first = finding.scale, finding.first if searched else None
    # the last steps of the search have sampled in this shape and fitted the first states
    shaped = searched and first is not None and (problem.non_smooth or finding.settled)
    one_sided = (rough or problem.quick) and searched and finding.straight
    for turn in range(TURNS):
        slopes = _linearised(problem, finding.z, scale, shape, first, turn, one_sided)
        fit = fit_of(problem, finding, slopes, shape, scale)
        if rough:
            break
        # wider samples would jitter as much, and bend more
        steady = fit
        if slopes.averaged:
            steady = fit_of(problem, finding, replace(slopes, averaged=False), shape, scale)
        covariance = within(steady.posterior.covariance, problem.alike)
        wanted = bounded(4.0 * covariance, floor, problem.active, problem.alike)
        # slopes from samples that hardly bend are those of wider ones, too
        straight = not problem.touches and float(slopes.bend.mean()) < HARDLY
        if shaped and (straight or not changed(sampling_sd(shape), sampling_sd(wanted))):
            break
        if watch is not None:
            watch.measured(slopes.rollouts)
            if not watch.affords(2 * slopes.rollouts):
                break
        shape, scale, shaped = wanted, fitted_noise_scale(slopes, fit.information, scale), True
        first = problem.first_states(fit.information, np.zeros_like(finding.z))
    return _after_last_step(fit, finding) if searched and finding.done and problem.non_smooth else fit


def fit_of(
    problem: Problem,
    finding: Finding,
    slopes: Linearisation,
    shape: FloatArray,
    scale: Mapping[str, float],
) -> FinalFit:
    """What a linearisation of all clips says about an estimate."""
    space, info = problem.system.space, information(slopes)
    weight = clip_weights(slopes, info) * problem.coverage(problem.clips)
    there = posterior(finding.z, info, weight, space.prior_precision)
    left = step_within(finding.z, there.step, there.hessian, space)
    return FinalFit(problem, finding, slopes, info, weight, there, shape, scale, left)


def _after_last_step(fit: FinalFit, before: SearchState) -> FinalFit:
    """The linearisation of a non-smooth cost, seen from the end of the step that it leads to."""
    slopes = fit.slopes
    started = replace(before, shape=fit.shape, scale=fit.scale)
    finding = last_step(fit.problem, started, slopes, fit.information)
    away = finding.z - before.z
    along = np.einsum("d,cdr->cr", away, slopes.gain[:, : away.size])
    moved = replace(slopes, residual=slopes.residual + along)
    return fit_of(fit.problem, finding, moved, fit.shape, fit.scale)


def doubled_step(fit: FinalFit) -> Posterior:
    """Posterior from samples twice as wide: the same where the model is linear.

    Where contacts jitter, wide samples would be another draw of the jitter, which does not grow with the
    step. There the samples at hand say what bends: four times as far at twice the step, and the square of
    that counts sixteen times.
    """
    if fit.problem.non_smooth:
        grown = (DOUBLED**4 - 1.0) * bent_by_z(fit.slopes)
        wide = replace(fit.slopes, bend=fit.slopes.bend + grown)
    else:
        wide = _linearised(fit.problem, fit.z, fit.scale, DOUBLED * fit.shape, fit.slopes.first, 0)
    return posterior(fit.z, information(wide), fit.weight, fit.posterior.prior)


def doubled_prior(fit: FinalFit) -> FloatArray:
    """Where each estimate would move if the sd of its own prior were twice as large, shape (d,)."""
    prior, moves = fit.posterior.prior, np.zeros_like(fit.z)
    matrix = fit.posterior.hessian - prior
    _, score = fit.information.summed(fit.weight)
    for i in np.flatnonzero(fit.problem.active):
        wider = np.array(prior)
        wider[i] *= 0.5  # row and column: the diagonal becomes a quarter
        wider[:, i] *= 0.5
        moves[i] = gauss_newton_step(matrix, score, wider, fit.z)[0][i] - fit.posterior.step[i]
    return moves


def _linearised(
    problem: Problem,
    z: FloatArray,
    scale: Mapping[str, float],
    shape: FloatArray,
    first: FirstStates | None,
    place: int,
    straight: bool = False,
) -> Linearisation:
    cost, rng = problem.cost(problem.clips, scale), problem.rng(3, place)
    return problem.linearised(cost, z, first or problem.recorded(cost), shape, rng, straight=straight)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """c clips under one z, their first states fitted.

    Args:
        cost: The cost on the clips.
        residuals: Residuals in its noise, each channel (1, c, samples, k).
        first: First-state errors, shape (c, nx).
        times: Autocorrelation time of each channel's residuals, in samples.
        information: What the clips know of z.
    """

    cost: MatchingCost
    residuals: Residuals
    first: FloatArray
    times: tuple[float, ...]
    information: Information

    @property
    def losses(self) -> list[FloatArray]:
        """Robust loss of each channel, shape (c,) each; infinite where the clip diverged."""
        completed = self.residuals.completed[0]
        return [np.where(completed, loss[0], np.inf) for loss in self.cost.losses(self.residuals)]

    def misfit(self, times: Sequence[float]) -> FloatArray:
        """Losses as of independent samples for some autocorrelation times, and first-state errors, (c,)."""
        return clip_objectives(self.cost, self.residuals, self.first[None], times)[0]


def scored(
    problem: Problem,
    cost: MatchingCost,
    z: FloatArray,
    shape: FloatArray,
    first: FirstStates | None = None,
    by_z: bool = False,
) -> Scored:
    """Fit the first states of clips under z (d,): the step that a linearisation gives, as far as it helps.

    Args:
        problem: The problem.
        cost: Cost on the clips.
        z: The values.
        shape: Shape of the samples of z, (d, d).
        first: Their recorded first states, and which of their errors matter; None: all.
        by_z: The information on z is wanted, too. First states alone take a fraction of the rollouts, but
            where slopes are those of means over the samples.
    """
    first = first or problem.recorded(cost)
    if first.mean.size and not (by_z or problem.touches):
        shape = shape[:, :0]
    slopes = problem.linearised(cost, z, first, shape, problem.rng(5), straight=not problem.touches)
    info = information(slopes)
    tried = LINE[:, None, None] * info.nuisance
    residuals = cost.residuals(np.repeat(z[None], len(LINE), axis=0), tried if tried.size else None)
    times = channel_times(cost, info.residual, slopes.completed)
    worth = clip_objectives(cost, residuals, tried, times)
    best = worth.argmin(axis=0), np.arange(worth.shape[1])
    kept = tuple(to_host(values)[best][None] for values in residuals.values)
    residuals = Residuals(kept, residuals.completed[best][None])
    return Scored(cost, residuals, tried[best], times, info)
