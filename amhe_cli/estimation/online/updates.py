"""The moving-horizon updates: from a window and a prior to a belief, given random numbers and a time limit.

`linearised_update`, the default, takes Gauss-Newton steps of the matching cost plus the arrival cost, with
slopes from samples; docs/estimation.md derives it. Unlike offline identification it has one window, its noise
is remembered from window to window, and only the new share of overlapping windows counts as information.
`logrank_update` is the paper's (Algorithm 1, MHE-Estimate).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from amhe_cli.core.arrays import FloatArray, to_host
from amhe_cli.core.belief import Belief, gaussian_of
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.settings import MheSettings
from amhe_cli.core.statistics import log_rank_weights, sd_of_one
from amhe_cli.estimation.core.information import (
    Information,
    channel_times,
    gauss_newton_step,
    marginalised,
    mean_squares,
    weights,
)
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, bounded, linearise, sampling_width
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Share of the newest window in the remembered noise.
_NEWEST = 0.2
#: Largest ratio of a window's mean square to the remembered one that is remembered: what does not fit after a
#: jump, or far from the truth, is not noise.
_LARGEST = 2.0
#: Share of a window's squared residuals that its own fit may leave if the parameters have jumped.
_JUMP_LEAVES = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Mean and covariance of z, which pass from window to window.

    The arrival cost of the paper's equation (5) weighs the distance from the last estimate with a fixed
    diagonal W_p. This is the inverse of a full covariance, which can represent that mass times friction is
    known better than either.

    Args:
        z: Mean of z, shape (d,).
        covariance: Covariance of z, shape (d, d).
    """

    z: FloatArray
    covariance: FloatArray

    @property
    def sd(self) -> FloatArray:
        """Standard deviation of each coordinate, shape (d,)."""
        return np.sqrt(np.diag(self.covariance))

    def inflated(self, variance: FloatArray) -> Gaussian:
        """The same mean with this variance added to each coordinate, shape (d,)."""
        return replace(self, covariance=self.covariance + np.diag(variance))

    def floored(self, sd: FloatArray) -> Gaussian:
        """The same mean and correlations with at least this sd of each coordinate, shape (d,)."""
        wider = np.maximum(sd / np.maximum(self.sd, 1e-12), 1.0)
        return replace(self, covariance=self.covariance * np.outer(wider, wider))


def prior_of(space: ParameterSpace, belief: Belief | None, least_sd: float) -> Gaussian:
    """Prior of the first window: a belief whose sd is floored, so that estimates can still move.

    Args:
        space: The system's parameters.
        belief: The belief to start from; None: the system's own prior, not floored.
        least_sd: Smallest sd of each parameter, as a share of its value.
    """
    if belief is None:
        return Gaussian(np.zeros(len(space)), np.array(space.prior_covariance))
    return Gaussian(*gaussian_of(space, belief)).floored(space.in_z(least_sd))


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise that the residuals of earlier windows have shown, by channel.

    Args:
        square: Channel -> mean squared residual, in declared variances.
        time: Channel -> autocorrelation time, in samples.
    """

    square: Mapping[str, float] = field(default_factory=dict)
    time: Mapping[str, float] = field(default_factory=dict)

    def after(self, square: Mapping[str, float], time: Mapping[str, float]) -> Noise:
        """Noise with one more window remembered; older windows fade."""
        return Noise(_faded(self.square, square), _faded(self.time, time))

    def at_least(self, square: Mapping[str, float]) -> Noise:
        """Noise that is no smaller than a window's own mean squares."""
        return Noise(
            {key: max(value, square.get(key, value)) for key, value in self.square.items()}, self.time
        )


def _faded(old: Mapping[str, float], new: Mapping[str, float]) -> dict[str, float]:
    """Before the first window the noise is as declared, and white: both are 1."""
    faded = dict(old)
    for key, value in new.items():
        before = old.get(key, 1.0)
        faded[key] = (1.0 - _NEWEST) * before + _NEWEST * min(value, _LARGEST * before)
    return faded


