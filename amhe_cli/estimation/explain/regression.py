"""Which columns explain a residual, on data that were not fitted, and beyond chance?

A residual (n, k) is cut into blocks, longer than it remembers. A candidate is one or several columns. It is
fitted beside the nuisance columns on some of the blocks, and scored on the others: its share is how much of
the residual's square it takes away there. Chance is what the best of all candidates takes away where nothing
is left to explain: of the residual that is left, each block under a random sign. A block keeps what its
samples have in common, and without a cause its sign says nothing (wild bootstrap by clusters).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from amhe_cli.core.arrays import FloatArray

#: Random signs of the blocks, and the share of them in which any candidate may exceed chance.
SIGNS, LEVEL = 200, 0.01
#: Groups of blocks that are left out in turn.
FOLDS = 6
#: Fewest and most blocks, and their length in units of the time that a residual remembers.
BLOCKS, MEMORY = (12, 48), 2.0
#: Causes that are named at most, and the share that rounds to nothing.
MOST, LITTLE = 5, 0.005
#: A cause explains more than so many times what is left without one, which a simulation tells roughly.
DOUBT = 2.0
#: Ridge on columns, as a share of their square: of two that are alike neither is infinite.
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class CauseColumns:
    """One candidate.

    Args:
        dofs: CauseColumns of the residual of whose square its share is.
        values: Its m columns, shape (m, n, k).
        numbers: How many numbers it takes: its columns, and what was tried at several values.
        most: The largest first coefficient that can be.
        least: The least size of that coefficient that says anything.
    """

    dofs: tuple[int, ...]
    values: FloatArray
    numbers: int
    most: float = np.inf
    least: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """A candidate that explains more than chance.

    Args:
        index: Its place among the candidates.
        share: Share of the residual's square, where it acts, that it takes away on data that were not fitted.
        coefficients, sd: Of its columns, shape (m,), beside all that were chosen.
        rivals: Places of candidates that explain as much within chance, best first.
    """

    index: int
    share: float
    coefficients: FloatArray
    sd: FloatArray
    rivals: tuple[int, ...]


def blocks_of(stretches: Sequence[slice], memory: float) -> list[slice]:
    """Blocks of about equal length in unbroken stretches of rows, no shorter than a residual remembers."""
    total = sum(s.stop - s.start for s in stretches)
    length = max(int(np.ceil(MEMORY * memory)), total // BLOCKS[1], 1)
    length = max(1, min(length, total // BLOCKS[0]))
    blocks = []
    for stretch in stretches:
        count = max(1, (stretch.stop - stretch.start) // length)
        edges = np.linspace(stretch.start, stretch.stop, count + 1).round().astype(int)
        blocks += [slice(int(a), int(b)) for a, b in pairwise(edges)]
    return blocks


def memory_of(residual: FloatArray, stretches: Sequence[slice]) -> float:
    """Samples until the autocorrelation of a residual (n, k) crosses zero, in its longest stretch."""
    stretch, longest = max(stretches, key=lambda s: s.stop - s.start), 1
    for column in residual[stretch].T:
        centred = column - column.mean()
        power = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
        below = np.flatnonzero(np.fft.irfft(power)[: centred.size] <= 0.0)
        longest = max(longest, int(below[0]) if below.size else 1)
    return float(longest)


class Regression:
    """A residual with its nuisance columns, and candidates beside them.

    Args:
        residual: What is to be explained, shape (n, k).
        nuisance: CauseColumns that explain too and are no causes, shape (p, n, k).
        blocks: Blocks of rows.
        toward: Prior mean of the nuisance's coefficients, in its prior sd; None: no prior.
        memory: Samples that the residual remembers: so many count as one against the prior.
    """

    def __init__(
        self,
        residual: FloatArray,
        nuisance: FloatArray,
        blocks: Sequence[slice],
        toward: FloatArray | None = None,
        memory: float = 1.0,
    ) -> None:
        self._memory = memory
        self._blocks = list(blocks)
        self._folds = [range(f, len(self._blocks), FOLDS) for f in range(min(FOLDS, len(self._blocks)))]
        self._toward = toward
        self._scale = np.ones(residual.shape[1])
        for _ in range(3):  # in units of what the nuisance leaves of each column
            left = self._left(nuisance / self._scale, residual / self._scale) * self._scale
            self._scale = np.sqrt(np.maximum((left**2).mean(axis=0), 1e-30))
        self._residual, self._x = residual / self._scale, nuisance / self._scale

    @property
    def left(self) -> FloatArray:
        """What the nuisance leaves of the residual, shape (n, k)."""
        return self._left(self._x, self._residual) * self._scale

    def ladder(
        self,
        candidates: Sequence[CauseColumns],
        rng: np.random.Generator,
        error: Callable[[], FloatArray] | None = None,
    ) -> tuple[list[Explained], float, FloatArray, FloatArray]:
        """Candidates that explain more than chance, one after the other.

        Args:
            candidates: The candidates.
            rng: Generator of the signs of blocks.
            error: Mean square of the residual that has no cause, shape (k,), once it is asked for.

        Returns:
            They; the share that chance explains once they are known; what they leave, shape (n, k); and the
            coefficients of the nuisance beside them, shape (p,).
        """
        weighted = [candidate.values / self._scale for candidate in candidates]
        left = self._left(self._x, self._residual)
        own = np.array([(left[:, list(c.dofs)] ** 2).sum() for c in candidates])
        signs = rng.choice([-1.0, 1.0], (SIGNS, len(self._blocks)))
        least = None
        chosen: list[int] = []
        rows: dict[int, tuple[float, tuple[int, ...]]] = {}
        chance = 0.0
        while candidates:
            x = self._beside(chosen, weighted)
            falls = self._falls(x, weighted)
            total = falls.sum(axis=1)
            total[chosen] = -np.inf
            for best in np.argsort(-total):  # the first that can be
                if self._possible(chosen, weighted, int(best), candidates[best]):
                    break
                total[best] = -np.inf
            best = int(total.argmax())
            left = self._left(self._beside([*chosen, best], weighted), self._residual)
            null = self._falls(x, weighted, left, signs).max(axis=0)
            beyond = float(np.quantile(null, 1.0 - LEVEL))
            chance = beyond / own[best]
            if not total[best] > beyond or len(chosen) == MOST:
                break
            if least is None:
                least = self._least(candidates, own, error)
            if not total[best] > least[best]:
                break
            alike = self._rivals(falls, total, best, beyond, signs)
            alike = [i for i in alike if self._possible(chosen, weighted, i, candidates[i])]
            alike = [i for i in alike if self._more(best, [*chosen, i], weighted, signs, least) <= 0.0]
            alike.insert(0, best)
            best = min(alike, key=lambda i: (candidates[i].numbers, -total[i]))  # the simplest of them
            chosen.append(best)
            rows[best] = total[best] / own[best], tuple(i for i in alike if i != best)
        if least is not None:
            chosen = self._needed(chosen, weighted, signs, least)
        x = self._beside(chosen, weighted)
        values, sd = self._fitted(x)
        found, at = [], len(self._x)
        for index in chosen:
            own_columns = slice(at, at := at + len(weighted[index]))
            share, rivals = rows[index]
            found.append(Explained(index, share, values[own_columns], sd[own_columns], rivals))
        return found, chance, self._left(x, self._residual) * self._scale, values[: len(self._x)]

    def _least(
        self,
        candidates: Sequence[CauseColumns],
        own: FloatArray,
        error: Callable[[], FloatArray] | None,
    ) -> FloatArray:
        """What a cause takes away at least: more than rounds to nothing, and than there is without one."""
        squares = np.zeros_like(self._scale) if error is None else error() / self._scale**2
        without = [squares[list(c.dofs)].sum() for c in candidates]
        return np.maximum(LITTLE * own, DOUBT * len(self._residual) * np.array(without))

    def _possible(
        self, chosen: Sequence[int], weighted: Sequence[FloatArray], index: int, one: CauseColumns
    ) -> bool:
        """Whether the first coefficient of a candidate may be one that can be, as far as its sd tells."""
        if one.most == np.inf and not one.least:
            return True
        x = self._beside([*chosen, index], weighted)
        at = len(x) - len(weighted[index])
        values, sd = self._fitted(x)
        return bool(values[at] - 2.0 * sd[at] <= one.most and abs(values[at]) >= one.least)

    def _needed(
        self, chosen: Sequence[int], weighted: Sequence[FloatArray], signs: FloatArray, least: FloatArray
    ) -> list[int]:
        """Those that explain more than chance beside all others: later ones may replace earlier ones."""
        kept = list(chosen)
        while kept:
            more = [self._more(one, [i for i in kept if i != one], weighted, signs, least) for one in kept]
            if min(more) > 0.0:
                break
            del kept[int(np.argmin(more))]
        return kept

    def _more(
        self,
        index: int,
        beside: Sequence[int],
        weighted: Sequence[FloatArray],
        signs: FloatArray,
        least: FloatArray,
    ) -> float:
        """By how much a candidate explains more beside others than chance and the method's own error."""
        x, both = self._beside(beside, weighted), self._beside([*beside, index], weighted)
        null = self._falls(x, [weighted[index]], self._left(both, self._residual), signs)[0]
        fall = self._falls(x, [weighted[index]])[0].sum()
        return float(fall - max(np.quantile(null, 1.0 - LEVEL), least[index]))

    def _beside(self, chosen: Iterable[int], weighted: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([self._x, *(weighted[i] for i in chosen)])

    def _sums(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """Sums of products over each block, shape (blocks, a, b), of (a, n, k) and (b, n, k)."""
        return np.stack(
            [
                one[:, rows].reshape(len(one), -1) @ other[:, rows].reshape(len(other), -1).T
                for rows in self._blocks
            ]
        )

    def _prior(self, squares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Diagonal of the prior's precision, and its pull, of columns with these squares (p,)."""
        precision, pull = _TINY * np.maximum(squares, 1e-30), np.zeros(squares.size)
        if self._toward is not None:
            precision[: self._toward.size] += self._memory
            pull[: self._toward.size] = self._memory * self._toward
        return precision, pull

    def _normal(self, x: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        flat = x.reshape(len(x), -1)
        precision, pull = self._prior((flat**2).sum(axis=1))
        return flat @ flat.T + np.diag(precision), flat @ residual.ravel() + pull

    def _left(self, x: FloatArray, residual: FloatArray) -> FloatArray:
        """What columns x (p, n, k) leave of a residual (n, k), fitted to all blocks."""
        if not len(x):
            return residual
        return residual - np.tensordot(np.linalg.solve(*self._normal(x, residual)), x, 1)

    def _fitted(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients of all columns (p,), and their sd by the scatter over blocks."""
        if not len(x):
            return np.zeros(0), np.zeros(0)
        matrix, right = self._normal(x, self._residual)
        found: FloatArray = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
        left = self._residual - np.tensordot(found, x, 1)
        scores = self._sums(x, left[None])[..., 0]
        inverse = np.linalg.inv(matrix)
        variance: FloatArray = np.abs(np.diag(inverse @ (scores.T @ scores) @ inverse))
        return found, np.sqrt(variance)

    def _falls(
        self,
        x: FloatArray,
        candidates: Sequence[FloatArray],
        residual: FloatArray | None = None,
        signs: FloatArray | None = None,
    ) -> FloatArray:
        """By how much candidates beside x lower the squares of blocks that were not fitted.

        Args:
            x: CauseColumns beside which they stand, shape (p, n, k).
            candidates: CauseColumns of each, (m, n, k).
            residual: Of what, shape (n, k); None: the residual as it is.
            signs: Signs of the blocks, shape (q, blocks); None: as they are.

        Returns:
            Shape (candidates, blocks); with signs (candidates, q), summed over the blocks.
        """
        real = residual is None
        target = (self._residual if real else residual)[None]
        xx, xe = self._sums(x, x), self._sums(x, target)[..., 0]
        precision, pull = self._prior((x**2).sum(axis=(1, 2)))
        pull = pull * real
        signs = np.ones((1, len(self._blocks))) if signs is None else signs
        folds = []
        for fold in self._folds:
            held = np.isin(np.arange(len(self._blocks)), fold)
            inverse = np.linalg.inv(xx[~held].sum(axis=0) + np.diag(precision))
            gx = signs[:, ~held] @ xe[~held] + pull
            folds.append((held, inverse, gx, gx @ inverse))
        return np.array([self._fall(c, x, xx, xe, target, folds, signs, real) for c in candidates])

    def _fall(self, c, x, xx, xe, target, folds, signs, real):  # type: ignore[no-untyped-def]
        cx, cc, ce = self._sums(c, x), self._sums(c, c), self._sums(c, target)[..., 0]
        ridge = np.diag(_TINY * np.maximum(np.einsum("bii->i", cc), 1e-30))
        found = np.zeros((len(signs), len(self._blocks)) if real else len(signs))
        for held, inverse, gx, s in folds:
            t = cx[~held].sum(axis=0) @ inverse  # (m, p)
            d = cc[~held].sum(axis=0) - t @ cx[~held].sum(axis=0).T + ridge
            coefficients = np.linalg.solve(d, (signs[:, ~held] @ ce[~held] - gx @ t.T).T).T  # (q, m)
            groups = [[b] for b in np.flatnonzero(held)] if real else [np.flatnonzero(held)]
            for group in groups:
                hcx, hcc, hxx = (one[group].sum(axis=0) for one in (cx, cc, xx))
                right = signs[:, group] @ (ce[group] - xe[group] @ t.T) - s @ (hcx - t @ hxx).T
                matrix = hcc - hcx @ t.T - t @ hcx.T + t @ hxx @ t.T
                fall = 2.0 * (coefficients * right).sum(axis=1)
                fall -= np.einsum("qi,ij,qj->q", coefficients, matrix, coefficients)
                if real:
                    found[:, group[0]] = fall
                else:
                    found += fall
        return found[0] if real else found

    def _rivals(
        self, falls: FloatArray, total: FloatArray, best: int, beyond: float, signs: FloatArray
    ) -> tuple[int, ...]:
        """Candidates that explain no less than the best, as far as the scatter over blocks can tell.

        Beside a true one the best would explain no more: `ladder` asks that too.
        """
        found = []
        for i in np.argsort(-total):
            if i == best or not total[i] > beyond:
                continue
            ahead = falls[best] - falls[i]
            if ahead.sum() <= max(beyond, float(np.quantile(signs @ ahead, 0.95))):
                found.append(int(i))
        return tuple(found)
