"""The statistically linearised update: Gauss-Newton from samples, without a derivative.

The scalar cost of a rollout throws its residual vector away. Here antithetic samples of z and of every
clip's first-state error e (in units of its sd) are rolled out, and the residuals are regressed on them,

    r(z + dz, e + de) ~ r + Gz dz + Gx de,        a priori e ~ N(0, I) and z ~ N(0, I),

as ensemble Kalman smoothers do (Evensen, Raanes and Stordal 2019). e is sampled as it is known: from its
prior first, and from its posterior where a search has one already (posterior linearisation,
Garcia-Fernandez et al. 2015), since a contact that is missed by a millimetre is on no straight line. Where
contacts make the model rough, r is the mean over the samples, and it is r itself where it is smooth. e is
then eliminated exactly: what the noise of the recorded first state leaves of a clip's information on z is

    M = Gz' W Gz - Gz' W Gx (Gx' W Gx + I)^-1 Gx' W Gz.

W holds the robust weights of the pseudo-Huber loss and, because neighbouring residuals of an imperfect
model repeat each other, the inverse autocorrelation time of each channel. What the samples bend away from
a straight line counts as noise, so that a residual behind a chaotic bounce has little weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.statistics import autocorrelation_time, pseudo_huber, pseudo_huber_weight
from amhe_cli.estimation.shape import coordinates
from amhe_cli.matching import MatchingCost, Residuals


@dataclass(frozen=True, slots=True, eq=False)
class FirstStates:
    """What is known of the errors e of the recorded first states, in their sd.

    Args:
        mean: Shape (c, nx); nx = 0 takes the recorded states as exact.
        shape: Samples are mean + shape w with w of unit variance, shape (c, nx, nx).
    """

    mean: FloatArray
    shape: FloatArray

    @staticmethod
    def recorded(clips: int, nx: int) -> FirstStates:
        """Nothing but what was recorded, and its noise."""
        return FirstStates(np.zeros((clips, nx)), np.tile(np.eye(nx), (clips, 1, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residuals and their slopes at one place, for c clips.

    Args:
        residual: Residuals at (z, first), or their mean over the samples about it, shape (c, R).
        centre: Residuals at (z, first) itself, shape (c, R).
        gain: Slopes by the d coordinates of z and the nx of the first state, shape (c, d + nx, R).
        bend: Mean square of what is not linear in the samples, shape (c, R).
        first: What was known of the first-state errors, and sampled.
        completed: Clips that could be linearised, shape (c,).
        rollouts, diverged: How many were run, and how many of them diverged.
    """

    cost: MatchingCost
    residual: FloatArray
    centre: FloatArray
    gain: FloatArray
    bend: FloatArray
    first: FirstStates
    completed: BoolArray
    rollouts: int
    diverged: int


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """What each clip says about z once its first state has been fitted.

    Args:
        matrix: Information matrix of each clip, shape (c, d, d); zero for a clip that diverged.
        score: Gradient of half its weighted squared residuals, shape (c, d).
        first_offset, first_gain: A step dz leaves the clip's best first-state error at
            offset + gain dz, shapes (c, nx) and (c, nx, d).
        first_precision: Of that error, given z, shape (c, nx, nx).
        residual: Residuals with that first state at dz = 0, shape (c, R).
        times: Autocorrelation time of each channel's residuals, in samples.
        completed: Clips that count at all, shape (c,).
    """

    matrix: FloatArray
    score: FloatArray
    first_offset: FloatArray
    first_gain: FloatArray
    first_precision: FloatArray
    residual: FloatArray
    times: tuple[float, ...]
    completed: BoolArray

    def first(self, dz: FloatArray) -> FloatArray:
        """Best first-state errors of every clip after steps dz (p, d): shape (p, c, nx)."""
        return self.first_offset + np.einsum("cxd,pd->pcx", self.first_gain, dz)

    def first_states(self, dz: FloatArray, narrowest: float) -> FirstStates:
        """What is known of the first states after a step dz (d,).

        Args:
            dz: The step.
            narrowest: Smallest sampling sd along any direction, in sd of the recorded state.
        """
        values, vectors = np.linalg.eigh(self.first_precision)
        sd = np.maximum(1.0 / np.sqrt(values), narrowest)
        return FirstStates(self.first(dz[None])[0], vectors * sd[:, None, :])


