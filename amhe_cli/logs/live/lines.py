"""Lines of JSON, by UDP or from a pipe: for every sender that no other transport covers.

A line is one message of a topic, with the fields that its type has in ROS:

    {"topic": "/joint_states", "stamp": 12.345, "name": ["hinge"], "position": [0.1], "velocity": [0.0]}

`stamp` is the sender's own time [s]; without it a message counts from its arrival. A datagram holds whole
lines.
"""

from __future__ import annotations

import json
import os
import select
import socket
import time
from collections.abc import Sequence

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.signals import Signal
from amhe_cli.logs.containers.raw import Batch, Connection, batch_of
from amhe_cli.logs.live.transport import Transport

#: Longest line, and longest piece that is read at once [bytes]: those of a datagram.
_LONGEST = 65536
#: Pieces between two looks; the kernel holds, or drops, the rest.
_MOST = 2000


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
