"""Sources by their names: topics of ROS 2, a log that is played or still written, lines of JSON."""

from __future__ import annotations

import json
import os
import re
import select
import socket
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.files import check_regular
from amhe_cli.core.limits import beyond, limits
from amhe_cli.core.settings import LiveSettings
from amhe_cli.core.signals import Measured, Signal
from amhe_cli.logs.containers.folder import StoredLog, open_log
from amhe_cli.logs.containers.mcap_file import MAGIC, PARSE_ERRORS, RECORD, McapMessages, Piece, unfolded
from amhe_cli.logs.containers.raw import Batch, Connection, Unfolder, batch_of, readable
from amhe_cli.logs.live.messages import CLOCK, LiveSource, Transport
from amhe_cli.logs.live.ros import Dds, Zenoh, renamed
from amhe_cli.logs.messages.definitions import Definitions
from amhe_cli.logs.tables import signals_on_tables

#: What a source is called.
SOURCES = "ros2, zenoh, mcap (with `follow`), udp://HOST:PORT, - (lines on standard input), or a LOG"
#: What a batch has of each message.
_EACH = ("log_ns", "publish_ns", "starts", "lengths")
#: A file that grows: bytes that are read at one look, so that a long one does not hold up all else; a chunk
#: may be longer.
_READ = 8 * 2**20
#: Records that hold messages, or say what they are.
_READABLE = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
#: Longest line, and longest piece that is read at once [bytes]: those of a datagram.
_LONGEST = 65536
#: Pieces of lines between two looks; the kernel holds, or drops, the rest.
_MOST = 2000


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


class Played(Transport):
    """A log as if it were live: messages come when they were received, or so many times as fast.

    Args:
        topics: Topics that are wanted.
        speed: Seconds of the log in one second.

    Raises:
        LogError: The log cannot be read.
    """

    def __init__(self, log: StoredLog, topics: Collection[str], speed: float) -> None:
        super().__init__(str(log.path))
        found = [(np.argsort(batch.log_ns, kind="stable"), batch) for batch in log.batches(topics)]
        self._batches = [(batch.log_ns[order], order, batch) for order, batch in found if order.size]
        self.connections = log.connections
        for problem in log.problems:
            self.note(f"{log.path}: {problem}")
        self._start_ns = min((int(stamps[0]) for stamps, *_ in self._batches), default=0)
        self._end_ns = max((int(stamps[-1]) for stamps, *_ in self._batches), default=0)
        self._speed, self._begun, self._reached = speed, -1.0, self._start_ns - 1

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        self._begun = time.monotonic() if self._begun < 0.0 else self._begun
        before = self._reached
        self._reached = self._start_ns + round(1e9 * self._speed * (time.monotonic() - self._begun))
        self.over = self._reached >= self._end_ns
        found = []
        for stamps, order, batch in self._batches:
            first, last = np.searchsorted(stamps, (before, self._reached), side="right")
            if last > first:
                cut = {name: getattr(batch, name)[order[first:last]] for name in _EACH}
                found.append(replace(batch, **cut))
        return found


