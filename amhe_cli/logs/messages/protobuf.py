"""Where each number of a protobuf message lies in its bytes.

As for ROS messages, one message is walked in Python. Every other message of its length with the same tags,
lengths and widths of varints has all its numbers at the same places. A number that a message leaves out is 0,
as proto3 has it; one in a message that is left out itself is unknown, thus NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amhe_cli.logs.messages.descriptors import (
    BYTES,
    VARINT,
    Field,
    MalformedMessageError,
    ProtobufTypes,
    span_of,
    varint,
)
from amhe_cli.logs.messages.layout import KEPT, Layout, Leaf

_Bytes = NDArray[np.uint8]
_DEEPEST, _MOST_FIELDS = 30, 20_000
#: A packed list of more varints is no state of a robot; it is left out.
_MOST_VARINTS = 1000
_F8 = np.dtype("<f8")
_STAMPS = ("stamp", "timestamp")


@dataclass(frozen=True, slots=True)
class _Varint(Leaf):
    """A number of `width` bytes with seven bits in each."""

    width: int
    zigzag: bool

    def read(self, rows: _Bytes) -> NDArray:
        value = np.zeros(len(rows), dtype=np.uint64)
        for i in range(self.width):
            value |= (rows[:, self.offset + i] & np.uint8(0x7F)).astype(np.uint64) << np.uint64(7 * i)
        if self.zigzag:
            value = (value >> np.uint64(1)) ^ (~(value & np.uint64(1)) + np.uint64(1))
        return value.view(np.int64).astype(self.dtype)


@dataclass(frozen=True, slots=True)
class _Constant(Leaf):
    """A number that the messages leave out."""

    value: float

    def read(self, rows: _Bytes) -> NDArray:
        return np.full(len(rows), self.value)


@dataclass(frozen=True, slots=True)
class _Several(Leaf):
    """An array of numbers from several places."""

    parts: tuple[Leaf, ...]

    def column(self, index: int) -> Leaf:
        return self.parts[index]


@dataclass(frozen=True, slots=True)
class _TimePart(Leaf):
    """Seconds, or the nanoseconds beyond them, of a time that is one number.

    Its size gives the unit: seconds, or milli-, micro- or nanoseconds since 1970.
    """

    whole: Leaf
    seconds: bool

    def read(self, rows: _Bytes) -> NDArray:
        time = self.whole.read(rows)
        if time.dtype.kind == "f":
            time = np.where(np.abs(time) < 2.0**62, time, 0.0)
        else:
            time = time.astype(np.int64)
        size = np.abs(time.astype(np.float64))
        unit = np.select([size > 1e17, size > 1e14, size > 1e11], [10**9, 10**6, 10**3], 1)
        seconds, rest = np.divmod(time, unit.astype(time.dtype))
        return (seconds if self.seconds else np.round(rest * (10**9 // unit))).astype(np.int64)


def walk(message: _Bytes, type_name: str, types: ProtobufTypes) -> Layout:
    """Find the layout of one message.

    Raises:
        MalformedMessageError: If the bytes cannot be a message of that type.
    """
    walker = _Walker(message.tobytes(), types)
    walker.structure("", type_name, 0, len(message), 0)
    walker.finish()
    places = np.array(sorted(walker.fixed), dtype=np.int64)
    mask = np.array([walker.fixed[place] for place in places.tolist()], dtype=np.uint8)
    found = walker.leaves, walker.counts, walker.strings
    return Layout(*found, places, message[places] & mask, mask, walker.visited)


class _Walker:
    def __init__(self, data: bytes, types: ProtobufTypes) -> None:
        self._data, self._types = data, types
        self._lists: dict[str, list[Leaf]] = {}
        self.visited = 0
        self.leaves: dict[str, Leaf] = {}
        self.counts: dict[str, int] = {}
        self.strings: dict[str, str] = {}
        #: Place of a byte -> its bits that all messages of the layout share.
        self.fixed: dict[int, int] = {}

    def structure(self, path: str, type_name: str, position: int, end: int, depth: int) -> None:
        """Walk the fields of one message."""
        if type_name not in self._types:
            raise MalformedMessageError(f"type {type_name} is not defined")
        if depth > _DEEPEST:
            raise MalformedMessageError("it nests too deep")
        fields, data = self._types[type_name], self._data
        prefix = f"{path}." if path else ""
        present: set[int] = set()
        while position < end:
            tag, after = varint(data, position, end)
            self._fix(position, after)
            number, wire = tag >> 3, tag & 7
            if number == 0:
                raise MalformedMessageError("a field in it has the number 0")
            start, stop = span_of(data, wire, after, end)
            if wire == BYTES:
                self._fix(after, start)
            elif wire == VARINT:
                self._fix(start, stop, 0x80)
            field = fields.get(number)
            if field is not None and self._value(prefix, field, wire, start, stop, depth):
                present.add(number)
            position = stop
        for number, field in fields.items():
            if number not in present:
                self._absent(prefix, field, field.absent, (type_name,))

    def finish(self) -> None:
        """Join the lists of numbers, and bring joints to the form of a JointState."""
        for path, leaves in self._lists.items():
            only = leaves[0] if len(leaves) == 1 and leaves[0].count is not None else None
            parts = tuple(
                leaf if leaf.count is None else leaf.column(i)
                for leaf in leaves
                for i in range(leaf.count or 1)
                if leaf.count != 0
            )
            self.leaves[path] = only or _Several(0, _F8, len(parts), parts)
        joints = [f"joints[{i}]." for i in range(self.counts.get("joints", 0))]
        if not joints or not all(f"{joint}name" in self.strings for joint in joints):
            return
        for quantity in ("position", "velocity", "effort"):
            leaves = [self.leaves.get(joint + quantity) for joint in joints]
            parts = tuple(leaf for leaf in leaves if leaf is not None and leaf.count is None)
            if len(parts) == len(joints) and not all(_unknown(leaf) for leaf in parts):
                self.leaves[quantity] = _Several(0, _F8, len(parts), parts)
        self.counts["name"] = len(joints)
        self.strings |= {f"name[{i}]": self.strings[f"{joint}name"] for i, joint in enumerate(joints)}

    def _value(self, prefix: str, field: Field, wire: int, start: int, stop: int, depth: int) -> bool:
        """Note one value; False where its bytes are not of the field's kind, which makes them unknown."""
        self._count()
        packed = field.repeated and wire == BYTES and field.wire != BYTES
        if wire != field.wire and not packed:
            return False
        path = prefix + field.name
        if field.dtype is not None:
            if packed:
                self._packed(path, field, start, stop)
            elif field.repeated:
                self._lists.setdefault(path, []).append(_leaf(field, start, stop))
            else:
                self._number(prefix, field, _leaf(field, start, stop))
            return True
        if field.repeated and (field.message or field.text):
            index = self.counts.get(path, 0)
            self.counts[path] = index + 1
            path = f"{path}[{index}]"
        if field.message:
            name = "stamp" if field.name == "timestamp" and not field.repeated else ""
            self.structure(prefix + name if name else path, field.message, start, stop, depth + 1)
        elif field.text and field.name in KEPT:
            self._fix(start, stop)
            self.strings[path] = self._data[start:stop].decode("utf-8", "replace")
        return True

    def _number(self, prefix: str, field: Field, leaf: Leaf) -> None:
        self.leaves[prefix + field.name] = leaf
        if field.name in _STAMPS:
            for part, seconds in (("sec", True), ("nanosec", False)):
                self.leaves[f"{prefix}stamp.{part}"] = _TimePart(0, np.dtype("<i8"), None, leaf, seconds)

    def _packed(self, path: str, field: Field, start: int, stop: int) -> None:
        leaves = self._lists.setdefault(path, [])
        assert field.dtype is not None
        if field.wire != VARINT:
            count, rest = divmod(stop - start, field.dtype.itemsize)
            if rest:
                raise MalformedMessageError(f"{path} ends within a number")
            leaves.append(Leaf(start, field.dtype, count))
            return
        if sum(byte < 0x80 for byte in self._data[start : min(stop, start + 10_000)]) > _MOST_VARINTS:
            return
        self._fix(start, stop, 0x80)
        while start < stop:
            _, after = varint(self._data, start, stop)
            leaves.append(_leaf(field, start, after))
            start = after

    def _absent(self, prefix: str, field: Field, value: float, within: Sequence[str]) -> None:
        """Note a field that the message leaves out, and all that it would hold."""
        self._count()
        path = prefix + field.name
        if field.repeated:
            if field.dtype is not None:
                self._lists.setdefault(path, [])
            else:
                self.counts.setdefault(path, 0)
        elif field.dtype is not None:
            if path not in self.leaves:
                self._number(prefix, field, _Constant(0, _F8, None, value))
        elif field.text and field.name in KEPT:
            self.strings.setdefault(path, "")
        elif field.message and field.message not in within and len(within) < _DEEPEST:
            inner = f"{prefix}stamp." if field.name == "timestamp" else f"{path}."
            for part in self._types.get(field.message, {}).values():
                unset = 0.0 if part.name in ("sec", "nanosec") else float("nan")
                self._absent(inner, part, unset, (*within, field.message))

    def _fix(self, start: int, stop: int, bits: int = 0xFF) -> None:
        for place in range(start, stop):
            self.fixed[place] = bits

    def _count(self) -> None:
        self.visited += 1
        if self.visited > _MOST_FIELDS:
            raise MalformedMessageError("it has too many fields")


def _leaf(field: Field, start: int, stop: int) -> Leaf:
    assert field.dtype is not None
    if field.wire == VARINT:
        return _Varint(start, field.dtype, None, stop - start, field.zigzag)
    return Leaf(start, field.dtype, None)


def _unknown(leaf: Leaf) -> bool:
    return isinstance(leaf, _Constant) and bool(np.isnan(leaf.value))
