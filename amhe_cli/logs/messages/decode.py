"""From messages to arrays: the quantities of one signal at the stamps of its messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError, LogError, one_of
from amhe_cli.core.signals import DERIVED, Signal
from amhe_cli.logs.containers.raw import Batch, Connection
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.layout import Layout, Leaf
from amhe_cli.logs.messages.split import MessageGroup
from amhe_cli.logs.messages.types import TICKS, TYPES, TypeInfo

_Bytes = NDArray[np.uint8]
#: Layouts whose recipe is kept, and all their fields: where each message has its own, memory must not fill.
_RECIPES, _HELD = 1024, 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SignalSamples:
    """Values of a signal from its messages, sorted by log time.

    Args:
        log_ns, publish_ns: Stamps of recorder and sender [ns], shape (n,).
        header_ns: Stamp in the message itself [ns], shape (n,); 0 where there is none.
        delay_ns: How much later than its stamp a sample acts (trajectory points) [ns], shape (n,).
        values: quantity -> (n, k), NaN where a message lacks the value.
        columns: quantity -> names of the k columns.
        has_header: Whether the message type carries a stamp.
        twist_in_child: Whether twists are in the child frame's axes, as in an odometry.
    """

    log_ns: IntArray
    publish_ns: IntArray
    header_ns: IntArray
    delay_ns: IntArray
    values: Mapping[str, FloatArray]
    columns: Mapping[str, tuple[str, ...]]
    has_header: bool
    twist_in_child: bool = False

    def pick(self, index: NDArray) -> SignalSamples:
        """The same for some of the messages: a mask or an order, shape (n,) or (m,)."""
        if np.array_equal(index, np.arange(self.log_ns.size)):  # as in most logs
            return self
        return SignalSamples(
            self.log_ns[index],
            self.publish_ns[index],
            self.header_ns[index],
            self.delay_ns[index],
            {quantity: values[index] for quantity, values in self.values.items()},
            self.columns,
            self.has_header,
            self.twist_in_child,
        )


@dataclass(slots=True)
class _Columns:
    """Places of the wanted numbers in one group of messages: leaves, None where absent."""

    stamp: tuple[Leaf, ...] | None
    delay: tuple[Leaf, Leaf] | None
    values: dict[str, list[Leaf | None]]
    unknown: dict[str, Leaf]


class _Growing:
    """An array (n, ...) to which rows are appended: at its end there is no second copy of an hour of log."""

    def __init__(self, rows: NDArray) -> None:
        self._held, self._count = np.array(rows), len(rows)

    def append(self, rows: NDArray) -> None:
        end = self._count + len(rows)
        if end > len(self._held):
            self._held.resize((max(end, 5 * self._count // 4), *self._held.shape[1:]), refcheck=False)
        self._held[self._count : end] = rows
        self._count = end

    def whole(self) -> NDArray:
        self._held.resize((self._count, *self._held.shape[1:]), refcheck=False)
        return self._held

    def of_width(self, width: int) -> _Growing:
        """The same where it is so wide, else as many rows of NaN."""
        same = self._held.shape[1] == width
        return self if same else _Growing(np.full((self._count, width), np.nan))


#: Messages of which the one that was delayed least gives the counter's offset: a few seconds, in which two
#: clocks drift apart by no more than a millisecond.
_NEAR = 2000
#: A counter whose offset changes by more at once [ns] has begun again.
_AGAIN = 10**9


class TickClock:
    """Moves a counter onto the clock by which its messages were sent, while they come.

    The counter is regular, and a busy sender is not: what was delayed least says how far they are apart.
    """

    def __init__(self) -> None:
        self._near = np.empty(0, dtype=np.int64)

    def stamps(self, ticks_ns: IntArray, sent_ns: IntArray) -> IntArray:
        """Stamps of the next messages [ns], of their counter and times of sending [ns]; shape (n,) each.

        A counter of 0 is one that the sender does not set: 0, no stamp.
        """
        offsets, found = sent_ns - ticks_ns, np.empty_like(ticks_ns)
        leaps = np.flatnonzero(np.abs(np.diff(offsets)) > _AGAIN) + 1
        ends = sorted({0, *leaps.tolist(), *range(0, offsets.size, _NEAR), offsets.size})
        for first, end in pairwise(ends):
            block = offsets[first:end]
            again = abs(block[0] - self._near[-1:]) > _AGAIN
            self._near = block if again.any() else np.concatenate((self._near[-_NEAR:], block))
            found[first:end] = self._near.min()
        return np.where(ticks_ns == 0, 0, ticks_ns + found)


#: Stamps of each sample, and its place among all messages.
_STAMPS = ("log_ns", "publish_ns", "header_ns", "delay_ns", "order")


class SignalDecoder:
    """Collects the samples of one signal from the groups of its connection.

    Raises:
        LogError: If the connection's type is not the signal's, or lacks its quantities.
    """

    def __init__(self, signal: Signal, connection: Connection) -> None:
        if signal.type is not None and signal.type != connection.type:
            raise LogError(f"topic {signal.topic!r} carries {connection.type}, not {signal.type}")
        self._signal = signal
        self.type = connection.type
        self._sparse = connection.encoding in (TABLE, "json")
        self._topic = f"topic {signal.topic!r} ({connection.type})"
        self.info = self._info(connection.type)
        self._wanted = self._quantities()
        self._names: tuple[str, ...] = signal.names
        self._columns: dict[str, tuple[str, ...]] = {}
        self._seen: set[str] = set()
        self._met: set[str] = set()
        self._last: Layout | None = None
        self._begin()
        self._recipes: dict[int, tuple[Layout, list[_Columns]]] = {}
        self.count = self._held = 0
        self._has_header, self._ticks = False, TickClock()
        self.odd = 0
        self.not_finite: dict[str, int] = dict.fromkeys(self._wanted, 0)

    def feed(self, batch: Batch, groups: Sequence[MessageGroup]) -> None:
        """Take the samples of one batch, as the splitter grouped it."""
        for group in groups:
            key = id(group.layout)
            if key not in self._recipes:
                if len(self._recipes) >= _RECIPES or self._held > _HELD:
                    self._recipes.clear()
                    self._held = 0
                self._held += group.layout.fields
                # Holding the layout keeps its id from being given to another one.
                self._recipes[key] = (group.layout, self._recipe(group.layout))
            for columns in self._recipes[key][1]:
                self._take(columns, group, batch)
        self.count += batch.starts.size

    def samples(self) -> SignalSamples:
        """Samples of all messages that were fed.

        Raises:
            LogError: If no message has a wanted entry or quantity.
        """
        if not self._groups:
            frame = self._signal.child_frame
            if frame is not None and self._seen:
                raise LogError(f"{self._topic}: {one_of('child frame', frame, self._seen)}")
            raise LogError(f"{self._topic}: no readable message")
        if self.lacking:
            raise LogError(self.lacking)
        return self.taken()

    def taken(self) -> SignalSamples:
        """Samples of the messages that were fed since the last call, where messages go on and on.

        What is missing is NaN.
        """
        log_ns, publish_ns, header_ns, delay_ns, order = (parts.whole() for parts in self._stamps.values())
        if self.type in TICKS and self._has_header:
            header_ns = self._ticks.stamps(header_ns, np.where(publish_ns > 0, publish_ns, log_ns))
        values = {quantity: parts.whole() for quantity, parts in self._values.items()}
        joined = SignalSamples(
            log_ns, publish_ns, header_ns, delay_ns,
            values, self._columns, self._has_header, self.info.twist_in_child,
        )  # fmt: skip
        self._begin()
        if np.all(np.diff(joined.log_ns) >= 0) and np.all(np.diff(order) > 0):  # as in most logs
            return joined
        return joined.pick(np.lexsort((order, joined.log_ns)))

    # -- what is wanted -------------------------------------------------------------------------------

    def _info(self, type_name: str) -> TypeInfo:
        known = TYPES.get(type_name)
        if not self._signal.fields and known is None:
            raise LogError(f"{self._topic}: this type is not built in; name its fields in the signal")
        if known is None or self._signal.fields:
            return TypeInfo(self._signal.fields, {q: paths for q, paths in self._signal.fields.items()})
        return known

    def _quantities(self) -> tuple[str, ...]:
        """The quantities to decode: the wanted ones, and those that they are computed from."""
        fields = self.info.fields
        wanted: list[str] = []
        for quantity in self._signal.quantities:
            source = DERIVED.get(quantity, "")
            if quantity not in fields and source not in fields:
                raise LogError(f"{self._topic}: {one_of('quantity', quantity, fields)}")
            wanted += [name for name in (quantity, source) if name in fields]
        if "orientation" in fields and "position" in fields:
            wanted.append("orientation")  # says whether the pose was lost, and turns the twist
        if self.info.twist_in_child and "linear_velocity" in wanted:
            wanted.append("position")  # says whether the twist is in the frame that ROS defines
        return tuple(dict.fromkeys(wanted))

    # -- where it lies --------------------------------------------------------------------------------

    def _recipe(self, layout: Layout) -> list[_Columns]:
        """One entry for each sample that a message of this layout holds."""
        info = self.info
        if info.names is not None:
            self._seen |= set(layout.names(info.names))
        if info.elements is None:
            return [self._at(layout, "", "")]
        prefixes = [f"{info.elements}[{i}]." for i in range(layout.counts.get(info.elements, 0))]
        if info.names is None:
            return [self._at(layout, prefix, prefix) for prefix in self._of_child(layout, prefixes)]
        return [self._at(layout, prefix, "") for prefix in prefixes]

    def _of_child(self, layout: Layout, prefixes: Sequence[str]) -> list[str]:
        """The transforms of the wanted frame."""
        frames = {prefix: layout.strings[f"{prefix}child_frame_id"].lstrip("/") for prefix in prefixes}
        self._seen |= set(frames.values())
        if self._signal.child_frame is None:
            raise ConfigError(
                f"signal {self._signal.name!r}: name the child_frame that is wanted of {self._topic}; "
                f"there is: {', '.join(sorted(self._seen))}"
            )
        return [p for p, frame in frames.items() if frame == self._signal.child_frame.lstrip("/")]

    def _at(self, layout: Layout, prefix: str, stamped: str) -> _Columns:
        values = {quantity: self._leaves(layout, prefix, quantity) for quantity in self._wanted}
        unknown = {
            quantity: layout.columns(path)[0]
            for quantity, path in (self.info.unknown or {}).items()
            if quantity in self._wanted
        }
        stamp = time_leaves(layout, f"{stamped}header.stamp") or time_leaves(layout, f"{stamped}stamp")
        tick = layout.leaves.get("tick") if self.type in TICKS else None
        stamp = (tick,) if tick else stamp
        self._has_header |= stamp is not None
        return _Columns(stamp, time_leaves(layout, f"{prefix}time_from_start"), values, unknown)

    def _leaves(self, layout: Layout, prefix: str, quantity: str) -> list[Leaf | None]:
        found = [layout.columns(prefix + path) for path in self.info.fields[quantity]]
        if self.info.names is not None:
            return self._by_name(layout, found[0], quantity)
        leaves: list[Leaf | None] = [leaf for leaves in found for leaf in leaves]
        if quantity in self._signal.fields:
            self._met |= {path for path in self.info.fields[quantity] if layout.columns(path)}
            self._last = layout
            leaves = [leaf for leaves in found for leaf in leaves or [None]]
        names = self.info.columns.get(quantity, ())
        if len(names) != len(leaves):
            names = tuple(f"[{i}]" for i in range(len(leaves)))
        return self._sized(quantity, names, leaves)

    def _by_name(self, layout: Layout, array: list[Leaf], quantity: str) -> list[Leaf | None]:
        names = layout.names(self.info.names or "")
        if not names and not self._names:
            return self._sized(quantity, tuple(f"[{i}]" for i in range(len(array))), array)
        self._names = self._names or names
        self._columns[quantity] = self._names
        if len(array) != len(names):
            self.odd += bool(array)
            return [None] * len(self._names)
        place = dict(zip(names, array, strict=True))
        return [place.get(name) for name in self._names]

    def _sized(
        self, quantity: str, names: tuple[str, ...], leaves: Sequence[Leaf | None]
    ) -> list[Leaf | None]:
        """Hold every message to the number of columns that the first one had."""
        fixed = self._columns.setdefault(quantity, names) if leaves else self._columns.get(quantity, ())
        if len(fixed) == len(leaves):
            return list(leaves)
        self.odd += 1
        return [None] * len(fixed)

    # -- taking it ------------------------------------------------------------------------------------

    def _take(self, columns: _Columns, group: MessageGroup, batch: Batch) -> None:
        rows, members = group.rows, group.members
        blocks = {quantity: _gather(rows, leaves) for quantity, leaves in columns.values.items()}
        if self._sparse:  # a row of a table need not hold every signal's numbers
            filled = np.any([np.isfinite(block).any(axis=1) for block in blocks.values()], axis=0)
            rows, members = rows[filled], members[filled]
            blocks = {quantity: block[filled] for quantity, block in blocks.items()}
        size = members.size
        self._groups += 1
        header_ns, delay_ns = (
            nanoseconds(rows, leaves) if leaves else np.zeros(size, dtype=np.int64)
            for leaves in (columns.stamp, columns.delay)
        )
        stamps = batch.log_ns[members], batch.publish_ns[members], header_ns, delay_ns, self.count + members
        for name, values in zip(_STAMPS, stamps, strict=True):
            self._stamps[name].append(values)
        for quantity, leaves in columns.values.items():
            block = blocks[quantity]
            present = [leaf is not None for leaf in leaves]
            self.not_finite[quantity] += int((~np.isfinite(block[:, present])).any(axis=1).sum())
            if quantity in columns.unknown:
                block[_gather(rows, [columns.unknown[quantity]])[:, 0] == -1.0] = np.nan
            width = len(self._columns.get(quantity, ()))
            self._values[quantity] = held = self._values[quantity].of_width(width)
            held.append(block if block.shape[1] == width else np.full((size, width), np.nan))

    @property
    def lacking(self) -> str:
        """Which joint or named field no message has had so far, in words; empty if none."""
        absent = [name for name in self._signal.names if name not in self._seen] if self.info.names else []
        if absent:
            return f"{self._topic}: {one_of('joint', absent[0], self._seen)}"
        paths = [path for q in self._wanted for path in self._signal.fields.get(q, ())]
        absent = [path for path in paths if path not in self._met] if self._last else []
        known = self._last.leaves if self._last else ()
        return f"{self._topic}: {one_of('number field', absent[0], known)}" if absent else ""

    def forget(self) -> None:
        """Let go of the layouts and names that were seen; columns keep their order."""
        self._recipes.clear()
        self._seen.clear()
        self._met.clear()
        self._last, self._held = None, 0

    def _begin(self) -> None:
        """Hold nothing of the messages so far."""
        self._groups = 0
        self._stamps = {name: _Growing(np.empty(0, dtype=np.int64)) for name in _STAMPS}
        self._values = {quantity: _Growing(np.empty((0, 0))) for quantity in self._wanted}


def time_leaves(layout: Layout, path: str) -> tuple[Leaf, Leaf] | None:
    """Seconds and nanoseconds of the time at `path`; None where there is none."""
    seconds, nanoseconds = layout.leaves.get(f"{path}.sec"), layout.leaves.get(f"{path}.nanosec")
    return (seconds, nanoseconds) if seconds and nanoseconds else None


def nanoseconds(rows: _Bytes, stamp: tuple[Leaf, ...]) -> IntArray:
    """A time of every message [ns], shape (n,): of seconds and nanoseconds, or a count of ms."""
    first, *nanoseconds = (leaf.read(rows).astype(np.int64) for leaf in stamp)
    return first * 10**9 + nanoseconds[0] if nanoseconds else first * 10**6


def _gather(rows: _Bytes, leaves: Sequence[Leaf | None]) -> FloatArray:
    block = np.full((len(rows), len(leaves)), np.nan)
    for i, leaf in enumerate(leaves):
        if leaf is not None:
            block[:, i] = leaf.read(rows)
    return block
