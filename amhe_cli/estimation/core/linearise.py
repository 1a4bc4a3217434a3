"""Slopes of the residuals without a derivative: a regression on samples.

The scalar cost of a rollout throws its residual vector away. Here antithetic samples of z and of every
clip's first-state error e (in units of its sd) are rolled out, and the residuals are regressed on them,

    r(z + dz, e + de) ~ r + Gz dz + Gx de,        a priori e ~ N(0, I) and z ~ N(0, I),

as ensemble Kalman smoothers do (Evensen, Raanes and Stordal 2019). The samples of e follow what is known of
it: its prior at first, and its posterior where a search has one already (posterior linearisation,
Garcia-Fernandez et al. 2015), since a contact that is missed by a millimetre lies on no straight line. Where
contacts make the model non-smooth, r is the mean over the samples (`averaged`); elsewhere, r is the residual
itself.
`information` turns the slopes into information of the clips about z.

Samples are z + S w with w of unit variance: their shape S follows the valleys of the posterior. Where
parameters are known only together (mass and friction of a pushed box) it is a thin ridge. Samples drawn along
the axes leave it by hundreds of its widths, and the bend of the residuals there would count as information
along it.

A regression needs a pair of rollouts for each unknown of one measurement, not for each unknown of all
(Curtis, Powell and Reid 1974, "On the estimation of sparse Jacobian matrices"). The legs of a robot whose
base is fixed move nothing of each other: four legs need the rollouts of one. `Sparsity` says what moves what.

The residuals stay where the engine computed them, which may be a device: only sums over the samples are
copied to the host.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, namespace_of, to_host
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.engine.rollout import cut
from amhe_cli.matching.cost import MatchingCost, Residuals

#: Widest sampling sd along any direction, in prior sd.
WIDEST = 0.5
#: Steps to one side alone, in sd of the samples: what bends in them is less by this factor.
SHORT = 0.01
#: Clips whose arrays have more bytes than this take their turns, so that memory does not grow with the logs.
TURN_BYTES = 32 * 2**20
#: On a device, where calls should be large, they may take this share of its memory.
TURN_SHARE = 1 / 32


def sampling_width(space: ParameterSpace, share: float) -> FloatArray:
    """Sampling sd of z, shape (d,): a share of each parameter, or of a linear one's prior sd."""
    return np.minimum(space.in_z(share), WIDEST)


def diagonal(sd: float, active: BoolArray) -> FloatArray:
    """The same sd for every active parameter, shape (d, d)."""
    return np.diag(np.where(active, sd, 0.0))


def bounded(
    covariance: FloatArray, floor: FloatArray, active: BoolArray, alike: Sequence[IntArray] | None = None
) -> FloatArray:
    """Shape of a sampling covariance, no direction thinner than the floor or wider than WIDEST.

    Args:
        covariance: Sampling covariance of z, shape (d, d); what it says across groups is ignored.
        floor: Smallest sampling sd of each parameter, shape (d,).
        active: Parameters that are sampled at all, shape (d,).
        alike: Groups of parameters of which no sample mixes two; None: one group.
    """
    shape = np.zeros_like(covariance)
    for group in alike or [np.arange(len(covariance))]:
        rows = group[active[group]]
        scale = floor[rows]
        block = covariance[np.ix_(rows, rows)] / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(block)
        # in units of the floor, which is 1
        part = scale[:, None] * vectors * np.sqrt(np.maximum(values, 1.0))
        shape[np.ix_(rows, rows)] = part * np.minimum(1.0, WIDEST / np.linalg.norm(part, axis=0))
    return shape


def within(covariance: FloatArray, alike: Sequence[IntArray] | None) -> FloatArray:
    """Covariance (d, d) of each group of parameters, given all others: no sample leaves a common valley."""
    if alike is None or len(alike) == 1:
        return covariance
    precision, part = np.linalg.inv(covariance), np.zeros_like(covariance)
    for rows in alike:
        part[np.ix_(rows, rows)] = np.linalg.inv(precision[np.ix_(rows, rows)])
    return part


