"""Which columns explain a residual, on data that were not fitted, and beyond chance?

A residual (n, k) is cut into blocks, longer than it remembers. A candidate is one or several columns. It is
fitted beside the nuisance columns on some of the blocks, and scored on the others: its share is how much of
the residual's square it takes away there. Chance is what the best of all candidates takes away where nothing
is left to explain: of the residual that is left, each block under a random sign. A block keeps what its
samples have in common, and without a cause its sign says nothing (wild bootstrap by clusters).

Where there are several causes, the candidate that explains most alone may be none of them, but have a little
of each. So the search begins with the best of several families, goes on greedily, and looks at each cause
again beside the others. Of the sets that explain alike the simplest is taken. All this is algebra on sums
over blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray

#: Random signs of the blocks, and the share of them in which any candidate may exceed chance.
SIGNS, LEVEL = 200, 0.01
#: Groups of blocks that are left out in turn.
FOLDS = 6
#: Fewest and most blocks, and their length in units of the time that a residual remembers.
BLOCKS, MEMORY = (12, 48), 2.0
#: Causes that are named at most; and the share of what is unexplained that true ones leave: the shape of
#: their columns is right to some 3 %, such as that of friction about rest.
MOST, LITTLE = 5, 0.001
#: Families with whose best the search begins, and times that it looks at all causes again.
BEGUN, TURNS = 6, 3
#: A cause explains more than so many times what is left without one, which a simulation tells roughly.
DOUBT = 2.0
#: Ridge on columns, as a share of their square: of two that are alike neither is infinite.
_TINY = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class CauseColumns:
    """One candidate.

    Args:
        dofs: Columns of the residual of whose square its share is.
        values: Its m columns, shape (m, n, k).
        numbers: How many numbers it takes: its columns, and what was tried at several values.
        most: The largest first coefficient that can be.
        least: The least size of that coefficient that says anything.
        family: What is tried at several values is one family.
    """

    dofs: tuple[int, ...]
    values: FloatArray
    numbers: int
    most: float = np.inf
    least: float = 0.0
    family: Any = None


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
        nuisance: Columns that explain too and are no causes, shape (p, n, k).
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
        self.blocks, self._scale, self.residual, self.x = list(blocks), 1.0, residual, nuisance
        self.weight, self.toward = (0.0, np.zeros(len(nuisance))) if toward is None else (memory, toward)
        for _ in range(3):  # in units of what the nuisance leaves of each column
            self._scale = np.sqrt(np.maximum((self.left**2).mean(axis=0), 1e-30))
            self.residual, self.x = residual / self._scale, nuisance / self._scale

    @property
    def left(self) -> FloatArray:
        """What the nuisance leaves of the residual, shape (n, k)."""
        return self.left_by(_Candidates(self, []), ()) * self._scale

    def left_by(self, made: _Candidates, chosen: Sequence[int]) -> FloatArray:
        """What some candidates leave of the residual, in units of what the nuisance leaves, shape (n, k)."""
        x = np.concatenate([self.x, *(made.values[i] for i in chosen)])
        return self.residual - np.tensordot(made.beside(chosen).fitted[0], x, 1)

    def ladder(
        self,
        candidates: Sequence[CauseColumns],
        rng: np.random.Generator,
        error: Callable[[], FloatArray] | None = None,
    ) -> tuple[list[Explained], float, FloatArray, FloatArray]:
        """Candidates that explain more than chance; that first without which the others leave most.

        Args:
            rng: Generator of the signs of blocks.
            error: Mean square of the residual that has no cause, shape (k,), once it is asked for.

        Returns:
            They; the share that chance explains once they are known; what they leave, shape (n, k); and the
            coefficients of the nuisance beside them, shape (p,).
        """

        def wrong() -> FloatArray:
            squares = np.zeros(self.residual.shape[1]) if error is None else error()
            return squares / self._scale**2 * len(self.residual)

        values = [candidate.values / self._scale for candidate in candidates]
        signs = rng.choice([-1.0, 1.0], (SIGNS, len(self.blocks)))
        search = _Search(_Candidates(self, values), candidates, signs, wrong)
        chosen = search.found() if candidates else []
        coefficients, sd = search.made.beside(chosen).fitted
        own = search.own
        found, at = [], len(self.x)
        for i, index in enumerate(chosen):
            columns = slice(at, at := at + len(values[index]))
            share = float(search.falls(chosen[:i])[index].sum() / own[index])
            rivals = search.rivals(index, [one for one in chosen if one != index])
            found.append(Explained(index, share, coefficients[columns], sd[columns], rivals))
        best, beyond = search.next(chosen)[:2] if candidates else (0, 0.0)
        chance = beyond / own[best] if candidates else 0.0
        left = self.left_by(search.made, chosen) * self._scale
        return found, chance, left, coefficients[: len(self.x)]


@dataclass(frozen=True, eq=False)
class _Beside:
    """Columns beside which candidates are tried: q of them, and M of the candidates.

    Args:
        xx, xe, cx: Their products with each other, with the residual, and with the columns of candidates,
            summed over each block, shape (blocks, q, q), (blocks, q), (blocks, M, q).
        precision, pull: The prior's precision, and its pull, shape (q,).
    """

    xx: FloatArray
    xe: FloatArray
    cx: FloatArray
    precision: FloatArray
    pull: FloatArray

    @cached_property
    def fitted(self) -> tuple[FloatArray, FloatArray]:
        """Coefficients of all columns (q,), and their sd by the scatter over blocks."""
        if not self.pull.size:
            return self.pull, self.pull
        inverse = np.linalg.inv(self.xx.sum(axis=0) + np.diag(self.precision))
        found = inverse @ (self.xe.sum(axis=0) + self.pull)
        scores = self.xe - self.xx @ found
        return found, np.sqrt(np.abs(np.diag(inverse @ (scores.T @ scores) @ inverse)))

    def losses(self, folds: Sequence[BoolArray]) -> FloatArray:
        """Squares of blocks that were not fitted, but for the residual's own, shape (blocks,)."""
        found = np.empty(len(self.xe))
        for held in folds:
            matrix = self.xx[~held].sum(axis=0) + np.diag(self.precision)
            fit = np.linalg.solve(matrix, self.xe[~held].sum(axis=0) + self.pull)
            found[held] = (self.xx[held] @ fit - 2.0 * self.xe[held]) @ fit
        return found


