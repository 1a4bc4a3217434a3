"""A series of a log: one quantity of one signal on the log's clock."""

from __future__ import annotations

from dataclasses import dataclass

from amhe_cli.core.arrays import BoolArray, FloatArray, sealed, sealed_mask


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One quantity of one signal on the log's clock.

    Args:
        values: SI values, shape (T, k); quaternions are w, x, y, z. Undefined where not valid.
        valid: False inside gaps and outside the topic's recording, shape (T,).
        sampled: True on the steps nearest to a real message, shape (T,): only there is a measurement
            that counts as data; every other valid step is interpolated.
        columns: Name of each column, length k.
        derived: The topic carried no such quantity; it was differentiated from one that it did carry,
            so it is no second measurement.
    """

    values: FloatArray
    valid: BoolArray
    sampled: BoolArray
    columns: tuple[str, ...]
    derived: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", sealed(self.values))
        object.__setattr__(self, "valid", sealed_mask(self.valid))
        object.__setattr__(self, "sampled", sealed_mask(self.sampled))
