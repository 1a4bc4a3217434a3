"""What clips say about z, once the error of each clip's first state has been fitted and eliminated.

From the slopes Gz, Gx of residuals r (`linearised`): what the noise of the recorded first state leaves of a
clip's information on z is

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
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation
from amhe_cli.matching.cost import MatchingCost, Residuals


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
