"""The samples of some signals, decoded in one pass over a log of any format."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from difflib import get_close_matches

from amhe_cli.core.errors import LogError
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.folder import StoredLog
from amhe_cli.logs.containers.raw import Connection, messages
from amhe_cli.logs.containers.table_file import ENCODING as TABLE
from amhe_cli.logs.messages.decode import SignalDecoder, SignalSamples
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.messages.split import Splitter
from amhe_cli.logs.physics import checked

logger = logging.getLogger(__name__)

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