class _Candidates:
    """Columns of candidates (each (m, n, k)) as sums of products over blocks, beside a regression's own."""

    def __init__(self, of: Regression, values: Sequence[FloatArray]) -> None:
        n = len(of.blocks)
        self.of, self.values = of, values
        self.folds = [np.arange(n) % FOLDS == f for f in range(min(FOLDS, n))]
        self._all = np.concatenate([np.empty((0, *of.residual.shape)), *values])
        ends = np.cumsum([0, *map(len, values)])
        self.columns = [np.arange(a, b) for a, b in pairwise(ends)]
        of_size: dict[int, list[int]] = {}
        for i, one in enumerate(values):
            of_size.setdefault(len(one), []).append(i)
        self.alike = [np.array(some) for some in of_size.values()]  # of as many columns
        self.ce = self._sums(self._all, of.residual[None])[..., 0]
        self._cx = {-1: self._sums(self._all, of.x)}
        self._xx = self._sums(of.x, of.x)
        self._xe = self._sums(of.x, of.residual[None])[..., 0]

    def _sums(self, one: FloatArray, other: FloatArray) -> FloatArray:
        """Sums of products over each block, shape (blocks, a, b), of (a, n, k) and (b, n, k)."""
        a, b = (of.transpose(1, 0, 2) for of in (one, other))
        return np.stack([np.tensordot(a[rows], b[rows], ((0, 2), (0, 2))) for rows in self.of.blocks])

    @cached_property
    def own(self) -> list[FloatArray]:
        """Products of each candidate's columns, (blocks, N, m, m), for those of as many columns."""
        found = []
        for some in self.alike:
            each = np.stack([self.values[i] for i in some])
            sums = [np.einsum("nark,nbrk->nab", each[:, :, r], each[:, :, r]) for r in self.of.blocks]
            found.append(np.stack(sums))
        return found

    def beside(self, chosen: Sequence[int]) -> _Beside:
        """The regression's own columns and those of some candidates."""
        for i in chosen:
            if i not in self._cx:
                self._cx[i] = self._sums(self._all, self.values[i])
        cx = np.concatenate([self._cx[i] for i in (-1, *chosen)], axis=2)
        rows = np.concatenate([np.empty(0, dtype=int), *(self.columns[i] for i in chosen)])
        more = cx[:, rows]  # (blocks, s, q)
        p = len(self.of.x)
        xx = np.concatenate((np.concatenate((self._xx, more[:, :, :p].swapaxes(1, 2)), axis=2), more), axis=1)
        xe = np.concatenate((self._xe, self.ce[:, rows]), axis=1)
        precision, pull = _TINY * np.maximum(np.einsum("bii->i", xx), 1e-30), np.zeros(xe.shape[1])
        precision[:p] += self.of.weight
        pull[:p] = self.of.weight * self.of.toward
        return _Beside(xx, xe, cx, precision, pull)

    def falls(
        self,
        x: _Beside,
        signs: FloatArray | None = None,
        left: tuple[FloatArray, FloatArray] | None = None,
        only: int | None = None,
    ) -> FloatArray:
        """By how much candidates beside x lower the squares of blocks that were not fitted.

        Args:
            x: What they stand beside.
            signs: Signs of the blocks, shape (s, blocks); None: as they are.
            left: Products of another residual with all candidates, (blocks, M), and with x, (blocks, q).
            only: The candidate that is requested; 0 of all others.

        Returns:
            Shape (candidates, blocks); with signs (candidates, s), summed over the blocks.
        """
        blocks, real = len(x.xe), signs is None
        ce, xe = left or (self.ce, x.xe)
        signs = np.ones((1, blocks)) if signs is None else signs
        pull = x.pull * real
        inverses = [np.linalg.inv(x.xx[~held].sum(axis=0) + np.diag(x.precision)) for held in self.folds]
        found = np.zeros((len(self.values), blocks if real else len(signs)))
        groups = list(zip(self.alike, self.own, strict=True))
        if only is not None:
            groups = [(some[some == only], own[:, some == only]) for some, own in groups if only in some]
        for some, own in groups:
            columns = np.array([self.columns[i] for i in some])  # (N, m)
            cx, c = x.cx[:, columns], ce[:, columns]  # (blocks, N, m, q), (blocks, N, m)
            squares = np.maximum(np.einsum("bnii->n", own), 1e-30)
            ridge = _TINY * squares[:, None, None] * np.eye(columns.shape[1])
            for held, inverse in zip(self.folds, inverses, strict=True):
                fit = cx[~held].sum(axis=0)
                t = fit @ inverse  # (N, m, q)
                d = own[~held].sum(axis=0) - t @ fit.swapaxes(1, 2) + ridge
                beside = c - np.einsum("bq,nmq->bnm", xe, t)
                right = np.tensordot(signs[:, ~held], beside[~held], 1) - t @ pull  # (s, N, m)
                coefficients = np.linalg.solve(d, np.moveaxis(right, 0, 2))  # (N, m, s)
                parts = np.eye(blocks)[held] if real else held[None].astype(float)  # (p, blocks)
                pcx, pxx, pcc = (np.tensordot(parts, one, 1) for one in (cx, x.xx, own))
                turned = t @ pxx[:, None]  # (p, N, m, q)
                both = (signs[:, None] * parts).reshape(-1, blocks) @ beside.reshape(blocks, -1)
                right = np.moveaxis(both.reshape(len(signs), len(parts), *columns.shape), 0, 3)
                s = (signs[:, ~held] @ xe[~held] + pull) @ inverse
                right -= (pcx - turned) @ s.T  # (p, N, m, s)
                cross = pcx @ t.swapaxes(1, 2)
                matrix = pcc - cross - cross.swapaxes(2, 3) + turned @ t.swapaxes(1, 2)
                fall = ((2.0 * right - matrix @ coefficients) * coefficients).sum(axis=2)  # (p, N, s)
                place = np.ix_(some, np.flatnonzero(held)) if real else some
                found[place] += fall[..., 0].T if real else fall[0]
        return found


