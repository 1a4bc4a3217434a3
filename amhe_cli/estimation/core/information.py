"""Information of windows on the parameters: eliminate nuisances, weight residuals, take a Gauss-Newton step.

From the slopes Gz, Gx of residuals r (`linearise`) by the parameters z and by nuisances e ~ N(mean, I), such
as the errors of a window's recorded first state:

    M = Gz' W Gz - Gz' W Gx (Gx' W Gx + I)^-1 Gx' W Gz

is the information on z that is left once e has been marginalised. W holds the robust weights of the
pseudo-Huber loss and, because neighbouring residuals of an imperfect model repeat each other, the inverse
autocorrelation time of each channel. The nonlinear response to the samples counts as noise, so that residuals
behind a chaotic bounce have little weight.

Offline identification, the moving-horizon update and the design of experiments all use it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray, IntArray, sealed, to_host
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.core.statistics import autocorrelation_time, mean_within, pseudo_huber_weight
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, turns
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Residuals below this share of their declared noise are rounding, as in a log without noise.
QUIETEST = 1e-3
#: Information on a first state, in that of its record, below which it is rounding.
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information of c windows on z, their n nuisances fitted and eliminated.

    Args:
        matrix: Information matrices, shape (c, d, d); zero for a window that diverged.
        score: Gradients of half the weighted squared residuals and nuisances, shape (c, d).
        curvature: Their derivatives, shape (c, d, d). A robust loss bends less than the parabola of its
            weights, which is `matrix`, good for steps; where the loss is a parabola they are the same.
        scatter: Covariances of the scores that the residuals show, sample by sample, shape (c, d, d).
        residual: Residuals at dz = 0 with the nuisances fitted, shape (c, R).
        nuisance: Best nuisances at dz = 0, shape (c, n).
        nuisance_gain: Slopes of the best nuisances by z, shape (c, n, d).
        nuisance_precision: Precision of the nuisances, given z, shape (c, n, n).
        weight: Weight of each squared residual, shape (c, R).
    """

    matrix: FloatArray
    score: FloatArray
    curvature: FloatArray
    scatter: FloatArray
    residual: FloatArray
    nuisance: FloatArray
    nuisance_gain: FloatArray
    nuisance_precision: FloatArray
    weight: FloatArray

    def summed(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (d, d) and score (d,) of the windows together, each counted `weight` (c,) times."""
        return np.einsum("c,cij->ij", weight, self.matrix), np.einsum("c,ci->i", weight, self.score)

    def first(self, dz: FloatArray) -> FloatArray:
        """Best first-state errors of every clip after steps dz (p, d): shape (p, c, nx)."""
        return self.nuisance + np.einsum("cxd,pd->pcx", self.nuisance_gain, dz)

    def first_states(
        self,
        dz: FloatArray,
        narrowest: float,
        alike: Sequence[IntArray] | None = None,
        least: float = ROUNDING,
    ) -> FirstStates:
        """Posterior of the first-state errors after a step of z.

        Directions that hardly move a residual, or only make them jitter, are not sampled any more: what the
        slopes of a non-smooth model are freed of leaves a quarter of them (`linearise.without_jitter`).

        Args:
            dz: The step, shape (d,).
            narrowest: Smallest sampling sd along any direction, in sd of the recorded state.
            alike: Groups of errors of which no sample mixes two; None: one group.
            least: Information on a direction, in that of the record and in the mean over the windows, from
                which it is sampled; of one group.
        """
        shape = np.zeros_like(self.nuisance_precision)
        for rows in alike or [np.arange(shape.shape[1])]:
            block = (slice(None), rows[:, None], rows)
            values, vectors = np.linalg.eigh(self.nuisance_precision[block])
            shape[block] = vectors * np.maximum(1.0 / np.sqrt(values), narrowest)[:, None, :]
        if alike is None:  # eigenvalues ascend: the directions of which most is known stand last
            shape = shape[:, :, values.mean(axis=0) > 1.0 + least]
        return FirstStates(self.first(dz[None])[0], shape)

    def first_of_others(self, count: int, least: float) -> FirstStates:
        """Recorded first states of other windows, sampled along the directions that matter on these.

        Args:
            count: Number of the other windows.
            least: As of `first_states`.
        """
        values, vectors = np.linalg.eigh(self.nuisance_precision.mean(axis=0))
        felt = vectors[:, values > 1.0 + least]
        return FirstStates(np.zeros((count, len(felt))), np.tile(felt, (count, 1, 1)))


def marginalised(
    residual: FloatArray, gz: FloatArray, gx: FloatArray, weight: FloatArray, mean: FloatArray
) -> Information:
    """Fit the nuisances of each window, and eliminate them.

    Args:
        residual: Residuals at dz = 0 and the nuisances' prior mean, shape (c, R).
        gz: Slopes by z, shape (c, d, R).
        gx: Slopes by the nuisances in units of their prior sd, shape (c, n, R).
        weight: Weight of each squared residual, shape (c, R).
        mean: Prior mean of the nuisances, shape (c, n).
    """
    wz, wx = gz * weight[:, None], gx * weight[:, None]
    precision = wx @ gx.transpose(0, 2, 1) + np.eye(mean.shape[1])
    gradient = wx @ residual[..., None] + mean[..., None]
    solved = np.linalg.solve(precision, np.concatenate((gradient, wx @ gz.transpose(0, 2, 1)), axis=2))
    offset, gain = solved[..., 0], solved[..., 1:]
    fitted = residual - (offset[:, None] @ gx)[:, 0]
    slope = gz - gain.transpose(0, 2, 1) @ gx
    matrix = wz @ slope.transpose(0, 2, 1)
    return Information(
        matrix=matrix,
        score=(wz @ fitted[..., None])[..., 0],
        curvature=matrix,
        scatter=matrix,
        residual=fitted,
        nuisance=mean - offset,
        nuisance_gain=np.negative(gain),
        nuisance_precision=precision,
        weight=weight,
    )


def information(
    slopes: Linearisation,
    channels: Sequence[bool] | None = None,
    *,
    straight: bool = False,
    steps: bool = False,
    repeats: float = 1.0,
) -> Information:
    """Information of each clip, its first state fitted along.

    Args:
        slopes: The linearised residuals.
        channels: Which channels count, one flag each; None: all.
        straight: Ignore the nonlinear response, as if the samples had been narrow: it shapes samples.
        steps: It is for steps: curvature and scatter are the matrix, too.
        repeats: Number of clips in which the part of the residuals that repeats within a clip returns.
    """
    cost, mean = slopes.cost, slopes.first.mean
    gz, gx = np.split(slopes.gain, [slopes.gain.shape[1] - mean.shape[1]], axis=1)
    counted = of_residuals(cost, channels or [True] * len(cost.clips.observed)) * slopes.completed[:, None]
    noise = 1.0 if straight else 1.0 + slopes.bend

    some = turns(len(mean), 8 * slopes.gain[:1].size)

    def fitted(residual: FloatArray, times: tuple[float, ...]) -> Information:
        weight = weights(cost, residual, times) / noise * counted
        arrays = slopes.residual, gz, gx, weight, mean
        return _joined([marginalised(*(array[clips] for array in arrays)) for clips in some])

    # weights depend on the fitted residuals: a first fit gives them
    first = fitted(slopes.residual, (1.0,) * len(cost.clips.observed))
    times = channel_times(cost, first.residual, slopes.completed)
    times = tuple(1.0 + repeats * (time - 1.0) for time in times)
    known = fitted(first.residual, times)
    if straight or steps:
        return known
    bent = known.weight * _bent(cost, first.residual)
    each = of_residuals(cost, times)
    arrays = gz, gx, bent, known.weight * known.residual * np.sqrt(each)
    both = [_sandwich(*(array[clips] for array in arrays)) for clips in some]
    curvature, scatter = map(np.concatenate, zip(*both, strict=True))
    if slopes.averaged:
        scatter = _with_jitter(scatter, slopes, known, each)
    return replace(known, curvature=curvature, scatter=scatter)


def _of_scores(pull: FloatArray, jitter: FloatArray) -> FloatArray:
    """Sum of the squares of the scores that each jitter (h, c, R) makes, shape (c, d, d)."""
    scores = pull @ jitter.transpose(1, 2, 0)
    return scores @ scores.transpose(0, 2, 1)


def _jitter(slopes: Linearisation) -> FloatArray:
    """Even responses about their mean over the pairs that completed; their squares add to the variance."""
    curves = to_host(slopes.curves)
    completed = (curves != 0.0).any(axis=2)[..., None]
    count = completed.sum(axis=0)
    about: FloatArray = (curves - curves.sum(axis=0) / np.maximum(count, 1)) * completed
    return about / np.sqrt(np.maximum(count - 1, 1))


def _pull(slopes: Linearisation, known: Information) -> FloatArray:
    """By how much each residual moves its clip's score, the nuisances eliminated, shape (c, d, R)."""
    gz, gx = np.split(slopes.gain, [known.matrix.shape[1]], axis=1)
    moved: FloatArray = (gz + known.nuisance_gain.transpose(0, 2, 1) @ gx) * known.weight[:, None]
    return moved


def _with_jitter(
    scatter: FloatArray, slopes: Linearisation, known: Information, times: FloatArray
) -> FloatArray:
    """Covariance of each clip's score where jitter counts by what it does to scores, shape (c, d, d).

    After a contact that begins a step sooner all residuals differ: that is far more than if it were white.
    A log is one run, whose jitter has twice the variance of a pair's mean; its residuals are counted from the
    mean of h pairs, which jitters, too. Their squares, times their autocorrelation times, hold that variance
    already, and of how long it lasts what those times have beyond white noise. This is taken out, as far as
    noise may be left.

    Args:
        scatter: The same by single residuals, shape (c, d, d).
        slopes, known: The linearised residuals, and the information of each clip.
        times: Autocorrelation time of each residual, shape (R,).
    """
    pull, jitter = _pull(slopes, known), _jitter(slopes)
    runs = 2.0 + 1.0 / len(jitter)
    variance = runs * (jitter**2).sum(axis=0)
    lasts = of_residuals(slopes.cost, _times(slopes.cost, jitter, slopes.completed))
    counted = np.minimum((times - 1.0) * known.residual**2 + variance, lasts * variance)
    held = (pull * counted[:, None]) @ pull.transpose(0, 2, 1)
    all_of_it = scatter.sum(axis=0)
    root = np.linalg.cholesky(all_of_it + 1e-9 * np.trace(all_of_it) * np.eye(len(all_of_it)))
    share = np.linalg.solve(root, np.linalg.solve(root, held.sum(axis=0)).T)
    held /= max(1.0, float(np.linalg.eigvalsh(0.5 * (share + share.T))[-1]))
    return scatter - held + runs * _of_scores(pull, jitter)


def _sandwich(
    gz: FloatArray, gx: FloatArray, bent: FloatArray, pull: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivative of the score of each window, its nuisances eliminated, and the score's covariance.

    Args:
        gz, gx: As in `marginalised`.
        bent: Second derivative of half the loss by each residual, shape (c, R).
        pull: First derivative, times the root of the number of neighbours that repeat it, shape (c, R).
    """
    bz, bx = gz * bent[:, None], gx * bent[:, None]
    inverse = np.linalg.inv(bx @ gx.transpose(0, 2, 1) + np.eye(gx.shape[1]))
    gain = (inverse @ bx @ gz.transpose(0, 2, 1)).transpose(0, 2, 1)
    slope = gz - gain @ gx
    moved = slope * pull[:, None]
    # each nuisance that was fitted has taken its part of the residuals (MacKinnon and White 1985)
    count, taken = (pull != 0.0).sum(axis=1), gx.shape[1] - np.einsum("cii->c", inverse)
    left = (count / np.maximum(count - taken, 1.0))[:, None, None]
    scatter = left * (moved @ moved.transpose(0, 2, 1))
    # and errs by its prior, of variance 1, and the score with it
    return bz @ slope.transpose(0, 2, 1), scatter + gain @ gain.transpose(0, 2, 1)


def _bent(cost: MatchingCost, residual: FloatArray) -> FloatArray:
    """Second derivative of the robust loss over its weight, in the mean over directions, shape (c, R)."""
    parts = []
    for values in split(cost, residual):
        share = np.einsum("csk,csk->cs", values, values) / cost.settings.huber**2
        parts.append(np.repeat(1.0 - share / (1.0 + share) / values.shape[2], values.shape[2], axis=1))
    return np.concatenate(parts, axis=1)


def _joined(parts: Sequence[Information]) -> Information:
    """Information of some windows each as one of all windows."""
    names = [field.name for field in fields(Information)]
    arrays = ([getattr(part, name) for part in parts] for name in names)
    return parts[0] if len(parts) == 1 else Information(*map(np.concatenate, arrays))


def gauss_newton_step(
    matrix: FloatArray, score: FloatArray, precision: FloatArray, away: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step to the minimum of linearised residuals plus a quadratic prior, and the Hessian there.

    Args:
        matrix: Information of the data, shape (d, d).
        score: Gradient of half the data's cost, shape (d,).
        precision: Precision of the prior, shape (d, d).
        away: Distance from the prior's mean, shape (d,).

    Returns:
        The step (d,), and half the Hessian (d, d), whose inverse is the posterior covariance.
    """
    hessian = matrix + precision
    step: FloatArray = np.asarray(-np.linalg.solve(hessian, score + precision @ away), dtype=np.float64)
    return step, hessian


def step_within(z: FloatArray, step: FloatArray, hessian: FloatArray, space: ParameterSpace) -> FloatArray:
    """The step from z that the bounds allow, shape (d,).

    What would leave them stands on them, and the others go where the cost is least then.

    Args:
        z: Where the cost was linearised, shape (d,).
        step: Step to its minimum without bounds, shape (d,).
        hessian: Half its Hessian, shape (d, d).
        space: The parameters.
    """
    return mean_within(z + step, sealed(np.linalg.inv(hessian)), space.bounds) - z


def weights(
    cost: MatchingCost, residual: FloatArray, times: Sequence[float], variances: Sequence[float] | None = None
) -> FloatArray:
    """Robust weight of every squared residual, shape (c, R).

    Args:
        cost: The matching cost on c clips.
        residual: Residuals, shape (c, R).
        times: Autocorrelation time of each channel's residuals, in samples.
        variances: Variance of each channel's noise, in declared variances; None: as declared.
    """
    parts = []
    for values, time, variance in zip(
        split(cost, residual), times, variances or [1.0] * len(times), strict=True
    ):
        squared = np.einsum("csk,csk->cs", values, values) / variance
        weight = pseudo_huber_weight(squared, cost.settings.huber) / (variance * time)
        parts.append(np.repeat(weight, values.shape[2], axis=1))
    return np.concatenate(parts, axis=1)


def channel_times(cost: MatchingCost, residual: FloatArray, completed: BoolArray) -> tuple[float, ...]:
    """Autocorrelation time of each channel's residuals (..., c, R), in samples; that of a known noise."""
    if cost.times is not None:
        return tuple(cost.times[observed.channel.key] for observed in cost.clips.observed)
    return _times(cost, residual, completed)


def _times(cost: MatchingCost, residual: FloatArray, completed: BoolArray) -> tuple[float, ...]:
    times = []
    for observed, values in zip(cost.clips.observed, split(cost, residual), strict=True):
        rows = np.moveaxis(values[..., completed, :, :], -1, -2)  # (..., c, k, s)
        mask = np.broadcast_to(observed.mask[completed, None], rows.shape)
        times.append(autocorrelation_time(rows.reshape(-1, rows.shape[-1]), mask.reshape(-1, rows.shape[-1])))
    return tuple(times)


def clip_weights(slopes: Linearisation, info: Information) -> FloatArray:
    """1 for a clip that counts, 0 for one that diverged or is among the worst (`cost.trim`), shape (c,)."""
    weight = slopes.completed.astype(float)
    misfit = (info.residual**2).sum(axis=1) / slopes.cost.clips.counts
    drop = int(np.floor(slopes.cost.settings.trim * len(misfit)))
    if drop:
        weight[np.argsort(np.where(slopes.completed, misfit, np.inf))[-drop:]] = 0.0
    return weight


def mean_squares(cost: MatchingCost, residual: FloatArray, keep: BoolArray) -> dict[str, float]:
    """Mean squared residual of each channel, by its key.

    Args:
        cost: The matching cost on c clips.
        residual: Residuals, shape (c, R).
        keep: Clips that count, shape (c,).
    """
    squares = {}
    for observed, values in zip(cost.clips.observed, split(cost, residual), strict=True):
        count = max(int(observed.mask[keep].sum()) * observed.width, 1)
        squares[observed.channel.key] = float((values[keep] ** 2).sum()) / count
    return squares


def noise_scale(squares: Mapping[str, float], before: Mapping[str, float]) -> dict[str, float]:
    """Noise sd that residuals show, over the declared one, for each channel.

    Args:
        squares: Channel -> mean squared residual.
        before: Channel -> factor on the declared noise sd that these residuals were divided by.
    """
    return {
        key: max(before.get(key, 1.0) * float(np.sqrt(square)), QUIETEST) for key, square in squares.items()
    }


def fitted_noise_scale(
    slopes: Linearisation, info: Information, before: Mapping[str, float]
) -> dict[str, float]:
    """Noise scale of each channel after the first states were fitted; see `noise_scale` for `before`."""
    keep = clip_weights(slopes, info) > 0.0
    return remaining_noise_scale(slopes.cost, info.residual, info.nuisance, keep, before)


def remaining_noise_scale(
    cost: MatchingCost, residual: FloatArray, first: FloatArray, keep: BoolArray, before: Mapping[str, float]
) -> dict[str, float]:
    """Noise scale of each channel that residuals and first-state errors show; see `noise_scale` for `before`.

    Args:
        cost: The matching cost on c clips.
        residual: Residuals, shape (c, R).
        first: First-state errors, shape (c, nx): they absorb a part of the misfit.
        keep: Clips that count, shape (c,).
        before: Channel -> factor on the declared noise sd.
    """
    total = max(float(cost.clips.counts[keep].sum()), 1.0)
    hidden = float((first[keep] ** 2).sum()) / total
    squares = mean_squares(cost, residual, keep)
    return noise_scale({key: square + hidden for key, square in squares.items()}, before)


def objective(
    cost: MatchingCost,
    residuals: Residuals,
    first: FloatArray,
    times: tuple[float, ...],
    clip_weight: FloatArray,
) -> FloatArray:
    """The cost that Gauss-Newton steps lower, without the prior of z, shape (p,).

    It is infinite where a clip of positive weight diverged.

    Args:
        cost: The matching cost on c clips.
        residuals: Residuals of p candidates.
        first: First-state errors of the candidates, shape (p, c, nx).
        times: Autocorrelation time of each channel, in samples.
        clip_weight: Weight of each clip, shape (c,).
    """
    total = clip_objectives(cost, residuals, first, times)
    return np.where(clip_weight > 0.0, total * np.maximum(clip_weight, 1e-300), 0.0).sum(axis=1)


def clip_objectives(
    cost: MatchingCost, residuals: Residuals, first: FloatArray, times: Sequence[float]
) -> FloatArray:
    """Terms of `objective` by clip, shape (p, c); infinite where it diverged."""
    total = np.einsum("pcx,pcx->pc", first, first)
    for loss, time in zip(cost.losses(residuals), times, strict=True):
        total = total + loss / time
    return np.where(residuals.completed, total, np.inf)


def split(cost: MatchingCost, residual: FloatArray) -> list[FloatArray]:
    """Cut residuals (..., c, R) into channels, (..., c, samples, k) each."""
    values, at = [], 0
    for observed in cost.clips.observed:
        samples, width = observed.mask.shape[1], observed.width
        values.append(residual[..., at : at + samples * width].reshape(*residual.shape[:-1], samples, width))
        at += samples * width
    return values


def of_residuals(cost: MatchingCost, of_channels: Sequence[float]) -> FloatArray:
    """A number of each channel for each of its residuals, shape (R,)."""
    sizes = [observed.mask.shape[1] * observed.width for observed in cost.clips.observed]
    return np.repeat(np.array(of_channels, dtype=np.float64), sizes)
