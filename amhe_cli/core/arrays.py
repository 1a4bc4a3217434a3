"""Array types, arrays that nobody can change, and arrays of other libraries."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]
#: An array of any library with numpy's functions: numpy's own, or a device's (CuPy, JAX).
AnyArray: TypeAlias = Any


def namespace_of(array: AnyArray) -> Any:
    """The module whose functions compute with this array, where it lies: numpy, or that of a device."""
    if hasattr(array, "__array_namespace__") and not isinstance(array, np.ndarray):
        return array.__array_namespace__()
    home = type(array).__module__.partition(".")[0]
    return sys.modules["cupy"] if home == "cupy" else np  # CuPy's arrays do not name their namespace


def side_by_side(arrays: Sequence[AnyArray]) -> list[AnyArray]:
    """The arrays on the host, or all on the device where one of them lies."""
    away = [array for array in arrays if not isinstance(array, np.ndarray)]
    return [namespace_of(away[0]).asarray(array) for array in arrays] if away else list(arrays)


def to_host(array: AnyArray) -> FloatArray:
    """The same numbers as a numpy array; a numpy array is returned as it is, without a copy."""
    return array.get() if hasattr(array, "get") else np.asarray(array)  # CuPy refuses np.asarray


def columns(shape: tuple[int, ...], *parts: ArrayLike) -> FloatArray:
    """Arrays that broadcast to a shape, side by side along a new last axis; quicker than `np.stack`."""
    whole = np.empty((*shape, len(parts)))
    for i, part in enumerate(parts):
        whole[..., i] = part
    return whole


def sealed(values: ArrayLike, kind: type[np.generic] = np.float64) -> NDArray[Any]:
    """Return `values` as a read-only array of a kind: freezing a dataclass does not freeze its arrays.

    It is a copy, unless nobody can write to the array any more: whoever hands over an array and needs no
    copy makes it read-only first.
    """
    if isinstance(values, np.ndarray) and values.dtype == kind and not _writeable(values):
        return values
    copy = np.array(values, dtype=kind)
    copy.setflags(write=False)
    return copy


def _writeable(array: Any) -> bool:
    """Whether anybody may write to an array, or to one of which it is a part."""
    while isinstance(array, np.ndarray):
        if array.flags.writeable:
            return True
        array = array.base
    return array is not None
