"""Which measurements each unknown moves: unknowns that move different ones are varied in one rollout.

A regression needs a pair of rollouts for each unknown of one measurement, not for each unknown of all
(Curtis, Powell and Reid 1974, "On the estimation of sparse Jacobian matrices"). The legs of a robot whose
base is fixed move nothing of each other: four legs need the rollouts of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import AnyArray, BoolArray, FloatArray, IntArray, namespace_of, side_by_side
from amhe_cli.matching.cost import MatchingCost, Residuals


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Which columns of each channel the unknowns move.

    Args:
        z: Channel -> those that each of the d parameters moves, shape (d, k).
        first: Channel -> those that each of the nx first-state errors moves, shape (nx, k).

    A channel that the tables lack was not seen: any unknown may move all of it.
    """

    z: Mapping[str, BoolArray]
    first: Mapping[str, BoolArray]

    def residuals(self, cost: MatchingCost, first: bool) -> BoolArray:
        """Which of the R residuals of a cost the d parameters, and first-state errors, move, (d + nx, R)."""
        parts = []
        for observed in cost.clips.observed:
            rows = self._moving(observed.channel.key, observed.width, first)
            parts.append(np.tile(rows, observed.mask.shape[1]))
        return np.concatenate(parts, axis=1)

    def alone(self, row: int, cost: MatchingCost, found: Residuals, here: Sequence[AnyArray]) -> Residuals:
        """Residuals of candidates in which other parameters have moved, too, as of one of them alone.

        Args:
            row: The parameter; the others move other measurements.
            cost: The cost.
            found: Residuals of p candidates.
            here: Those of no move, one array for each channel, shape (1, c, samples, k).
        """
        columns = [self._moving(o.channel.key, o.width)[row] for o in cost.clips.observed]
        pairs = zip(found.values, here, strict=True)
        values = tuple(
            namespace_of(moved).where(namespace_of(moved).asarray(own), moved, still)
            for own, (moved, still) in zip(columns, map(side_by_side, pairs), strict=True)
        )
        return Residuals(values, found.completed)

    @property
    def alike(self) -> list[IntArray]:
        """The parameters, those together that move the same measurements."""
        return alike(np.concatenate(list(self.z.values()), axis=1))

    @property
    def first_alike(self) -> list[IntArray]:
        """The first-state errors, those together that move the same measurements."""
        return alike(np.concatenate(list(self.first.values()), axis=1))

    def unknowns(self, first: bool) -> int:
        """Unknowns that a regression counts: those that move different measurements count once."""
        parts = [self._moving(key, columns.shape[1], first) for key, columns in self.z.items()]
        return int(colours(np.concatenate(parts, axis=1)).max()) + 1

    def _moving(self, key: str, width: int, first: bool = False) -> BoolArray:
        """Which of k columns of a channel the parameters, and first-state errors, move, (d + nx, k)."""
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
    found = np.full(len(moves), -1)
    for row in np.argsort(-kinds.sum(axis=1), kind="stable"):
        taken = set(found[clash[row]])
        found[row] = next(number for number in range(len(moves)) if number not in taken)
    return found


def moved_along(moves: BoolArray, shape: FloatArray) -> BoolArray:
    """What the coordinates w of samples S w move, (u, R), from what the unknowns move and S (u, u)."""
    return np.asarray((shape != 0.0).T.astype(int) @ moves.astype(int) > 0)