class _Search:
    """Which sets of candidates explain more than chance.

    Args:
        made: The candidates as sums.
        signs: Random signs of the blocks, shape (s, blocks).
        wrong: What each column of the residual has without a cause, summed over the rows, once asked for.
    """

    def __init__(
        self,
        made: _Candidates,
        candidates: Sequence[CauseColumns],
        signs: FloatArray,
        wrong: Callable[[], FloatArray],
    ) -> None:
        self.made, self._candidates, self._signs, self._asked = made, candidates, signs, wrong
        self._falls = cache(lambda some: made.falls(made.beside(some)))
        self._best = cache(self._next)

    @cached_property
    def _least(self) -> FloatArray:
        """What each takes away at least: more than columns leave, and more than there is without a cause."""
        return np.maximum(LITTLE * self.own, DOUBT * self._of_each(self._asked()))

    @cached_property
    def own(self) -> FloatArray:
        """Squares that the nuisance leaves where each candidate acts, shape (candidates,)."""
        return self._of_each((self.made.of.left_by(self.made, ()) ** 2).sum(axis=0))

    def _of_each(self, squares: FloatArray) -> FloatArray:
        """Sum of the squares (k,) where each candidate acts."""
        return np.array([squares[list(one.dofs)].sum() for one in self._candidates])

    def falls(self, chosen: Sequence[int]) -> FloatArray:
        """By how much candidates beside some lower the squares of each block, shape (candidates, blocks)."""
        return self._falls(tuple(sorted(chosen)))

    def chance(self, chosen: Sequence[int], index: int, only: int | None = None) -> FloatArray:
        """What candidates take away of what some and one more leave, under random signs, (candidates, s)."""
        x, both = self.made.beside(chosen), self.made.beside([*chosen, index])
        fit, q = both.fitted[0], x.xe.shape[1]
        left = self.made.ce - both.cx @ fit, x.xe - both.xx[:, :q] @ fit
        return self.made.falls(x, self._signs, left, only)

    def found(self) -> list[int]:
        """The simplest of the sets that explain as much as the best, what the others need most first."""
        sets = {tuple(sorted(self._grown([first]))) for first in self._firsts()}
        sets = {tuple(sorted(self._needed(list(one)))) for one in sets}
        little = LITTLE * (self.made.of.left_by(self.made, ()) ** 2).sum()
        if not sets:
            return []
        losses = {one: self.made.beside(one).losses(self.made.folds) for one in sets}
        best = min(sets, key=lambda one: losses[one].sum())

        def alike(one: tuple[int, ...]) -> bool:
            more = losses[one] - losses[best]
            return bool(more.sum() <= max(little, np.quantile(self._signs @ more, 0.95)))

        same = [one for one in sets if alike(one)]
        simplest = min(
            same, key=lambda one: (sum(self._candidates[i].numbers for i in one), losses[one].sum())
        )
        without = {i: self.falls([one for one in simplest if one != i])[i].sum() for i in simplest}
        return sorted(simplest, key=lambda i: -without[i])

    def _firsts(self) -> list[int]:
        """The best candidates of some families, where any explains more than chance."""
        best, beyond, alike = self.next([])
        if not alike:
            return []
        total, families = self.falls([]).sum(axis=1), dict[Any, int]()
        for i in map(int, (alike[0], best, *np.argsort(-total))):
            if total[i] > beyond and self._possible([], i):
                families.setdefault(self._candidates[i].family or i, i)
        return list(families.values())[:BEGUN]

    def _grown(self, chosen: list[int]) -> list[int]:
        """More candidates beside some, as long as they explain more than chance."""
        while len(chosen) < MOST and (alike := self.next(chosen)[2]):
            chosen = self._again([*chosen, alike[0]])
        return chosen

    def _again(self, chosen: list[int]) -> list[int]:
        """Each of some replaced by what explains more beside the others, or as much and is simpler."""
        for _ in range(TURNS):
            before = list(chosen)
            for place in range(len(chosen)):
                rest = [i for at, i in enumerate(chosen) if at != place]
                if alike := self.next(rest)[2]:
                    chosen[place] = alike[0]
            if chosen == before:
                break
        return chosen

    def next(self, chosen: Sequence[int]) -> tuple[int, float, list[int]]:
        """The best candidate beside some, what chance takes away, and those that explain alike.

        The simplest of these is first; there are none where the best explains no more than chance.
        """
        return self._best(tuple(sorted(chosen)))

    def _next(self, chosen: tuple[int, ...]) -> tuple[int, float, list[int]]:
        falls = self.falls(chosen)
        total = falls.sum(axis=1)
        total[list(chosen)] = -np.inf
        best = next((int(i) for i in np.argsort(-total) if self._possible(chosen, int(i))), -1)
        if best < 0:
            return 0, 0.0, []
        beyond = float(np.quantile(self.chance(chosen, best).max(axis=0), 1.0 - LEVEL))
        if not total[best] > beyond or not total[best] > self._least[best]:
            return best, beyond, []
        alike = [best]
        for i in map(int, np.argsort(-total)):
            if i == best or not total[i] > beyond:
                continue
            ahead = falls[best] - falls[i]
            if (
                ahead.sum() <= max(beyond, LITTLE * self.own[best], np.quantile(self._signs @ ahead, 0.95))
                and self._possible(chosen, i)
                and self._more(best, [*chosen, i]) <= 0.0
            ):
                alike.append(i)
        return best, beyond, sorted(alike, key=lambda i: (self._candidates[i].numbers, -total[i]))

    def rivals(self, index: int, rest: Sequence[int]) -> tuple[int, ...]:
        """Candidates that explain as much as one, as far as the scatter over blocks can tell."""
        return tuple(i for i in self.next(rest)[2] if i != index)

    def _possible(self, chosen: Sequence[int], index: int) -> bool:
        """Whether the first coefficient of a candidate may be one that can be, as far as its sd tells."""
        one = self._candidates[index]
        if one.most == np.inf and not one.least:
            return True
        values, sd = self.made.beside([*chosen, index]).fitted
        at = len(values) - len(one.values)
        return bool(values[at] - 2.0 * sd[at] <= one.most and abs(values[at]) >= one.least)

    def _needed(self, chosen: list[int]) -> list[int]:
        """Those that can be, and explain more than chance, beside all others."""
        while chosen:
            rest = [[i for i in chosen if i != one] for one in chosen]
            more = [
                self._more(one, beside) if self._possible(beside, one) else -np.inf
                for one, beside in zip(chosen, rest, strict=True)
            ]
            if min(more) > 0.0:
                break
            del chosen[int(np.argmin(more))]
        return chosen

    def _more(self, index: int, rest: Sequence[int]) -> float:
        """By how much a candidate explains more beside others than chance and the method's own error."""
        chance = np.quantile(self.chance(rest, index, only=index)[index], 1.0 - LEVEL)
        return float(self.falls(rest)[index].sum() - max(chance, self._least[index]))
