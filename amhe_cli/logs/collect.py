"""The samples of some signals, decoded in one pass over a log of any format, without what is impossible."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.folder import StoredLog, open_log
from amhe_cli.logs.containers.raw import Connection, messages, readable
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.decode import SignalDecoder, SignalSamples
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.split import Splitter

logger = logging.getLogger(__name__)


#: A quaternion whose norm is off by more than this is not a rotation but damage or no data.
_NORM = 0.05
#: No SI quantity of a robot is larger.
_ABSURD = 1e9
#: A velocity that is off by less [m/s] may be noise.
_TWIST_ERROR = 0.05
#: Half of the time [s] over which positions are compared with a velocity.
_TWIST_SPAN = 0.01


def checked(samples: SignalSamples, signal: Signal, warn: Callable[[str], None]) -> SignalSamples:
    """Replace impossible values by NaN, count them, and normalise quaternions.

    A pose without a rotation was not measured: motion capture that loses its markers sends zeros. Its
    position is dropped too, unless no message of the topic has a rotation at all.
    """
    values = dict(samples.values)
    for quantity, block in samples.values.items():
        plain = quantity == "value" and not signal.is_input  # a number of any unit, which drives nothing
        ends = (float(end.reduce(block, axis=None, initial=0.0)) for end in (np.fmax, np.fmin))
        if plain or not any(abs(end) > _ABSURD for end in ends):  # as in most logs: nothing is copied
            continue
        with np.errstate(invalid="ignore"):
            absurd = np.any(np.abs(block) > _ABSURD, axis=1)
        warn(f"{messages(int(absurd.sum()))} with impossible {quantity} dropped")
        values[quantity] = np.where(absurd[:, None], np.nan, block)
    if "orientation" in values:
        _check_rotation(values, signal, warn)
    return replace(samples, values=values)


def _check_rotation(values: dict[str, FloatArray], signal: Signal, warn: Callable[[str], None]) -> None:
    quaternions = values["orientation"]
    lost = ~(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) <= _NORM)
    if lost.all() and "orientation" not in signal.quantities:
        return
    values["orientation"] = np.where(
        lost[:, None], np.nan, rotations.normalised(np.where(lost[:, None], 1.0, quaternions))
    )
    if lost.any() and not lost.all():
        warn(f"{messages(int(lost.sum()))} without a valid quaternion (zero, NaN, not of unit norm) dropped")
    if "position" in values and lost.any():
        for quantity, block in values.items():
            values[quantity] = np.where(lost[:, None], np.nan, block)


def twist_looks_global(times: FloatArray, samples: SignalSamples, turned: FloatArray) -> bool:
    """Whether an odometry's velocity fits its positions only if it is *not* turned out of the child frame.

    Args:
        times: Stamps [s], shape (m,).
        samples: The samples, with position and linear_velocity as logged, shape (m, 3).
        turned: The velocity turned into the world as ROS defines it, shape (m, 3).
    """
    if not samples.twist_in_child:
        return False
    position, logged = samples.values["position"], samples.values["linear_velocity"]
    known = np.isfinite(position).all(axis=1) & np.isfinite(turned).all(axis=1)
    times, position, turned, logged = times[known], position[known], turned[known], logged[known]
    if times.size < 10:
        return False
    half = min(int(np.ceil(_TWIST_SPAN / np.median(np.diff(times)))), (times.size - 1) // 2)
    early, middle, late = (slice(i, times.size - 2 * half + i) for i in (0, half, 2 * half))
    moved = (position[late] - position[early]) / (times[late] - times[early])[:, None]
    as_ros_says, as_logged = (
        float(np.median(np.linalg.norm(moved - one[middle], axis=1))) for one in (turned, logged)
    )
    return as_ros_says > _TWIST_ERROR and as_logged < 0.3 * as_ros_says


#: Topics that a message names, of all that there are.
_LISTED = 50


def collect(log: StoredLog, signals: Sequence[Signal], definitions: Definitions) -> dict[str, SignalSamples]:
    """Decode the signals' topics in one pass; damage and impossible values are logged as warnings.

    Returns:
        Name of each signal -> its samples, at least one.

    Raises:
        LogError: If a topic is absent, of another type, or none of its messages can be read.
    """
    splitters: dict[Connection, Splitter] = {}
    decoders: dict[str, SignalDecoder] = {}
    used: dict[str, Connection] = {}
    for batch in log.batches({signal.topic for signal in signals}):
        connection = batch.connection
        wanting = [s for s in signals if s.topic == connection.topic and s.type in (None, connection.type)]
        wanting = [s for s in wanting if used.setdefault(s.name, connection).type == connection.type]
        if not wanting:
            continue
        splitter = splitters.get(connection) or splitters.setdefault(
            connection, Splitter(connection, definitions)
        )
        groups = sorted(splitter.split(batch), key=lambda group: int(group.members[0]))
        for signal in wanting:
            if signal.name not in decoders:
                decoders[signal.name] = SignalDecoder(signal, connection)
            decoders[signal.name].feed(batch, groups)
    for problem in log.problems:
        logger.warning("%s: %s", log.path, problem)
    for connection, splitter in splitters.items():
        if splitter.damaged:
            text = f"{messages(splitter.damaged)} damaged and dropped ({splitter.reason})"
            logger.warning("%s: topic %r: %s", log.path, connection.topic, text)
    found = {}
    for signal in signals:
        if (decoder := decoders.get(signal.name)) is None:
            raise LogError(f"{log.path}: {missing(log.connections, signal, log.problems)}")

        def warn(text: str, topic: str = signal.topic) -> None:
            logger.warning("%s: topic %r: %s", log.path, topic, text)

        for text in _losses(log.connections, signal, decoder):
            warn(text)
        found[signal.name] = checked(decoder.samples(), signal, warn)
    return found


def _losses(connections: Sequence[Connection], signal: Signal, decoder: SignalDecoder) -> Iterator[str]:
    """What of a signal's messages is not read."""
    here = [connection for connection in connections if connection.topic == signal.topic]
    types = {connection.type for connection in here}
    if len(types) > 1:
        yield f"carries several types ({', '.join(sorted(types))}): only {decoder.type} is read"
    # A driver that never fills in its efforts is no damage, nor is a blank cell of a table.
    if not any(connection.encoding in (TABLE, "json") for connection in here):
        for quantity, count in decoder.not_finite.items():
            if 0 < count < decoder.count:
                yield f"{messages(count)} with {quantity} that is not finite dropped"
    if decoder.odd:
        yield "arrays of another length than the first message's are left out"


