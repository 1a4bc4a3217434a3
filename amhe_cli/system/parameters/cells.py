"""Numbers of an MjModel that a parameter may set."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Cells:
    """Numbers of one MjModel array that take the same value, times a factor.

    Args:
        field: Name of the array.
        row: Row in the array.
        columns: Columns of that row; empty for arrays of one column, which have none.
        factor: MuJoCo stores the value times this: -1 for a servo's bias, 1/2 for either end of a gap.
    """

    field: str
    row: int
    columns: tuple[int, ...] = ()
    factor: float = 1.0

    @property
    def index(self) -> tuple[slice | int | list[int], ...]:
        """Index of these numbers in an array (n, ...) of n candidates."""
        return (slice(None), self.row, list(self.columns)) if self.columns else (slice(None), self.row)

    def of(self, model: mujoco.MjModel) -> FloatArray:
        """The model's own values, factor taken out."""
        values = getattr(model, self.field)[self.index[1:]]
        return np.atleast_1d(np.asarray(values, dtype=np.float64)) / self.factor


def range_cells(model: mujoco.MjModel, field: str, row: int) -> list[Cells]:
    """Both ends of a range about zero, or its upper end alone where it begins at zero."""
    lower = getattr(model, field)[row, 0]
    return [Cells(field, row, (1,)), *([Cells(field, row, (0,), -1.0)] if lower else [])]
