"""Message types of a protobuf FileDescriptorSet, and the wire format that it shares with all messages.

The set is read as data: no code is generated, and nothing in it is run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np

#: MCAP's name of the encoding.
ENCODING = "protobuf"

#: Kinds of bytes on the wire.
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
#: A field's declared type that is a number -> kind on the wire, and dtype of its value.
_NUMBERS: Mapping[int, tuple[int, str]] = {
    1: (FIXED64, "<f8"), 2: (FIXED32, "<f4"), 3: (VARINT, "<i8"), 4: (VARINT, "<u8"), 5: (VARINT, "<i4"),
    6: (FIXED64, "<u8"), 7: (FIXED32, "<u4"), 8: (VARINT, "?"), 13: (VARINT, "<u4"), 14: (VARINT, "<i4"),
    15: (FIXED32, "<i4"), 16: (FIXED64, "<i8"), 17: (VARINT, "<i4"), 18: (VARINT, "<i8"),
}  # fmt: skip
_STRING, _MESSAGE, _ZIGZAG = 9, 11, (17, 18)
_REPEATED = 3
#: Names of the parts of a time -> those of ROS 2.
TIMES = {"nsec": "nanosec", "nsecs": "nanosec", "nanos": "nanosec", "secs": "sec", "seconds": "sec"}
_TIME_PARTS = {*TIMES, "sec", "nanosec"}
_DEEPEST, _MOST_FIELDS = 30, 100_000


class MalformedMessageError(ValueError):
    """The bytes of a message contradict its definition."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message type.

    Args:
        name: Name of the field; those of times are ROS 2's.
        wire: Kind of its bytes: VARINT, FIXED64, BYTES or FIXED32.
        dtype: Dtype of a number; None for anything else.
        zigzag: Whether its varint is zigzag encoded.
        message: Type of the message that it holds; '' for anything else.
        text: Whether it is a string.
        repeated: Whether it is a list.
        absent: Value of the field where a message lacks it; NaN where that means that it is unknown.
    """

    name: str
    wire: int
    dtype: np.dtype | None
    zigzag: bool
    message: str
    text: bool
    repeated: bool
    absent: float


#: Type -> number -> field.
ProtobufTypes: TypeAlias = Mapping[str, Mapping[int, Field]]


def varint(data: bytes, position: int, end: int) -> tuple[int, int]:
    """Value of a varint, and the place after it.

    Raises:
        MalformedMessageError: It does not end before `end`, or is too long.
    """
    value = shift = 0
    while position < end and shift < 70:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, position
    raise MalformedMessageError("a varint in it has no end")


def span_of(data: bytes, wire: int, position: int, end: int) -> tuple[int, int]:
    """Where the content of a value starts and ends, its own length left out.

    Raises:
        MalformedMessageError: It ends behind `end`, or is of a kind that is not supported.
    """
    if wire == VARINT:
        return position, varint(data, position, end)[1]
    if wire == BYTES:
        length, position = varint(data, position, end)
    elif wire in (FIXED32, FIXED64):
        length = 4 if wire == FIXED32 else 8
    else:
        raise MalformedMessageError(f"wire type {wire} is not supported")
    if position + length > end:
        raise MalformedMessageError(f"{position + length - end} bytes too few")
    return position, position + length


@lru_cache(maxsize=64)
def protobuf_types(descriptor_set: bytes) -> ProtobufTypes:
    """All message types of a FileDescriptorSet.

    Raises:
        MalformedMessageError: The bytes are not such a set.
    """
    types: dict[str, Mapping[int, Field]] = {}
    for number, file in _fields(descriptor_set):
        if number == 1 and isinstance(file, bytes):
            parts = list(_fields(file))
            package, proto3 = _text(parts, 2), _text(parts, 12) == "proto3"
            for inner, message in parts:
                if inner == 4 and isinstance(message, bytes):
                    _message(types, f"{package}." if package else "", message, proto3, 0)
    return types


def _message(
    types: dict[str, Mapping[int, Field]], prefix: str, message: bytes, proto3: bool, depth: int
) -> None:
    parts = list(_fields(message))
    name = prefix + _text(parts, 1)
    if depth > _DEEPEST:
        raise MalformedMessageError("its types nest too deep")
    fields = dict(_field(body, proto3) for number, body in parts if number == 2 and isinstance(body, bytes))
    if fields and all(field.name in _TIME_PARTS for field in fields.values()):
        # A time that is absent is a stamp that was not set.
        fields = {
            number: Field(TIMES.get(f.name, f.name), f.wire, f.dtype, f.zigzag, "", False, f.repeated, 0.0)
            for number, f in fields.items()
        }
    types[name] = fields
    for number, body in parts:
        if number == 3 and isinstance(body, bytes):
            _message(types, f"{name}.", body, proto3, depth + 1)


def _field(body: bytes, proto3: bool) -> tuple[int, Field]:
    parts = list(_fields(body))
    of = {number: value for number, value in parts if isinstance(value, int)}
    number, kind, repeated = of.get(3, 0), of.get(5, 0), of.get(4, 0) == _REPEATED
    wire, dtype = _NUMBERS.get(kind, (BYTES, ""))
    in_doubt = not proto3 or 9 in of  # an own bit says whether it is there
    default = _text(parts, 7)
    try:
        absent = float({"true": "1", "false": "0"}.get(default, default)) if default else None
    except ValueError:
        absent = None  # the name of an enum's value
    if absent is None:
        absent = float("nan") if in_doubt else 0.0
    message = _text(parts, 6).lstrip(".") if kind == _MESSAGE else ""
    return number, Field(
        _text(parts, 1), wire, np.dtype(dtype) if dtype else None, kind in _ZIGZAG, message,
        kind == _STRING, repeated, absent,
    )  # fmt: skip


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int]]:
    """Numbers and values of a message's fields, in order."""
    position, end, count = 0, len(data), 0
    while position < end:
        tag, position = varint(data, position, end)
        start, stop = span_of(data, tag & 7, position, end)
        yield tag >> 3, varint(data, start, stop)[0] if tag & 7 == VARINT else data[start:stop]
        position, count = stop, count + 1
        if count > _MOST_FIELDS:
            raise MalformedMessageError("it has too many fields")


def _text(parts: list[tuple[int, bytes | int]], wanted: int) -> str:
    found = next((v for number, v in parts if number == wanted and isinstance(v, bytes)), b"")
    return found.decode("utf-8", "replace")
