"""Where each field of a message lies in its bytes.

Messages of a topic mostly share one layout: the same names, the same array lengths. So one message is
walked in Python, field by field. Every other message with the same length and the same bytes for array
lengths has all fields at the same places, and whole batches are then read as strided numpy views.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from amhe_cli.core.arrays import BoolArray, IntArray

#: Type -> its fields in order: (name, rosbags' description of the field's type).
Types: TypeAlias = Mapping[str, Any]

#: Strings whose content matters; of all others only the length is part of a layout.
KEPT = {"name", "mark", "joint_names", "frame_id", "child_frame_id"}

#: Fields of a message: in any case, for each of its bytes, and at most; and how deep they may nest.
_FEW_FIELDS, _FIELDS_A_BYTE, _MOST_FIELDS, _DEEPEST = 1000, 2, 1_000_000, 50
#: Messages that a library parses nest no deeper.
DEEPEST = 30
#: Such a message holds no more numbers and messages in it.
MOST_VALUES = 100_000
#: Bytes of a name.
LONGEST_NAME = 10_000

#: ROS 2 gives an empty structure one byte under this name; ROS 1 gives it none.
_FILLER = "structure_needs_at_least_one_member"

_DTYPES: Mapping[str, str] = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1",
    "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


class MalformedMessageError(ValueError):
    """The bytes of a message contradict its definition."""


@dataclass(frozen=True, slots=True)
class Leaf:
    """A number, or an array of numbers, at a fixed place of the message."""

    offset: int
    dtype: np.dtype
    count: int | None

    def column(self, index: int) -> Leaf:
        """Element `index` of an array."""
        return Leaf(self.offset + index * self.dtype.itemsize, self.dtype, None)

    def read(self, rows: NDArray[np.uint8]) -> NDArray:
        """The number of every message (n, length), shape (n,), as a strided view."""
        return np.ndarray(len(rows), self.dtype, rows, self.offset, (rows.strides[0],))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The layout that a group of messages shares.

    Args:
        leaves: Path such as 'pose.position.x' or 'motor[3].q' -> where it lies; arrays of numbers are one.
        counts: Path of an array of structures or strings -> number of its elements.
        strings: Path -> content; only names and frames.
        places, expected: Bytes that make a message have this layout, shape (m,).
        fields: Fields that had to be looked at to find it.
    """

    leaves: Mapping[str, Leaf]
    counts: Mapping[str, int]
    strings: Mapping[str, str]
    places: IntArray
    expected: NDArray[np.uint8]
    fields: int = 0

    def matches(self, rows: NDArray[np.uint8]) -> BoolArray:
        """Which of the messages (n, length) have this layout, given that the length is the same."""
        return (rows[:, self.places] == self.expected).all(axis=1)

    def names(self, path: str) -> tuple[str, ...]:
        """Content of an array of strings, for instance 'name' of a JointState."""
        return tuple(self.strings[f"{path}[{i}]"] for i in range(self.counts.get(path, 0)))

    def columns(self, path: str) -> list[Leaf]:
        """The numbers that `path` names: one, all of an array, or one element of it; empty if none."""
        leaf = self.leaves.get(path)
        if leaf is not None:
            return [leaf] if leaf.count is None else [leaf.column(i) for i in range(leaf.count)]
        stem, bracket, index = path.rpartition("[")
        array = self.leaves.get(stem)
        if not bracket or array is None or array.count is None or not index[:-1].isdecimal():
            return []
        return [array.column(int(index[:-1]))] if int(index[:-1]) < array.count else []


def table_layout(definition: str) -> tuple[Layout, int]:
    """Layout of a table's rows, and the bytes of one row.

    Args:
        definition: JSON list of [name, count]: one float64 where count is null, else an array of so many.
    """
    leaves: dict[str, Leaf] = {}
    offset = 0
    for name, count in json.loads(definition):
        leaves[name] = Leaf(offset, np.dtype("<f8"), count)
        offset += 8 * (count or 1)
    nothing = np.empty(0, dtype=np.int64)
    return Layout(leaves, {}, {}, nothing, nothing.astype(np.uint8)), offset


def walk(message: NDArray[np.uint8], type_name: str, types: Types, encoding: str) -> Layout:
    """Find the layout of one message.

    Raises:
        MalformedMessageError: If the bytes cannot be a message of that type.
    """
    walker = _Walker(message.tobytes(), types, encoding)
    walker.structure("", type_name)
    walker.finish()
    places = np.array(sorted(walker.fixed), dtype=np.int64)
    return Layout(
        walker.leaves, walker.counts, walker.strings, places, message[places], fields=walker.visited
    )


