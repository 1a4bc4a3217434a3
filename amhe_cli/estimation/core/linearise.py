"""Slopes of the residuals without a derivative: a regression on samples.

The scalar cost of a rollout throws its residual vector away. Here antithetic samples of z and of every
clip's first-state error e (in units of its sd) are rolled out, and the residuals are regressed on them,

    r(z + dz, e + de) ~ r + Gz dz + Gx de,        a priori e ~ N(0, I) and z ~ N(0, I),

as ensemble Kalman smoothers do (Evensen, Raanes and Stordal 2019). e is sampled as it is known: from its
prior first, and from its posterior where a search has one already (posterior linearisation,
Garcia-Fernandez et al. 2015), since a contact that is missed by a millimetre is on no straight line. Where
contacts make the model rough, r is the mean over the samples, and it is r itself where it is smooth.
`information` makes of it what the clips say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.estimation.core.shape import coordinates
from amhe_cli.matching.cost import MatchingCost, Residuals


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
        curves: What is not linear in the h pairs of samples, 0 in those that diverged, shape (h, c, R).
        bend: Its mean square, shape (c, R).
        first: What was known of the first-state errors, and sampled.
        completed: Clips that could be linearised, shape (c,).
        rollouts, diverged: How many were run, and how many of them diverged.
    """

    cost: MatchingCost
    residual: FloatArray
    centre: FloatArray
    gain: FloatArray
    curves: FloatArray
    bend: FloatArray
    first: FirstStates
    completed: BoolArray
    rollouts: int
    diverged: int


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
    curves = even - np.einsum("hd,cdr->hcr", middle, gain[:, :d])
    lift, bend = _bent(curves, pairs)
    if averaged:
        bend = bend - lift**2
    completed = residuals.completed[-1] & (pairs.sum(axis=1) >= 0.75 * half)
    return Linearisation(
        cost=cost,
        residual=residuals.flat[-1] + averaged * lift,
        centre=residuals.flat[-1],
        gain=gain,
        curves=curves * pairs.T[:, :, None],
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