@dataclass(frozen=True, slots=True, eq=False)
class WindowProblem:
    """One window, and all that an update depends on.

    Args:
        cost: Matching cost on the one window.
        prior: Belief before the window.
        noise: Noise of the windows before it.
        share: Share of the window that is new: the overlap with earlier windows was used before.
        settings: Settings of the estimator.
        samples: Rollouts of an iteration (B), as far as there is time for them.
        rng: Generator of the samples.
        late: Returns whether the time for this update is up; no iteration begins after that.
    """

    cost: MatchingCost
    prior: Gaussian
    noise: Noise
    share: float
    settings: MheSettings
    samples: int
    rng: np.random.Generator
    late: Callable[[], bool]

    @property
    def shape(self) -> FloatArray:
        """Shape of the samples, (d, d): that of the prior, but no narrower than the jitter of contacts."""
        space = self.cost.system.space
        floor = sampling_width(space, self.settings.step)
        return bounded(self.prior.covariance, floor, np.ones(len(space), dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Result of an update.

    Args:
        belief: Belief after the window.
        noise: Noise of the windows up to this one.
        before: Rms residual at the prior's mean, in noise sd; inf where it diverged.
        after: Rms residual expected after the update: of the best sample, or of the linearised model.
        excitation: Rms change of the predictions under the samples, in noise sd.
        rollouts, diverged: Number of rollouts, and how many of them diverged.
        iterations: Number of iterations.
    """

    belief: Gaussian
    noise: Noise
    before: float
    after: float
    excitation: float
    rollouts: int
    diverged: int
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class WindowFit:
    """A window that was linearised and fitted by itself, without the prior.

    Args:
        slopes: Residuals of the window and their slopes.
        information: Information of the window on z, the nuisances marginalised; None where too many samples
            diverged.
        noise: Noise of the windows up to this one.
        innovation: See `innovation`; 0 where the window's own fit leaves most of the residuals, since no
            parameters explain them.
        excitation: Rms change of the predictions under the samples, in noise sd.
        slope: Slopes of the fitted residuals by z, the nuisances moved along, shape (d, R); empty where too
            many samples diverged.
    """

    slopes: Linearisation
    information: Information | None
    noise: Noise
    innovation: float
    excitation: float
    slope: FloatArray


def fit_window(problem: WindowProblem, z: FloatArray) -> WindowFit:
    """Linearise the window about z (d,), and fit it by itself.

    It is fitted twice, since the weights depend on the residuals that the fit leaves. A window that no
    parameters explain gets less weight than its sensors promise.
    """
    cost, shape, d = problem.cost, problem.shape, z.size
    nx = cost.nx if problem.settings.first_state == "estimated" else 0
    first_states = FirstStates.recorded(1, nx)
    slopes = linearise(cost, z, first_states, shape, problem.samples, problem.rng)
    if not slopes.completed[0]:
        return WindowFit(slopes, None, problem.noise, 0.0, np.inf, np.empty((0, 0)))
    gz, gx = slopes.gain[:, :d], _nuisances(problem, slopes)
    zero = np.zeros((1, gx.shape[1]))

    def fitted(residual: FloatArray, noise: Noise) -> tuple[Information, FloatArray, FloatArray, FloatArray]:
        """Information under the weights of some residuals, `slope`, its own step, and residuals after it."""
        keys = [observed.channel.key for observed in cost.clips.observed]
        variances = [max(noise.square.get(key, 1.0), 1.0) for key in keys]
        weight = weights(cost, residual, [noise.time.get(key, 1.0) for key in keys], variances)
        info = marginalised(slopes.residual, gz, gx, weight / (1.0 + slopes.bend), zero)
        # the system's prior separates what the window alone cannot
        step, _ = gauss_newton_step(info.matrix[0], info.score[0], np.eye(d), np.zeros(d))
        slope = (gz + info.nuisance_gain.transpose(0, 2, 1) @ gx)[0]
        return info, slope, step, info.residual + step @ slope

    *_, left = fitted(slopes.residual, problem.noise)
    noise, square = _remembered(problem.noise, cost, left)
    info, slope, step, left = fitted(left, noise.at_least(square))
    explained = (left**2).sum() <= _JUMP_LEAVES * (info.residual**2).sum()
    far = innovation(step, info.matrix[0], problem.prior.covariance, problem.settings.information)
    return WindowFit(
        slopes,
        info,
        noise=_remembered(problem.noise, cost, left)[0],
        innovation=far if explained else 0.0,
        excitation=rms(shape.T @ gz[0], cost.clips.counts),
        slope=slope,
    )


def innovation(step: FloatArray, info: FloatArray, prior: FloatArray, share: float) -> float:
    """How far a window's own estimate is from the belief, in sd of a single number that is as unlikely.

    The square of the distance, in units of both covariances, is about chi-square. Of its degrees of freedom
    only those count that the window determines: the system's prior shrinks the others to nothing.

    Args:
        step: Step that the window would take alone, with the system's prior, shape (d,).
        info: Information of the window on z, shape (d, d).
        prior: Covariance of the belief, shape (d, d).
        share: Share of the window's samples that count as independent.
    """
    both = prior + np.linalg.inv(share * info + np.eye(step.size))
    shrunk = np.linalg.inv(info + np.eye(step.size))
    expected = shrunk @ (info @ prior @ info + info / share) @ shrunk  # the step's covariance without a jump
    freedom = float(np.trace(np.linalg.solve(both, expected)))
    return sd_of_one(float(step @ np.linalg.solve(both, step)), max(freedom, 1.0))


def _remembered(before: Noise, cost: MatchingCost, residual: FloatArray) -> tuple[Noise, dict[str, float]]:
    """Noise with a window's residuals (1, R) remembered, and their own mean squares by channel."""
    counted = np.array([True])
    square, times = mean_squares(cost, residual, counted), channel_times(cost, residual, counted)
    return before.after(square, dict(zip(square, times, strict=True))), square


def _nuisances(problem: WindowProblem, slopes: Linearisation) -> FloatArray:
    """Directions in which the residuals may be wrong as a whole, shape (1, n, R).

    Each has an unknown factor ~ N(0, 1), which is marginalised: the errors of the first state, and the even
    (nonlinear) response to each pair of samples. Taken as white noise, the nonlinear response would average
    out over a window, and estimates that were made far from the truth would be trusted permanently.

    For z ~ N(0, P), z^2 / 2 has a mean square of 3 P^2 / 4. At z = +-sqrt(P), where the samples are, it has a
    third of that: hence the factor of 3. Where the prior is wider than the samples, the ratio of the
    variances is another. Where first states are taken as recorded, `mhe.information` accounts for all this.
    """
    d = len(problem.prior.z)
    first = slopes.gain[:, d:]
    if not first.shape[1]:
        return first
    inside = np.linalg.inv(problem.shape)
    wider = float(np.trace(inside @ problem.prior.covariance @ inside.T) / d)
    curves = max(1.0, wider) * np.sqrt(3.0 / len(slopes.curves)) * to_host(slopes.curves[:, 0])
    return np.concatenate((first, curves[None]), axis=1)


def linearised_update(problem: WindowProblem, first: WindowFit, prior: Gaussian) -> Outcome:
    """Gauss-Newton steps of the window's cost plus the arrival cost.

    Each iteration linearises where the last one led, and starts again from the same prior. The last is the
    one whose step is shorter than an sd, after which slopes would hardly differ.

    Args:
        problem: The window.
        first: Fit of the window about the prior's mean.
        prior: The prior to combine it with: the problem's own, or an inflated one after a jump.
    """
    space, counts = problem.cost.system.space, problem.cost.clips.counts
    belief, fit, after = problem.prior, first, np.inf
    turns, rollouts, diverged = 1, first.slopes.rollouts, first.slopes.diverged
    while fit.information is not None:
        info = fit.information
        step, covariance = _posterior_step(problem, prior, info, belief.z)
        after = rms(info.residual[0] + step @ fit.slope, counts)
        belief = Gaussian(space.clip(belief.z + step), covariance)
        short = step @ np.linalg.solve(covariance, step) < 1.0
        if short or turns == problem.settings.iteration_count or problem.late():
            break
        fit, after = fit_window(problem, belief.z), np.inf
        turns, rollouts = turns + 1, rollouts + fit.slopes.rollouts
        diverged += fit.slopes.diverged
    before = rms(first.slopes.residual[0], counts) if first.information else np.inf
    return Outcome(belief, fit.noise, before, after, first.excitation, rollouts, diverged, turns)


def _posterior_step(
    problem: WindowProblem, prior: Gaussian, info: Information, z: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step from z (d,) to the minimum of tempered cost and arrival cost, and the covariance there.

    `mhe.prior_weight` shortens the step without being information: the covariance is that of a step so short
    (Joseph's form), as for parameters that are considered rather than estimated (Schmidt 1966).
    """
    share = problem.share * problem.settings.information
    gain, matrix, weighted = _gain(problem, prior, info)
    kept = np.eye(z.size) - gain @ matrix
    covariance = kept @ prior.covariance @ kept.T + gain @ matrix @ gain.T
    return -gain @ (share * info.score[0] + weighted @ (z - prior.z)), covariance


def _gain(
    problem: WindowProblem, prior: Gaussian, info: Information
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gain of a step, information that counts, and weight of the prior, each (d, d)."""
    matrix = problem.share * problem.settings.information * info.matrix[0]
    weights = problem.settings.weights(problem.cost.system.space.names)
    weighted = np.asarray(np.linalg.inv(prior.covariance) + np.diag(weights), dtype=np.float64)
    return np.asarray(np.linalg.inv(matrix + weighted), dtype=np.float64), matrix, weighted


def kept_error(problem: WindowProblem, prior: Gaussian, info: Information) -> FloatArray:
    """How much of an error of z before an update is left after it, shape (d, d)."""
    gain, matrix, _ = _gain(problem, prior, info)
    return np.eye(len(matrix)) - gain @ matrix


def logrank_update(problem: WindowProblem) -> Outcome:
    """The paper's update: elites of a diagonal Gaussian, log-rank weighted.

    It ends when the iterations are done or the samples lie close together. The reported sd is that of the
    samples, as in the paper. It is no posterior: it shrinks with every iteration, whatever the window shows.
    """
    cost, setting, space = problem.cost, problem.settings, problem.cost.system.space
    weight, counts = np.array(setting.weights(space.names)), cost.clips.counts
    mean = prior = problem.prior.z  # line 24
    sigma, floor = space.in_z(setting.sigma), space.in_z(setting.sigma_floor)
    rollouts = diverged = turns = 0
    before = after = excited = np.nan
    for _ in range(setting.iteration_count):  # line 25
        if turns and problem.late():
            break
        drawn = mean + sigma * problem.rng.standard_normal((problem.samples - 1, len(space)))
        samples = space.clip(np.concatenate((drawn, mean[None])))  # line 26; the mean itself never gets lost
        residuals = cost.residuals(samples)
        distance = ((samples - prior) ** 2) @ weight
        costs = cost.clip_costs(residuals)[:, 0] + distance  # line 27, equation (5)
        if not turns:
            excited = excitation(residuals, counts)
            before = rms(residuals.flat[-1, 0], counts) if residuals.completed[-1, 0] else np.inf
        best = int(np.argmin(costs))
        after = rms(residuals.flat[best, 0], counts) if np.isfinite(costs[best]) else np.inf
        mean, sigma = learned(samples, costs, mean, sigma, setting.elites, setting.learning_rate)  # line 28
        rollouts, diverged = rollouts + costs.size, diverged + int((~residuals.completed).sum())
        turns += 1
        if (sigma <= floor).all():  # lines 29-32
            break
    belief = Gaussian(mean, np.diag(sigma**2))  # line 33
    return Outcome(belief, problem.noise, before, after, excited, rollouts, diverged, turns)


def learned(
    samples: FloatArray, costs: FloatArray, mean: FloatArray, sigma: FloatArray, share: float, rate: float
) -> tuple[FloatArray, FloatArray]:
    """Mean and sd (d,) moved towards the elites, whose variance is taken about the old mean.

    Args:
        samples: Samples of z, shape (b, d).
        costs: Costs of the samples, shape (b,); inf for samples that diverged, which are never elites.
        mean, sigma: Mean and sd that the samples were drawn with, shape (d,).
        share: Share of the samples that are elites.
        rate: Learning rate alpha.
    """
    order = np.argsort(costs)
    count = min(max(2, round(share * len(samples))), int(np.isfinite(costs).sum()))
    if count == 0:
        return mean, sigma
    elites = samples[order[:count]]
    ranked = log_rank_weights(np.arange(1.0, count + 1.0), np.array(float(count)))
    ranked = ranked / ranked.sum()
    variance = ranked @ (elites - mean) ** 2
    return mean + rate * (ranked @ elites - mean), np.sqrt((1.0 - rate) * sigma**2 + rate * variance)


def excitation(residuals: Residuals, counts: FloatArray) -> float:
    """Rms change of the predictions from the last sample, the mean, to the others.

    Args:
        residuals: Residuals of p samples on one window.
        counts: Number of measurements in the window, shape (1,).
    """
    completed = residuals.completed[:-1, 0]
    if not completed.any() or not residuals.completed[-1, 0]:
        return float("inf") if not residuals.completed.all() else 0.0
    moved = residuals.flat[:-1, 0][completed] - residuals.flat[-1, 0]
    return float(np.sqrt((moved**2).sum(axis=1).mean() / counts[0]))


def rms(residual: FloatArray, counts: FloatArray) -> float:
    """Rms of one window's residuals (R,), of which `counts` (1,) were measured."""
    return float(np.sqrt((residual**2).sum() / counts[0]))