def coordinates(shape: FloatArray, steps: FloatArray) -> FloatArray:
    """The w of steps S w, shape (n, d); 0 along directions that are not sampled."""
    return steps @ np.linalg.pinv(shape, rcond=1e-9).T


def changed(before: FloatArray, after: FloatArray) -> bool:
    """Whether any sampling sd (d,) has changed by more than a quarter."""
    return bool((np.abs(after - before) > 0.25 * after).any())


def sampling_sd(shape: FloatArray) -> FloatArray:
    """Sampling sd of each parameter, shape (d,)."""
    return np.sqrt((shape**2).sum(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Sparsity:
    """Sparsity pattern of the Jacobian: the columns of each channel that the unknowns move.

    Args:
        z: Channel -> those that each of the d parameters moves, shape (d, k).
        first: Channel -> those that each of the nx first-state errors moves, shape (nx, k).

    A channel that the tables lack was not seen: any unknown may move all of it.
    """

    z: Mapping[str, BoolArray]
    first: Mapping[str, BoolArray]

    def residuals(self, cost: MatchingCost, first: bool) -> BoolArray:
        """Sparsity pattern of a cost's R residuals by d parameters and first-state errors, (d + nx, R)."""
        parts = []
        for observed in cost.clips.observed:
            rows = self._moving(observed.channel.key, observed.width, first)
            parts.append(np.tile(rows, observed.mask.shape[1]))
        return np.concatenate(parts, axis=1)

    @property
    def alike(self) -> list[IntArray]:
        """The parameters, those together that move the same measurements."""
        return alike(np.concatenate(list(self.z.values()), axis=1))

    def unknowns(self, first: bool) -> int:
        """Unknowns that a regression counts: those that move different measurements count once."""
        parts = [self._moving(key, columns.shape[1], first) for key, columns in self.z.items()]
        return int(colours(np.concatenate(parts, axis=1)).max()) + 1

    def _moving(self, key: str, width: int, first: bool = False) -> BoolArray:
        """Sparsity pattern of k columns of a channel by parameters and first-state errors, (d + nx, k)."""
        tables = (self.z, self.first) if first else (self.z,)
        every = (np.ones((len(next(iter(table.values()), ())), width), dtype=bool) for table in tables)
        return np.concatenate([table.get(key, rows) for table, rows in zip(tables, every, strict=True)])


def alike(moves: BoolArray) -> list[IntArray]:
    """The rows of a table of what unknowns move (u, R), those together that are equal."""
    packed = np.ascontiguousarray(np.packbits(moves, axis=1))  # bytes are compared much quicker than flags
    _, group = np.unique(packed.view(f"V{packed.shape[1]}")[:, 0], return_inverse=True)
    return [np.flatnonzero(group == g) for g in range(group.max() + 1)]


def patterns(moves: BoolArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Unknowns that move a residual, and all residuals that just these move: pairs of rows and columns."""
    for columns in alike(moves.T):
        yield np.flatnonzero(moves[:, columns[0]]), columns


def colours(moves: BoolArray) -> IntArray:
    """A number for each unknown, shape (u,), that no two have which move a common residual.

    The unknowns that move the most come first, each with the lowest number that is left.
    """
    kinds = moves[:, [columns[0] for columns in alike(moves.T)]].astype(int)
    clash = kinds @ kinds.T > 0
    colour = np.full(len(moves), -1)
    for row in np.argsort(-kinds.sum(axis=1), kind="stable"):
        taken = set(colour[clash[row]])
        colour[row] = next(number for number in range(len(moves)) if number not in taken)
    return colour


def moved_along(moves: BoolArray, shape: FloatArray) -> BoolArray:
    """Sparsity pattern by the w of samples S w, (u, R), from that by the unknowns and S (u, u)."""
    return np.asarray((shape != 0.0).T.astype(int) @ moves.astype(int) > 0)


@dataclass(frozen=True, slots=True, eq=False)
class FirstStates:
    """Distribution of the errors e of the recorded first states of c clips, in units of their sd.

    Args:
        mean: Mean of e, shape (c, nx); nx = 0 takes the recorded states as exact.
        shape: Samples are mean + shape w with w of unit variance, shape (c, nx, n). Of a direction that no
            sample takes, of n < nx, nothing is known but its prior.
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

    @property
    def forgotten(self) -> FirstStates:
        """The prior, sampled along the directions of these samples alone, which are orthogonal."""
        size = np.linalg.norm(self.shape, axis=1, keepdims=True)
        return FirstStates(np.zeros_like(self.mean), self.shape / np.maximum(size, 1e-300))


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Residuals and their slopes at one place, for c clips.

    Args:
        cost: The matching cost on the clips.
        residual: Residuals at (z, first), shape (c, R).
        lift: By how much their mean over the samples is larger, shape (c, R).
        gain: Slopes by the d coordinates of z and the nx of the first state, shape (c, d + nx, R).
        curves: Nonlinear (even) response to each of h pairs of samples, 0 for pairs that diverged, shape
            (h, c, R); numpy's or on the engine's device. None of samples to one side.
        bend: Mean square of the nonlinear response (bend), shape (c, R).
        first: What was known of the first-state errors; the samples followed it.
        pairs: The w of the z of h pairs, shape (h, d).
        completed: Clips that could be linearised, shape (c,).
        rollouts, diverged: Number of rollouts, and how many of them diverged.
        averaged: The model is not smooth: see `averaged`.
    """

    cost: MatchingCost
    residual: FloatArray
    lift: FloatArray
    gain: FloatArray
    curves: AnyArray
    bend: FloatArray
    first: FirstStates
    pairs: FloatArray
    completed: BoolArray
    rollouts: int
    diverged: int
    averaged: bool = False


def linearise(
    cost: MatchingCost,
    z: FloatArray,
    first: FirstStates,
    shape: FloatArray,
    samples: int,
    rng: np.random.Generator,
    *,
    straight: bool = False,
    sparsity: Sparsity | None = None,
) -> Linearisation:
    """Linearise the residuals of every clip about z and its first-state error.

    Args:
        cost: The matching cost on c clips.
        z: Where to linearise, shape (d,).
        first: What is known of the first-state errors.
        shape: Samples are z + shape w with w of unit variance, shape (d, k): along other directions than
            these k, slopes are zero.
        samples: Number of candidates; raised to two for each unknown of one residual.
        rng: Draws the directions.
        straight: Take short steps to one side instead of pairs, where samples have shown that hardly anything
            bends in them: half of the rollouts, and no bend.
        sparsity: What the unknowns move, where they do not move everything.
    """
    (d, k), nx = shape.shape, first.mean.shape[1]
    moves = None if sparsity is None else _moved(cost, sparsity, shape, first.shape)
    columns = np.arange(k + first.shape.shape[2]) if moves is None else colours(moves)
    unknowns = int(columns.max()) + 1
    directions = orthogonal_directions(unknowns, max(unknowns, samples // 2), rng)[:, columns]
    half = len(directions)
    signs, candidates, steps, middles = _samples(cost.system.space, z, shape, directions, straight)

    def of_clips(cost: MatchingCost, first: FirstStates) -> Linearisation:
        errors = first.mean + np.einsum("cij,hj->hci", first.shape, signs[:, k:])
        residuals = cost.residuals(candidates, errors if nx else None)
        odd, even, pairs = _parity(residuals, half)
        gain, bent = _by_coordinates(_regress(odd, pairs, steps, moves), shape, first.shape), len(even)
        # the middle of a pair may not be z either, and its share of the even response is linear
        curves = even - _predicted(gain[:, :d], middles, even)
        lift, bend = _moments(curves, pairs[:, :bent])
        return Linearisation(
            cost=cost,
            residual=to_host(residuals.stacked[-1]),
            lift=lift,
            gain=gain,
            curves=curves * namespace_of(curves).asarray(pairs.T[:bent, :, None]),
            bend=bend,
            first=first,
            pairs=directions[:, :k],
            completed=residuals.completed[-1] & (pairs.sum(axis=1) >= 0.75 * half),
            rollouts=residuals.completed.size,
            diverged=int((~residuals.completed).sum()),
        )

    residuals = sum(observed.mask.shape[1] * observed.width for observed in cost.clips.observed)
    most = int(TURN_SHARE * cost.engine.device_bytes)
    parts = turns(len(first.mean), 8 * len(candidates) * residuals, most)
    pieces = ((clips, of_clips(cost.of(clips), first.of(clips))) for clips in parts)
    # where nothing touches, a step is none the worse for slopes of seven digits
    kept_as = np.float64 if moves is None else np.float32
    return of_clips(cost, first) if len(parts) == 1 else _joined(cost, first, pieces, kept_as)


def averaged(found: Linearisation, shape: FloatArray) -> Linearisation:
    """The same of a non-smooth model: residuals in the mean over the samples, and slopes freed of jitter.

    Args:
        found: From pairs of samples.
        shape: Shape of the samples of z, (d, d).
    """
    bend = np.maximum(found.bend - found.lift**2, 0.0)  # rounding leaves less than nothing
    found = replace(found, residual=found.residual + found.lift, bend=bend)
    freed, own, first = np.zeros_like(found.gain), found.completed, found.first.shape
    gz, gx = np.split(found.gain[own], [len(shape)], axis=1)
    slopes = np.concatenate((shape.T @ gz, first[own].transpose(0, 2, 1) @ gx), axis=1)
    slopes = without_jitter(slopes, found.bend[own], len(found.pairs), len(shape))
    freed[own] = _by_coordinates(slopes, shape, first[own])
    return replace(found, gain=freed, averaged=True)


def _samples(
    space: ParameterSpace, z: FloatArray, shape: FloatArray, directions: FloatArray, straight: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Samples about z (d,): pairs along h directions (h, k + nx) of unit variance, or one side, and z.

    Returns:
        The samples' w (p, k + nx) and candidates (p, d), the last of z; half the difference of each pair's w
        (h, k + nx); and how far the pairs' middles lie from z (h, d), none of one side.
    """
    k, half = shape.shape[1], len(directions)
    directions = directions * SHORT if straight else directions
    others = directions[:0] if straight else -directions
    signs = np.concatenate((directions, others, np.zeros((1, directions.shape[1]))))
    candidates = space.clip(z + signs[:, :k] @ shape.T)
    # a bound may have cut a step short: the step that was really taken is half the pair's difference
    plus, minus = candidates[:half], candidates[-1:] if straight else candidates[half:-1]
    first_steps = directions[:, k:] * (0.5 if straight else 1.0)
    steps = np.concatenate((coordinates(shape, 0.5 * (plus - minus)), first_steps), axis=1)
    return signs, candidates, steps, 0.5 * (plus + minus)[: len(others)] - z


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
        arrays = {name: getattr(part, name) for name in ("residual", "lift", "gain", "bend", "completed")}
        arrays["curves"] = to_host(part.curves).swapaxes(0, 1)
        for name, values in arrays.items():
            if name not in whole:
                kind = kept_as if name == "gain" else values.dtype
                whole[name] = np.empty((len(first.mean), *values.shape[1:]), kind)
            whole[name][clips] = values
        rollouts, diverged = rollouts + part.rollouts, diverged + part.diverged
    curves = whole.pop("curves").swapaxes(0, 1)
    return Linearisation(
        cost=cost, first=first, pairs=part.pairs, curves=curves, rollouts=rollouts, diverged=diverged, **whole
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


def _moved(cost: MatchingCost, sparsity: Sparsity, shape: FloatArray, first_shape: FloatArray) -> BoolArray:
    """Sparsity pattern by each coordinate w of the samples, shape (d + nx, R)."""
    d, nx = len(shape), first_shape.shape[1]
    moves = sparsity.residuals(cost, nx > 0)
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
    completed, values = residuals.completed, residuals.stacked
    other = slice(half, -1) if len(values) > half + 1 else slice(half, None)
    plus, minus, centre = values[:half], values[other], values[-1]
    pairs = (completed[:half] & completed[other] & completed[-1]).T.astype(float)
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


def bent_by_z(found: Linearisation) -> FloatArray:
    """Mean square of what bends along the samples' axes of z, and neither jitters nor bends along e, (c, R).

    The even response of a non-smooth model to each pair, about its mean, is regressed on the squares of the
    pair's w. As slopes by w are, these slopes are freed of what chance makes of so few pairs.
    """
    squares, own = found.pairs**2, found.completed
    squares = (squares - squares.mean(axis=0)) / np.maximum(squares.std(axis=0), 1e-300)
    curves = to_host(found.curves)[:, own]
    slopes = _regress(curves - curves.mean(axis=0), np.ones(curves.shape[1::-1]), squares)
    slopes = without_jitter(slopes, found.bend[own], *squares.shape)
    bent = np.zeros_like(found.bend)
    bent[own] = (np.einsum("hd,cdr->hcr", squares, slopes) ** 2).mean(axis=0)
    return bent


def without_jitter(slopes: FloatArray, jitter: FloatArray, pairs: int, d: int) -> FloatArray:
    """Slopes (c, d + nx, R) shrunk so that their squares are as large as if no residual jittered.

    A slope from h pairs errs by the jitter's variance over h, and its square would count as information. In
    A = sum of s s' / (1 + jitter) that is k = sum of jitter / (1 + jitter) / h along every direction: of an
    eigenvalue l of A, l - k is no jitter. Slopes by z have one A of all clips, which knows their directions
    better than each clip's own; slopes by first states have one for each clip.

    Args:
        slopes: Slopes by the coordinates w of the samples, shape (c, d + nx, R).
        jitter: Sample variance (over h) of the even response, which is that of the odd one, shape (c, R).
        pairs: Number of pairs, h.
        d: Number of parameters.
    """
    weight, freed = 1.0 / (1.0 + jitter), []
    noise = (weight * jitter).sum(axis=1) / max(pairs - 1, 1)
    for k, some in enumerate(np.split(slopes, [d], axis=1)):
        square = (some * weight[:, None]) @ some.transpose(0, 2, 1)
        square, spurious = (square, noise) if k else (square.sum(axis=0), noise.sum())
        values, vectors = np.linalg.eigh(square)
        kept = np.sqrt(np.maximum(1.0 - spurious[..., None] / np.maximum(values, 1e-300), 0.0))
        freed.append((vectors * kept[..., None, :]) @ vectors.swapaxes(-1, -2) @ some)
    return np.concatenate(freed, axis=1)


def _by_coordinates(slopes: FloatArray, shape: FloatArray, first_shape: FloatArray) -> FloatArray:
    """Slopes by z and e (c, d + nx, R), from slopes by the w of their samples.

    A step is dz = S w, and r moves by Gz S w: the slopes by w are Gz S, those by z are they times S^-1.

    Args:
        slopes: Slopes by w, shape (c, k + n, R).
        shape: S of the samples of z, shape (d, k); directions that are not sampled have slope zero.
        first_shape: S of the samples of each clip's first-state error, shape (c, nx, n); likewise.
    """
    by_w, by_v = np.split(slopes, [shape.shape[1]], axis=1)
    of_z = np.einsum("wd,cwr->cdr", np.linalg.pinv(shape, rcond=1e-9), by_w)
    return np.concatenate((of_z, np.linalg.pinv(first_shape).transpose(0, 2, 1) @ by_v), axis=1)


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