def linearise(
    cost: MatchingCost,
    z: FloatArray,
    first: FirstStates,
    shape: FloatArray,
    samples: int,
    rng: np.random.Generator,
    *,
    averaged: bool = False,
) -> Linearisation:
    """Linearise the residuals of every clip about z and its first-state error.

    Args:
        cost: The matching cost on c clips.
        z: Where, shape (d,).
        first: What is known of the first-state errors.
        shape: Samples are z + shape w with w of unit variance, shape (d, d).
        samples: Candidates wanted; raised to two for each unknown of the regression.
        rng: Draws the directions.
        averaged: Take the samples' mean for the residual, as a rough model wants, not the centre.
    """
    d, nx = z.size, first.mean.shape[1]
    directions = orthogonal_directions(d + nx, max(d + nx, samples // 2), rng)
    half = len(directions)
    signs = np.concatenate((directions, -directions, np.zeros((1, d + nx))))
    candidates = cost.system.space.clip(z + signs[:, :d] @ shape.T)
    starts = first.mean + np.einsum("cij,hj->hci", first.shape, signs[:, d:])
    residuals = cost.residuals(candidates, starts if nx else None)
    # a bound may have cut a step short: what was really tried is (plus - minus) / 2
    steps = coordinates(shape, 0.5 * (candidates[:half] - candidates[half:-1]))
    odd, even, pairs = _parity(residuals, half)
    gain = _regress(odd, pairs, np.concatenate((steps, directions[:, d:]), axis=1))
    gain[:, :d] = np.einsum("wd,cwr->cdr", np.linalg.pinv(shape, rcond=1e-9), gain[:, :d])
    gain[:, d:] = np.linalg.inv(first.shape).transpose(0, 2, 1) @ gain[:, d:]
    # and a pair is lopsided: what the slope makes of its middle is no bend
    middle = 0.5 * (candidates[:half] + candidates[half:-1]) - z
    lift, bend = _bent(even - np.einsum("hd,cdr->hcr", middle, gain[:, :d]), pairs)
    if averaged:
        bend = bend - lift**2
    completed = residuals.completed[-1] & (pairs.sum(axis=1) >= 0.75 * half)
    return Linearisation(
        cost=cost,
        residual=residuals.flat[-1] + averaged * lift,
        centre=residuals.flat[-1],
        gain=gain,
        bend=bend,
        first=first,
        completed=completed,
        rollouts=residuals.completed.size,
        diverged=int((~residuals.completed).sum()),
    )


def orthogonal_directions(dimension: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Directions whose coordinates have unit variance and are uncorrelated, shape (count, dimension).

    Blocks of random orthogonal matrices: as few samples as unknowns determine a regression on them.
    """
    blocks = [
        np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
        for _ in range(int(np.ceil(count / dimension)))
    ]
    return np.concatenate(blocks)[:count] * np.sqrt(dimension)


def _parity(residuals: Residuals, half: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Odd and even response to each pair of samples (half, c, R), and which pairs completed (c, half)."""
    plus, minus, centre = residuals.flat[:half], residuals.flat[half:-1], residuals.flat[-1]
    pairs = (residuals.completed[:half] & residuals.completed[half:-1] & residuals.completed[-1]).T
    return 0.5 * (plus - minus), 0.5 * (plus + minus) - centre, pairs.astype(float)


def _bent(even: FloatArray, pairs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and mean square of the even response (half, c, R) over the pairs that completed, (c, R) each."""
    count = np.maximum(pairs.sum(axis=1), 1.0)[:, None]
    return np.einsum("ch,hcr->cr", pairs, even) / count, np.einsum("ch,hcr->cr", pairs, even**2) / count


def _regress(odd: FloatArray, pairs: FloatArray, steps: FloatArray) -> FloatArray:
    """Least squares of the odd response on the steps: gain (c, n, R); even orders have cancelled."""
    normal = np.einsum("ch,hi,hj->cij", pairs, steps, steps)
    size = np.einsum("hi,hi->i", steps, steps)
    normal += np.diag(1e-9 * size + (size <= 0.0))  # an unmoved parameter has slope zero
    right = np.einsum("chi,hcr->cir", pairs[..., None] * steps, odd, optimize=True)
    return np.linalg.solve(normal, right)


def information(
    found: Linearisation, channels: Sequence[bool] | None = None, *, straight: bool = False
) -> Information:
    """Fit each clip's first state and leave its information on z.

    Args:
        found: The linearisation.
        channels: Which channels may speak; None: all.
        straight: Take the samples' bend for nothing: what narrower samples would find.
    """
    cost, start = found.cost, found.residual
    mean = found.first.mean
    nx = mean.shape[1]
    gz, gx = found.gain[:, : found.gain.shape[1] - nx], found.gain[:, found.gain.shape[1] - nx :]
    heard = _expand(cost, channels or [True] * len(cost.clips.observed)) * found.completed[:, None]
    heard = heard if straight else heard / (1.0 + found.bend)
    fitted, times = start, (1.0,) * len(cost.clips.observed)
    for _ in range(2):  # the weights need the fitted residuals, which need the weights
        weight = _weights(cost, fitted, times) * heard
        wx, wz = gx * weight[:, None], gz * weight[:, None]
        xx = wx @ gx.transpose(0, 2, 1) + np.eye(nx)
        xz = wx @ gz.transpose(0, 2, 1)
        gradient = np.einsum("cir,cr->ci", wx, start) + mean
        solved = np.linalg.solve(xx, np.concatenate((gradient[..., None], xz), axis=2))
        fitted = start - np.einsum("ci,cir->cr", solved[..., 0], gx)
        times = channel_times(cost, fitted, found.completed)
    return Information(
        matrix=wz @ gz.transpose(0, 2, 1) - xz.transpose(0, 2, 1) @ solved[..., 1:],
        score=np.einsum("cir,cr->ci", wz, start) - np.einsum("cij,ci->cj", xz, solved[..., 0]),
        first_offset=mean - solved[..., 0],
        first_gain=np.negative(solved[..., 1:]),
        first_precision=xx,
        residual=fitted,
        times=times,
        completed=found.completed,
    )


def _expand(cost: MatchingCost, channels: Sequence[bool]) -> FloatArray:
    """Mask of the flat residuals (R,) from a mask of the channels."""
    parts = [
        np.full(o.mask.shape[1] * o.width, float(on))
        for o, on in zip(cost.clips.observed, channels, strict=True)
    ]
    return np.concatenate(parts)


def _weights(cost: MatchingCost, flat: FloatArray, times: tuple[float, ...]) -> FloatArray:
    """Weight of every residual, shape (c, R)."""
    weights = []
    for values, time in zip(split(cost, flat), times, strict=True):
        squared = np.einsum("csk,csk->cs", values, values)
        weight = pseudo_huber_weight(squared, cost.settings.huber) / time
        weights.append(np.repeat(weight, values.shape[2], axis=1))
    return np.concatenate(weights, axis=1)


def channel_times(cost: MatchingCost, flat: FloatArray, completed: BoolArray) -> tuple[float, ...]:
    """Autocorrelation time of each channel's residuals (c, R), in samples."""
    times = []
    for observed, values in zip(cost.clips.observed, split(cost, flat), strict=True):
        rows = np.moveaxis(values[completed], 2, 1)  # (c, k, s)
        mask = np.broadcast_to(observed.mask[completed, None], rows.shape)
        times.append(autocorrelation_time(rows.reshape(-1, rows.shape[2]), mask.reshape(-1, rows.shape[2])))
    return tuple(times)


def split(cost: MatchingCost, flat: FloatArray) -> list[FloatArray]:
    """Cut flat residuals (c, R) into channels (c, samples, k)."""
    values, at = [], 0
    for observed in cost.clips.observed:
        samples, width = observed.mask.shape[1], observed.width
        values.append(flat[:, at : at + samples * width].reshape(len(flat), samples, width))
        at += samples * width
    return values


def objective(
    cost: MatchingCost,
    residuals: Residuals,
    first: FloatArray,
    times: tuple[float, ...],
    clip_weight: FloatArray,
) -> FloatArray:
    """What the update lowers, without the prior of z, shape (p,); inf where a weighted clip diverged.

    Args:
        residuals: Of p candidates on c clips.
        first: Their first-state errors, shape (p, c, nx).
        times: Autocorrelation time of each channel.
        clip_weight: Weight of each clip, shape (c,).
    """
    total = np.einsum("pcx,pcx->pc", first, first)
    for values, time in zip(residuals.values, times, strict=True):
        squared = np.einsum("pcsk,pcsk->pcs", values, values)
        total = total + pseudo_huber(squared, cost.settings.huber).sum(axis=2) / time
    total = np.where(residuals.completed, total, np.inf)
    return np.where(clip_weight > 0.0, total * np.maximum(clip_weight, 1e-300), 0.0).sum(axis=1)
