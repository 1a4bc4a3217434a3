"""Array types, and arrays that nobody can change."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]


def sealed(values: ArrayLike) -> FloatArray:
    """Return a read-only float64 copy of `values`: freezing a dataclass does not freeze its arrays."""
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def sealed_mask(values: ArrayLike) -> BoolArray:
    """Return a read-only boolean copy of `values`."""
    copy = np.array(values, dtype=np.bool_)
    copy.setflags(write=False)
    return copy
