"""Slopes of the residuals without a derivative: a regression on samples.

The scalar cost of a rollout throws its residual vector away. Here antithetic samples of z and of every
clip's first-state error e (in units of its sd) are rolled out, and the residuals are regressed on them,

    r(z + dz, e + de) ~ r + Gz dz + Gx de,        a priori e ~ N(0, I) and z ~ N(0, I),

as ensemble Kalman smoothers do (Evensen, Raanes and Stordal 2019). The samples of e follow what is known of
it: its prior at first, and its posterior where a search has one already (posterior linearisation,
Garcia-Fernandez et al. 2015), since a contact that is missed by a millimetre lies on no straight line. Where
contacts make the model rough, r is the mean over the samples; where it is smooth, r is the residual itself.
`information` turns the slopes into information of the clips about z.

The residuals stay where the engine computed them, which may be a device: only sums over the samples are
copied to the host.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    IntArray,
    namespace_of,
    to_host,
)
from amhe_cli.engine.rollout import cut
from amhe_cli.estimation.core.reach import Reach, colours, moved_along, patterns
from amhe_cli.estimation.core.shape import coordinates
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Steps to one side alone, in sd of the samples: what bends in them is less by this factor.
SHORT = 0.01
#: Clips whose arrays have more bytes than this take their turns, so that memory does not grow with the logs;
#: on a device, where calls should be large, more than this share of its memory.
TURN_BYTES, TURN_SHARE = 32 * 2**20, 1 / 32


@dataclass(frozen=True, slots=True, eq=False)
class FirstStates:
    """What is known of the errors e of the recorded first states of c clips, in units of their sd.

    Args:
        mean: Mean of e, shape (c, nx); nx = 0 takes the recorded states as exact.
        shape: Samples are mean + shape w with w of unit variance, shape (c, nx, nx).
    """

    mean: FloatArray
    shape: FloatArray

    @staticmethod
    def recorded(clips: int, nx: int) -> FirstStates:
        """The prior: the recorded states with the noise of their sensors."""
        return FirstStates(np.zeros((clips, nx)), np.tile(np.eye(nx), (clips, 1, 1)))

    def of(self, clips: IntArray) -> FirstStates:
        """Those of some of the clips."""
        return FirstStates(self.mean[clips], self.shape[clips])


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residuals and their slopes at one place, for c clips.

    Args:
        cost: The matching cost on the clips.
        residual: Residuals at (z, first), or their mean over the samples about it, shape (c, R).
        centre: Residuals at (z, first) itself, shape (c, R).
        gain: Slopes by the d coordinates of z and the nx of the first state, shape (c, d + nx, R).
        curves: Nonlinear (even) response to each of h pairs of samples, 0 for pairs that diverged, shape
            (h, c, R); numpy's or on the engine's device. None of samples to one side.
        bend: Mean square of the nonlinear response (bend), shape (c, R).
        first: What was known of the first-state errors; the samples followed it.
        completed: Clips that could be linearised, shape (c,).
        rollouts, diverged: Number of rollouts, and how many of them diverged.
    """

    cost: MatchingCost
    residual: FloatArray
    centre: FloatArray
    gain: FloatArray
    curves: AnyArray
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
    straight: bool = False,
    reach: Reach | None = None,
) -> Linearisation:
    """Linearise the residuals of every clip about z and its first-state error.

    Args:
        cost: The matching cost on c clips.
        z: Where to linearise, shape (d,).
        first: What is known of the first-state errors.
        shape: Samples are z + shape w with w of unit variance, shape (d, d).
        samples: Number of candidates; raised to two for each unknown of one residual.
        rng: Draws the directions.
        averaged: Return the samples' mean as the residual, for a rough model, instead of the centre.
        straight: Take short steps to one side instead of pairs, where samples have shown that hardly anything
            bends in them: half of the rollouts, and no bend.
        reach: What the unknowns move, where they do not move everything.
    """
    d, nx = z.size, first.mean.shape[1]
    moves = None if reach is None else _moved(cost, reach, shape, first.shape)
    columns = np.arange(d + nx) if moves is None else colours(moves)
    unknowns = int(columns.max()) + 1
    directions = orthogonal_directions(unknowns, max(unknowns, samples // 2), rng)[:, columns]
    directions = directions * SHORT if straight else directions
    half, others = len(directions), directions[:0] if straight else -directions
    signs = np.concatenate((directions, others, np.zeros((1, d + nx))))
    candidates = cost.system.space.clip(z + signs[:, :d] @ shape.T)  # h pairs, and their centre
    # a bound may have cut a step short: the step that was really taken is half the pair's difference
    plus, minus = candidates[:half], candidates[-1:] if straight else candidates[half:-1]
    first_steps = directions[:, d:] * (0.5 if straight else 1.0)
    steps = np.concatenate((coordinates(shape, 0.5 * (plus - minus)), first_steps), axis=1)
    middles = 0.5 * (plus + minus)[: len(others)] - z

    def of_clips(cost: MatchingCost, first: FirstStates) -> Linearisation:
        errors = first.mean + np.einsum("cij,hj->hci", first.shape, signs[:, d:])
        residuals = cost.residuals(candidates, errors if nx else None)
        odd, even, pairs = _parity(residuals, half)
        gain = _by_coordinates(_regress(odd, pairs, steps, moves), shape, first.shape)
        # the middle of a pair may not be z either, and its share of the even response is linear
        bent = len(even)
        curves = even - _predicted(gain[:, :d], middles, even)
        lift, bend = _moments(curves, pairs[:, :bent])
        centre = to_host(residuals.stacked[-1])
        return Linearisation(
            cost=cost,
            residual=centre + averaged * lift,
            centre=centre,
            gain=gain,
            curves=curves * namespace_of(curves).asarray(pairs.T[:bent, :, None]),
            bend=bend - lift**2 if averaged else bend,
            first=first,
            completed=residuals.completed[-1] & (pairs.sum(axis=1) >= 0.75 * half),
            rollouts=residuals.completed.size,
            diverged=int((~residuals.completed).sum()),
        )

    residuals = sum(observed.mask.shape[1] * observed.width for observed in cost.clips.observed)
    most = int(TURN_SHARE * cost.engine.device_bytes)
    parts = turns(len(first.mean), 8 * len(candidates) * residuals, most)
    if len(parts) == 1:
        return of_clips(cost, first)
    done = ((clips, of_clips(cost.of(clips), first.of(clips))) for clips in parts)
    # where nothing touches, a step is none the worse for slopes of seven digits
    return _joined(cost, first, done, np.float64 if moves is None else np.float32)


def turns(count: int, each: int, most: int = 0) -> list[IntArray]:
    """The numbers of so many clips of so many bytes each, in parts of about `most`, at least `TURN_BYTES`."""
    return cut(count, -(-count * each // max(TURN_BYTES, most)))


def _joined(
    cost: MatchingCost,
    first: FirstStates,
    parts: Iterable[tuple[IntArray, Linearisation]],
    kept_as: type[np.floating],
) -> Linearisation:
    """Linearisations of some clips each as one of all clips, in no more memory than the whole and one.

    The slopes, which are most of it, are kept in the given type.
    """
    whole: dict[str, AnyArray] = {}
    rollouts = diverged = 0
    for clips, part in parts:
        arrays = {name: getattr(part, name) for name in ("residual", "centre", "gain", "bend", "completed")}
        arrays["curves"] = to_host(part.curves).swapaxes(0, 1)
        for name, values in arrays.items():
            if name not in whole:
                kind = kept_as if name == "gain" else values.dtype
                whole[name] = np.empty((len(first.mean), *values.shape[1:]), kind)
            whole[name][clips] = values
        rollouts, diverged = rollouts + part.rollouts, diverged + part.diverged
    curves = whole.pop("curves").swapaxes(0, 1)
    return Linearisation(cost=cost, first=first, curves=curves, rollouts=rollouts, diverged=diverged, **whole)


def orthogonal_directions(dimension: int, count: int, rng: np.random.Generator) -> FloatArray:
    """Directions whose coordinates have unit variance and are uncorrelated, shape (count, dimension).

    Blocks of random orthogonal matrices: as few samples as unknowns determine a regression on them.
    """
    blocks = [
        np.linalg.qr(rng.standard_normal((dimension, dimension)))[0]
        for _ in range(int(np.ceil(count / dimension)))
    ]
    return np.concatenate(blocks)[:count] * np.sqrt(dimension)


def _moved(cost: MatchingCost, reach: Reach, shape: FloatArray, first_shape: FloatArray) -> BoolArray:
    """Which residuals each coordinate w of the samples moves, shape (d + nx, R)."""
    d, nx = len(shape), first_shape.shape[1]
    moves = reach.residuals(cost, nx > 0)
    parts = moved_along(moves[:d], shape), moved_along(moves[d:], np.abs(first_shape).sum(axis=0))
    return np.concatenate(parts)


def _parity(residuals: Residuals, half: int) -> tuple[AnyArray, AnyArray, FloatArray]:
    """Odd and even response to each of h pairs of samples, and which pairs completed.

    Args:
        residuals: Residuals of one side of each pair, the other side where there is one, and the centre.
        half: Number of pairs, h.

    Returns:
        Half the difference within each pair, shape (h, c, R), and its mean less the centre, likewise, of no
        pair where the centre is the other side of all; 1 for the pairs that completed, else 0, shape (c, h).
    """
    done, values = residuals.completed, residuals.stacked
    other = slice(half, -1) if len(values) > half + 1 else slice(half, None)
    plus, minus, centre = values[:half], values[other], values[-1]
    pairs = (done[:half] & done[other] & done[-1]).T.astype(float)
    even = (0.5 * (plus + minus) - centre)[: len(values) - 1 - half]
    return 0.5 * (plus - minus), even, pairs


def _regress(
    odd: AnyArray, pairs: FloatArray, steps: FloatArray, moves: BoolArray | None = None
) -> FloatArray:
    """Least squares of the odd response on the steps: slopes (c, n, R); even orders have cancelled.

    Args:
        odd: Odd response to h pairs of samples, shape (h, c, R).
        pairs: Weight of each pair on each clip, shape (c, h).
        steps: Steps of the pairs, shape (h, n).
        moves: Which residuals each of the unknowns moves, shape (n, R); None: all.
    """
    if moves is not None:
        slopes = np.zeros((len(pairs), *moves.shape))
        for rows, those in patterns(moves):
            slopes[:, rows[:, None], those] = _regress(odd[:, :, those], pairs, steps[:, rows])
        return slopes
    xp = namespace_of(odd)
    normal = np.einsum("ch,hi,hj->cij", pairs, steps, steps)
    size = np.einsum("hi,hi->i", steps, steps)
    normal += np.diag(1e-9 * size + (size <= 0.0))  # an unmoved parameter has slope zero
    weighted = xp.asarray(pairs[..., None] * steps)
    right = to_host(xp.einsum("chi,hcr->cir", weighted, odd, optimize=True))
    return np.linalg.solve(normal, right)


def _by_coordinates(slopes: FloatArray, shape: FloatArray, first_shape: FloatArray) -> FloatArray:
    """Slopes by z and e (c, d + nx, R), from slopes by the w of their samples.

    A step is dz = S w, and r moves by Gz S w: the slopes by w are Gz S, those by z are they times S^-1.

    Args:
        slopes: Slopes by w, shape (c, d + nx, R).
        shape: S of the samples of z, shape (d, d); directions that are not sampled have slope zero.
        first_shape: S of the samples of each clip's first-state error, shape (c, nx, nx).
    """
    d, gain = len(shape), np.empty_like(slopes)
    gain[:, :d] = np.einsum("wd,cwr->cdr", np.linalg.pinv(shape, rcond=1e-9), slopes[:, :d])
    gain[:, d:] = np.linalg.inv(first_shape).transpose(0, 2, 1) @ slopes[:, d:]
    return gain


def _predicted(gain: FloatArray, steps: FloatArray, like: AnyArray) -> AnyArray:
    """Linear response (h, c, R) of slopes (c, d, R) to steps of z (h, d), where `like` lies."""
    xp = namespace_of(like)
    return xp.einsum("hd,cdr->hcr", xp.asarray(steps), xp.asarray(gain))


def _moments(curves: AnyArray, pairs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and mean square of the even response (h, c, R) over completed pairs (c, h), (c, R) each."""
    xp, count = namespace_of(curves), np.maximum(pairs.sum(axis=1), 1.0)[:, None]
    weight = xp.asarray(pairs)
    first, second = (to_host(xp.einsum("ch,hcr->cr", weight, power)) for power in (curves, curves**2))
    return first / count, second / count
