"""From the name of a source to a transport, or to a log."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.settings import LiveSettings
from amhe_cli.core.signals import Measured, Signal
from amhe_cli.logs.containers.folder import open_log
from amhe_cli.logs.containers.raw import readable
from amhe_cli.logs.live.dds import Dds
from amhe_cli.logs.live.growing import GrowingMcap
from amhe_cli.logs.live.lines import Lines, listening
from amhe_cli.logs.live.messages import CLOCK, LiveSource
from amhe_cli.logs.live.ros import renamed
from amhe_cli.logs.live.transport import Played, Transport
from amhe_cli.logs.live.zenoh import Zenoh
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.tables import signals_on_tables

#: What a source is called.
SOURCES = "ros2, zenoh, mcap (with `follow`), udp://HOST:PORT, - (lines on standard input), or a LOG"


def open_transport(
    name: str,
    follow: Path | None,
    topics: frozenset[str] | None,
    signals: Sequence[Signal],
    definitions: Definitions,
    live: LiveSettings,
) -> Transport | None:
    """A transport of some topics (None: all); None where the name is that of a log.

    Args:
        name: See `SOURCES`.
        follow: The .mcap file, or folder of them, that grows.
        topics: Topics that are wanted.
        signals: The signals whose topics they are, which say of what types lines are.
        definitions: Definitions of message types.
        live: Where topics are found.

    Raises:
        ConfigError: There is no such source, or it cannot be reached.
    """
    if (name == "mcap") != (follow is not None):
        raise ConfigError("`source=mcap` and `follow` go together: name the file that grows with `follow`")
    if follow is not None:
        return GrowingMcap(follow, topics)
    if name == "ros2":
        return Dds(topics, definitions, live.domain, live.interface, live.peers)
    if name == "zenoh":
        return Zenoh(topics, definitions, live.domain, live.connect)
    if name == "-":
        return Lines("standard input", sys.stdin.fileno(), signals)
    if name.startswith("udp://"):
        host, colon, port = name.removeprefix("udp://").rpartition(":")
        if not (colon and port.isdecimal()):
            raise ConfigError(f"`source`: {name!r} names no port; write udp://127.0.0.1:9870")
        return Lines(f"{name}, not signed", listening(host.strip("[]"), int(port)), signals)
    if not Path(name).exists():
        raise ConfigError(f"`source`: {name!r} is no file; there is: {SOURCES}")
    return None


@contextmanager
def open_source(
    name: str, follow: Path | None, system: Measured, definitions: Definitions, speed: float
) -> Iterator[tuple[LiveSource, Transport]]:
    """The samples of a system, and the transport that brings them; see `open_transport`.

    A log is played at a speed.

    Raises:
        LogError: The log cannot be read.
    """
    settings = system.settings
    signals = renamed(system.signals, settings.live.remap)
    clock = [CLOCK] if settings.live.sim_time else []
    topics = frozenset([*(signal.topic for signal in signals), *clock])
    transport = open_transport(name, follow, topics, signals, definitions, settings.live)
    if transport is None:
        with readable(Path(name)):
            log = open_log(Path(name))
            signals = signals_on_tables(log.connections, signals)
            transport = Played(log, {*clock, *(signal.topic for signal in signals)}, speed)
    with closing(transport):
        yield LiveSource(transport, signals, definitions, settings.logs, bool(clock)), transport
