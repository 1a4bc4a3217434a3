"""Messages that a library parses, JSON and protobuf, as rows of numbers: so they are read like all others.

Numbers of a message lie side by side as float64. Messages with the same fields, array lengths and names share
a layout. Times are brought to the names of ROS: stamp.sec and stamp.nanosec.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.logs.messages.layout import (
    LONGEST_NAME,
    Constant,
    Layout,
    Leaf,
    MalformedMessageError,
    Several,
)

#: Names of the parts of a time -> those of ROS 2.
TIMES = {"nsec": "nanosec", "nsecs": "nanosec", "nanos": "nanosec", "secs": "sec", "seconds": "sec"}
#: Messages nest no deeper.
DEEPEST = 30
#: A message holds no more numbers and messages in it.
_MOST_VALUES = 100_000
#: Fields of all remembered layouts together.
_CACHED_FIELDS = 1_000_000
#: Every number of a row.
_F8 = np.dtype("<f8")


class Row:
    """What one message holds, in the order of its content.

    Attributes:
        numbers: Its numbers, those of arrays one after the other.
        shape: Path of each number, and None; of each array, and its length.
        counts: Path of an array of structures or strings -> number of its elements.
        strings: Path -> content; only names and frames.
        names: Path of an array of names -> its content.
    """

    def __init__(self) -> None:
        self.numbers: list[float] = []
        self.shape: list[tuple[str, int | None]] = []
        self.counts: dict[str, int] = {}
        self.strings: dict[str, str] = {}
        self.names: dict[str, tuple[str, ...]] = {}

    def number(self, path: str, value: float) -> None:
        """Note a number."""
        self.shape.append((path, None))
        self.numbers.append(value)

    def array(self, path: str, values: Sequence[float]) -> None:
        """Note an array of numbers."""
        self.shape.append((path, len(values)))
        self.numbers += values

    def time(self, path: str, value: float) -> None:
        """Note a time that is one number: s, or by its size ms, us or ns since 1970."""
        unit = next((unit for least, unit in _UNITS if abs(value) > least), 1)
        seconds, rest = divmod(value, unit)
        self.number(f"{path}.sec", float(int(seconds)))
        self.number(f"{path}.nanosec", round(rest * (10**9 // unit)))

    def check(self, depth: int) -> None:
        """Refuse a message that is too deep or too large.

        Raises:
            MalformedMessageError: It is.
        """
        if depth > DEEPEST or len(self.numbers) + len(self.counts) > _MOST_VALUES:
            raise MalformedMessageError("it nests too deep, or holds too many numbers")

    def key(self) -> tuple:
        """Equal for two messages of one layout."""
        texts = (tuple(self.strings.items()), tuple(self.names.items()))
        return tuple(self.shape), tuple(self.counts.items()), *texts

    def layout(self) -> Layout:
        """Where each number lies in the row.

        Raises:
            MalformedMessageError: A name is too long.
        """
        for path, names in self.names.items():
            self.counts[path] = len(names)
            self.strings |= {f"{path}[{i}]": name for i, name in enumerate(names)}
        for path, name in self.strings.items():
            if len(name) > LONGEST_NAME:
                raise MalformedMessageError(f"{path} has {len(name)} characters")
        leaves, offset = {}, 0
        for path, count in self.shape:
            leaves[path] = Leaf(offset, _F8, count)
            offset += 8 * (1 if count is None else count)
        return self.finished(leaves)

    def finished(self, leaves: dict[str, Leaf]) -> Layout:
        """The layout, with a list of joints (foxglove.JointStates) in the form of a JointState, too."""
        joints = [f"joints[{i}]." for i in range(self.counts.get("joints", 0))]
        if joints and all(f"{joint}name" in self.strings for joint in joints):
            self.counts["name"] = len(joints)
            self.strings |= {f"name[{i}]": self.strings[f"{joint}name"] for i, joint in enumerate(joints)}
            for quantity in ("position", "velocity", "effort"):
                of_joints = (leaves.get(joint + quantity) for joint in joints)
                parts = tuple(leaf for leaf in of_joints if leaf is not None and leaf.count is None)
                measured = any(not isinstance(leaf, Constant) or leaf.value == leaf.value for leaf in parts)
                if len(parts) == len(joints) and measured:
                    leaves[quantity] = Several(0, _F8, len(parts), parts)
        nothing = np.empty(0, dtype=np.int64)
        return Layout(
            leaves, self.counts, self.strings, nothing, nothing.astype(np.uint8), fields=len(leaves) + 1
        )


#: A larger number is a time in parts of a second since 1970, so many of them in one.
_UNITS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3))


class Rows:
    """Turns messages of one connection into rows; keeps the layouts that it has seen.

    Args:
        read: Parses the bytes of one message; raises MalformedMessageError where they are none.
    """

    def __init__(self, read: Callable[[bytes], Row]) -> None:
        self._read = read
        self._layouts: dict[tuple, Layout] = {}
        self._held = 0
        #: Fields of all layouts that were met.
        self.fields = 0

    def row(self, message: bytes) -> tuple[Layout, FloatArray]:
        """Layout and numbers, shape (n,), of one message.

        Raises:
            MalformedMessageError: The bytes are no such message, or it is too deep or too large.
        """
        row = self._read(message)
        key = row.key()
        if key not in self._layouts:
            if self._held > _CACHED_FIELDS:
                self._layouts, self._held = {}, 0
            layout = row.layout()
            self._layouts[key] = layout
            self._held += layout.fields
            self.fields += layout.fields
        return self._layouts[key], np.array(row.numbers, dtype=np.float64)