class GrowingMcap(Transport):
    """The messages that are appended to a file from now on.

    Records count once they are whole: of a chunk that is being written nothing is read. Where the recorder
    goes on in another file of the folder, as rosbag2 does, that is read from its start; so is a file that
    takes the place of the first one, or that is cut short.

    Args:
        path: A .mcap file, or a folder of them, of which the last is followed.
        topics: Topics that are wanted; None: all.

    Raises:
        ConfigError: There is no such file.
    """

    def __init__(self, path: Path, topics: Collection[str] | None) -> None:
        super().__init__(f"{path}, while it grows")
        self._folder, self._topics = (path if path.is_dir() else path.parent), topics
        path = max(self._files(), key=_number, default=path) if path.is_dir() else path
        if not path.is_file():
            check_regular(path)
            raise ConfigError(f"{path}: no .mcap file to follow")
        self._open(path, skip=path.stat().st_size)

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        try:
            found = self._grown() or self._turned()
        except (OSError, ConfigError) as error:  # a disk that is gone for a while; no regular file
            self.note(f"{self._path}: {error}; waiting")
            return []
        for problem in self._messages.problems[:1]:
            self.note(f"{self._path.name}: {problem}")
        self._messages.problems.clear()
        return found

    def close(self) -> None:
        """See `Transport`."""
        self._file.close()

    def _open(self, path: Path, skip: int = 0) -> None:
        self._path, self._file, self._inode = path, path.open("rb"), path.stat().st_ino
        self._at, self._skip, self._ended = len(MAGIC), skip, False
        self._messages = McapMessages()
        self.connections = self._messages.connections

    def _grown(self) -> list[Batch]:
        """Messages of the records that have become whole since the last call."""
        found: list[Batch] = []
        begun, size = self._at, self._file.seek(0, 2)
        while not self._ended and self._at - begun < _READ and self._at + RECORD.size <= size:
            self._file.seek(self._at)
            head = self._file.read(RECORD.size)
            opcode, length = RECORD.unpack(head)
            if length > limits().piece or opcode == 0 or len(self.connections) > limits().topics:
                self._ended = True  # where the next record begins is not known
                self.note(
                    f"{self._path.name}: {beyond('piece_mib', 'a record is')}; waiting for the next file"
                )
            elif self._at + RECORD.size + length > size:
                break
            else:
                # of what is older only the declarations count
                topics = self._topics if self._at >= self._skip else ()
                self._at += RECORD.size + length
                found += self._of_record(opcode, head + self._file.read(length), topics)
        return found

    def _of_record(self, opcode: int, record: bytes, topics: Collection[str] | None) -> list[Batch]:
        self._ended = opcode in (Opcode.DATA_END, Opcode.FOOTER)
        try:
            if opcode == Opcode.CHUNK:
                record = unfolded(record, Piece(RECORD.size, len(record), True), Unfolder(len(record)))
            elif opcode not in _READABLE:
                return []
        except PARSE_ERRORS as error:
            self.note(f"{self._path.name}: a chunk is lost: {error}")
            return []
        return list(self._messages.records(record, 0, len(record), topics))

    def _turned(self) -> list[Batch]:
        """Go on in the file that took this one's place, or in the next one."""
        now = self._path.stat() if self._path.exists() else None
        anew = now is not None and (now.st_ino != self._inode or now.st_size < self._at)
        later = [file for file in self._files() if _number(file) > _number(self._path)]
        if not (anew or later):
            return []
        path = self._path if anew else min(later, key=_number)
        check_regular(path, None if anew else self._folder)
        self._file.close()
        self._open(path)
        return self._grown()

    def _files(self) -> list[Path]:
        return [file for file in self._folder.glob("*.mcap") if file.stat().st_size > len(MAGIC)]


def _number(file: Path) -> tuple[list[int], str]:
    """Orders the files of rosbag2 as it numbers them: name_0, or 0_name_date."""
    return [int(digits) for digits in re.findall(r"\d+", file.stem)], file.name


class Lines(Transport):
    """JSON lines.

    Args:
        about: Whom it listens to.
        end: Descriptor of a pipe, or a socket of datagrams.
        signals: What is wanted: a topic is taken to be of its signal's type.
    """

    def __init__(self, about: str, end: int | socket.socket, signals: Sequence[Signal]) -> None:
        super().__init__(about)
        self._end, self._rest = end, b""
        types = {signal.topic: signal.type or "" for signal in signals}
        self.connections = [Connection(topic, kind, "json", "", "") for topic, kind in types.items()]

    def receive(self) -> list[Batch]:
        """See `Transport`."""
        found: dict[str, list[bytes]] = {}
        for line in self._lines():
            try:
                found.setdefault(str(json.loads(line)["topic"]), []).append(line)
            except (ValueError, TypeError, KeyError, RecursionError):
                self.note(f'{self.about}: lines that are no JSON object with a "topic" are left out')
        known = {connection.topic: connection for connection in self.connections}
        if set(found) - set(known):
            self.note(f"{self.about}: lines of other topics than {', '.join(known)} are left out")
        now = time.time_ns()
        return [
            batch_of(known[topic], [now] * len(lines), [now] * len(lines), lines)
            for topic, lines in found.items()
            if topic in known
        ]

    def close(self) -> None:
        """See `Transport`."""
        if isinstance(self._end, socket.socket):
            self._end.close()

    def _lines(self) -> list[bytes]:
        """The lines that have become whole."""
        datagrams = isinstance(self._end, socket.socket)
        for _ in range(_MOST):
            if not select.select([self._end], [], [], 0.0)[0]:
                break
            piece = self._end.recv(_LONGEST) if isinstance(self._end, socket.socket) else self._piece()
            self._rest += piece + (b"\n" if datagrams or self.over else b"")
            if self.over:
                break
        *lines, self._rest = self._rest.split(b"\n")
        if len(self._rest) > _LONGEST:
            self._rest = b""
            self.note(f"{self.about}: a line of more than {_LONGEST} bytes is left out")
        return [line for line in lines if line.strip()]

    def _piece(self) -> bytes:
        piece = os.read(self._end, _LONGEST)  # type: ignore[arg-type]
        self.over = not piece
        return piece


def listening(host: str, port: int) -> socket.socket:
    """A socket for datagrams.

    Raises:
        ConfigError: The address cannot be listened on.
    """
    end = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 * _LONGEST)
        end.bind((host, port))
    except (OSError, OverflowError) as error:
        end.close()
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"`source`: cannot listen on {host}:{port}: {why}") from None
    return end
