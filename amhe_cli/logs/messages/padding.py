"""Protobuf messages whose varints have many widths, brought to one width, so that they share a layout.

A varint may be written with more bytes than it needs, with nothing in them: 5 is 05, and 85 80 ... 00. One
message is walked in Python; every other with the same fields, whatever its widths, is rewritten with numpy.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import BoolArray, IntArray
from amhe_cli.logs.messages.descriptors import BYTES, VARINT, ProtobufTypes, span_of, varint

_Bytes = NDArray[np.uint8]
#: The longest varint has ten bytes; lengths are written with five.
_WIDTH, _LENGTH = 10, 5
_PLACES = np.arange(_WIDTH)


@dataclass(slots=True)
class _Step:
    """One part of a message: bytes of a fixed count, a varint, or the begin or end of a message within it.

    Args:
        kind: 'bytes', 'varint', 'begin' or 'end'.
        at: Where it lies in the padded message.
        size: Count of bytes, as logged.
        checked: Which of these bytes are tags and lengths, which must be those of the first message.
    """

    kind: str
    at: int
    size: int = 0
    checked: list[int] = field(default_factory=list)


class Padding:
    """Rewrites the messages that have the fields of a first one.

    Raises:
        MalformedMessageError: The first one cannot be a message of the type.
    """

    def __init__(self, message: bytes, type_name: str, types: ProtobufTypes) -> None:
        self._types = types
        self._steps: list[_Step] = []
        self._out = bytearray()
        self._fields(message, type_name, 0, len(message))
        self.template = np.frombuffer(bytes(self._out), np.uint8)

    def rewritten(self, buffer: _Bytes, starts: IntArray, lengths: IntArray) -> tuple[_Bytes, BoolArray]:
        """Padded messages (m, width), and which of those given they are, shape (n,).

        Args:
            buffer: Bytes, with at least ten after the last message.
            starts, lengths: Where each message lies, shape (n,).
        """
        place, alike, stop = starts.copy(), np.ones(starts.size, dtype=bool), starts + lengths
        rows = np.repeat(self.template[None], starts.size, axis=0)
        ends: list[IntArray] = []
        for step in self._steps:
            if step.kind == "end":
                alike &= place == ends.pop()
                continue
            size = step.size if step.kind == "bytes" else _WIDTH
            place = np.minimum(place, buffer.size - size)
            found = np.lib.stride_tricks.sliding_window_view(buffer, size)[place]
            if step.kind == "bytes":
                expected = self.template[step.at : step.at + size][step.checked]
                alike &= (found[:, step.checked] == expected).all(axis=1)
                rows[:, step.at : step.at + size] = found
                place += size
                continue
            width = np.argmin(found & 0x80, axis=1) + 1
            alike &= found[np.arange(width.size), width - 1] < 0x80
            inside = width[:, None] > _PLACES
            place += width
            if step.kind == "begin":
                digits = np.where(inside, found & 0x7F, 0)[:, :_LENGTH].astype(np.int64)
                ends.append(place + (digits << (7 * _PLACES[:_LENGTH])).sum(axis=1))
                continue
            rows[:, step.at : step.at + _WIDTH] = np.where(inside, found | 0x80, 0x80)
            rows[:, step.at + _WIDTH - 1] = np.where(width == _WIDTH, found[:, -1], 0)
        alike &= place == stop
        return rows[alike], alike

    # -- the first message ----------------------------------------------------------------------------

    def _fields(self, data: bytes, type_name: str, position: int, end: int) -> None:
        fields = self._types.get(type_name, {})
        while position < end:
            tag, after = varint(data, position, end)
            start, stop = span_of(data, tag & 7, after, end)
            known = fields.get(tag >> 3)
            self._bytes(data[position:after], checked=True)
            if tag & 7 == VARINT:
                self._varint(data[start:stop])
            elif tag & 7 == BYTES and known is not None and known.message and known.message in self._types:
                at = self._begin()
                self._fields(data, known.message, start, stop)
                self._end(at)
            elif tag & 7 == BYTES and known is not None and known.wire == VARINT and start < stop:
                at = self._begin()
                self._varints(data, start, stop)
                self._end(at)
            else:
                self._bytes(data[after:start], checked=True)
                self._bytes(data[start:stop], checked=False)
            position = stop

    def _varints(self, data: bytes, position: int, end: int) -> None:
        while position < end:
            _, after = varint(data, position, end)
            self._varint(data[position:after])
            position = after

    def _begin(self) -> int:
        """Leave room for a length; where its content begins."""
        self._steps.append(_Step("begin", len(self._out)))
        self._out += bytes(_LENGTH)
        return len(self._out)

    def _end(self, at: int) -> None:
        """Write the length of the padded content that began `at`."""
        size = len(self._out) - at
        digits = ((size >> 7 * i & 0x7F) | (0x80 if i < _LENGTH - 1 else 0) for i in range(_LENGTH))
        self._out[at - _LENGTH : at] = bytes(digits)
        self._steps.append(_Step("end", len(self._out)))

    def _bytes(self, content: bytes, checked: bool) -> None:
        if not self._steps or self._steps[-1].kind != "bytes":
            self._steps.append(_Step("bytes", len(self._out)))
        step = self._steps[-1]
        if checked:
            step.checked += range(step.size, step.size + len(content))
        step.size += len(content)
        self._out += content

    def _varint(self, content: bytes) -> None:
        self._steps.append(_Step("varint", len(self._out)))
        wide = bytes(byte | 0x80 for byte in content) + b"\x80" * (_WIDTH - len(content))
        self._out += wide[:-1] + (content[-1:] if len(content) == _WIDTH else b"\0")