def most_fields(size: int) -> int:
    """Fields that a message of so many bytes may have; definitions can multiply them without using a byte."""
    return min(_MOST_FIELDS, _FEW_FIELDS + _FIELDS_A_BYTE * size)


class _Walker:
    def __init__(self, data: bytes, types: Types, encoding: str) -> None:
        self._data = data
        self._types = types
        self._cdr = encoding == "cdr"
        self._pos = self._origin = 0
        self._order = "<"
        self.visited = 0
        self._most = most_fields(len(data))
        self.leaves: dict[str, Leaf] = {}
        self.counts: dict[str, int] = {}
        self.strings: dict[str, str] = {}
        self.fixed: set[int] = set()
        if self._cdr:
            self._encapsulation()

    def structure(self, path: str, type_name: str) -> None:
        """Walk all fields of a structure."""
        if type_name not in self._types:
            raise MalformedMessageError(f"type {type_name} is not defined")
        fields = self._types[type_name]
        if self._cdr and not fields:
            self._skip(1, 1)
        for name, description in fields:
            if self._cdr or name != _FILLER:
                self._field(f"{path}.{name}" if path else name, description)

    def finish(self) -> None:
        """Check that nothing but CDR's padding is left over."""
        left = len(self._data) - self._pos
        if left > (3 if self._cdr else 0):
            raise MalformedMessageError(f"{left} bytes too many")

    def _encapsulation(self) -> None:
        if len(self._data) < 4 or self._data[0] != 0 or self._data[1] > 1:
            raise MalformedMessageError(f"CDR encapsulation {self._data[:2].hex()} is not supported")
        self._order = "<" if self._data[1] else ">"
        self.fixed |= {0, 1}
        self._pos = self._origin = 4

    def _field(self, path: str, description: tuple) -> None:
        # Definitions come from the log: they may nest without end, or multiply without using a byte.
        self.visited += 1
        if self.visited > self._most or path.count(".") > _DEEPEST:
            raise MalformedMessageError("its definition has no end")
        kind, detail = description
        if kind == Nodetype.BASE:
            self._base(path, detail[0])
        elif kind == Nodetype.NAME:
            self.structure(path, detail)
        else:
            element, size = detail
            count = size if kind == Nodetype.ARRAY else self._length()
            self._array(path, element, count)

    def _base(self, path: str, base: str) -> None:
        if base == "string":
            self._string(path)
        else:
            dtype = self._dtype(base)
            self.leaves[path] = Leaf(self._skip(dtype.itemsize, dtype.itemsize), dtype, None)

    def _array(self, path: str, element: tuple, count: int) -> None:
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            dtype = self._dtype(element[1][0])
            # An empty CDR sequence has no padding after its length.
            start = self._skip(dtype.itemsize, count * dtype.itemsize) if count else self._pos
            self.leaves[path] = Leaf(start, dtype, count)
            return
        if count > len(self._data):
            raise MalformedMessageError(f"{path} claims {count} elements")
        self.counts[path] = count
        for i in range(count):
            self._field(f"{path}[{i}]", element)

    def _string(self, path: str) -> None:
        length = self._length()
        start = self._skip(1, length)
        if path.split(".")[-1].split("[")[0] in KEPT:
            if length > LONGEST_NAME:
                raise MalformedMessageError(f"{path} has {length} bytes")
            self.fixed |= set(range(start, start + length))
            text = self._data[start : start + length]
            self.strings[path] = (text[:-1] if self._cdr else text).decode("utf-8", "replace")

    def _length(self) -> int:
        start = self._skip(4, 4)
        self.fixed |= set(range(start, start + 4))
        return struct.unpack_from(f"{self._order}I", self._data, start)[0]

    def _dtype(self, base: str) -> np.dtype:
        if base not in _DTYPES:
            raise MalformedMessageError(f"fields of type {base} are not supported")
        return np.dtype(self._order + _DTYPES[base])

    def _skip(self, alignment: int, size: int) -> int:
        """Step over `size` bytes, aligned as CDR wants it; return where they start."""
        if self._cdr:
            self._pos += -(self._pos - self._origin) % alignment
        start = self._pos
        self._pos += size
        if self._pos > len(self._data):
            raise MalformedMessageError(f"{self._pos - len(self._data)} bytes too few")
        return start