def missing(connections: Sequence[Connection], signal: Signal, problems: Sequence[str] = ()) -> str:
    """Why there are no data for `signal`, and what there is instead."""
    here = [connection for connection in connections if connection.topic == signal.topic]
    types = sorted({connection.type for connection in here})
    if signal.type is not None and types and signal.type not in types:
        return f"topic {signal.topic!r} carries {', '.join(types)}, not {signal.type}"
    if here:
        return f"topic {signal.topic!r} has no messages"
    same = sorted({connection.topic for connection in connections if connection.type == signal.type})
    rest = sorted({connection.topic for connection in connections} - set(same))
    close = get_close_matches(signal.topic, [*same, *rest], n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    names = [*(f"{topic} ({signal.type})" for topic in same), *rest]
    more = [f"{len(names) - _LISTED} more"] if len(names) > _LISTED else []
    listed = ", ".join(names[:_LISTED] + more) or "no topic at all"
    damage = f"; the log is damaged: {problems[0]}" if problems else ""
    return f"no topic {signal.topic!r}{hint}; there is: {listed}{damage}"


#: Fields of a message by their paths, such as "parameters[0].value": numbers, names and marks.
Fields = dict[str, float | str]


def read_topic(path: Path, topic: str) -> list[tuple[int, Fields]]:
    """Log time [ns] and fields of each message of a topic, in their order; [] where there is no such topic.

    Raises:
        LogError: The log cannot be read.
    """
    found: list[tuple[int, Fields]] = []
    with readable(path):
        definitions, splitters = Definitions(), dict[Connection, Splitter]()
        for batch in open_log(path).batches({topic}):
            own = splitters.setdefault(batch.connection, Splitter(batch.connection, definitions))
            for group in own.split(batch):
                numbers = {
                    name if leaf.count is None else f"{name}[{i}]": one.read(group.rows).tolist()
                    for name, leaf in group.layout.leaves.items()
                    for i, one in enumerate(group.layout.columns(name))
                }
                for i, row in enumerate(group.members):
                    fields = {name: float(values[i]) for name, values in numbers.items()}
                    found.append((int(batch.log_ns[row]), {**group.layout.strings, **fields}))
    return sorted(found, key=lambda message: message[0])
