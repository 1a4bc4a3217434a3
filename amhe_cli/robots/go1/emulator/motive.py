"""An emulated Motive: the NatNet protocol, unicast, with two rigid bodies.

A client sends its request from its command socket and gets frames there; it repeats it within ten seconds.
Frames come by the clock, never as an answer: a client that answers frames would be answered for ever.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from amhe_cli.robots.go1.emulator.robot_port import bound
from amhe_cli.robots.go1.poses.source import Pose

#: Messages of NatNet.
_CONNECT, _SERVER_INFO, _REQUEST_MODELS, _MODELS, _FRAME, _KEEP_ALIVE = 0, 1, 4, 5, 7, 10
_FORGOTTEN = 10.0
#: Frequency of the clock of a frame's exposure and transmission [Hz]: that of Windows.
_CLOCK_HZ = 10_000_000
_DATA_PORT = 1511
_RIGID_BODY = 1
#: Pose of a body that is not seen.
_NOWHERE = np.zeros(3), np.zeros(4)


class Motive:
    """The emulated server.

    Args:
        host, port: Address to bind: the command port.
        names: Names of the rigid bodies; their ids count from 1.
        version: Version of the protocol: 3.1, or 4.1, which gives the sizes of its sections.
        latency: Time from exposure to transmission [s].
    """

    def __init__(
        self, host: str, port: int, names: Sequence[str],
        version: tuple[int, int] = (4, 1), latency: float = 0.004,
    ) -> None:  # fmt: skip
        self._socket = bound(host, port, ("mocap_port", "pose_port"))
        self._names, self._version, self._latency = list(names), version, latency
        self._clients: dict[tuple[str, int], float] = {}
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._number = 0

    @property
    def address(self) -> tuple[str, int]:
        """The address at which it listens."""
        return self._socket.getsockname()

    def serve(self, now: float) -> None:
        """Answer the requests of clients, and send them the frames that are due; `now` [s]."""
        self._listen(now)
        while self._waiting and self._waiting[0][0] <= now:
            self._transmit(self._waiting.popleft()[1], now)

    def show(self, bodies: Sequence[Pose | None], now: float) -> None:
        """Take a frame, exposed at a time [s], with bodies that are not seen as None; `serve` sends it."""
        self._number += 1
        self._waiting.append((now + self._latency, self._frame(bodies, now)))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _listen(self, now: float) -> None:
        while True:
            try:
                message, client = self._socket.recvfrom(2048)
            except OSError:
                return
            kind = int.from_bytes(message[:2], "little") if len(message) >= 4 else -1
            if kind in (_CONNECT, _KEEP_ALIVE):
                self._clients[client] = now
            answer = {_CONNECT: self._server_info, _REQUEST_MODELS: self._models}.get(kind)
            if answer:
                self._send(answer(), client)

    def _transmit(self, frame: bytes, now: float) -> None:
        """Send to all clients that have sent a request lately."""
        for client, requested in list(self._clients.items()):
            if now - requested > _FORGOTTEN:
                del self._clients[client]
            else:
                self._send(frame, client)

    def _send(self, message: bytes, client: tuple[str, int]) -> None:
        try:
            self._socket.sendto(message, client)
        except OSError:
            self._clients.pop(client, None)

    def _server_info(self) -> bytes:
        name = b"amhe emulated Motive".ljust(256, b"\0")
        versions = bytes([3, 1, 0, 0, *self._version, 0, 0])
        clock = struct.pack("<QHB4B", _CLOCK_HZ, _DATA_PORT, 0, 0, 0, 0, 0)
        return _message(_SERVER_INFO, name + versions + clock)

    def _models(self) -> bytes:
        parts = [struct.pack("<I", len(self._names))]
        for number, name in enumerate(self._names, start=1):
            model = name.encode() + b"\0" + struct.pack("<II3fI", number, 0xFFFFFFFF, 0.0, 0.0, 0.0, 0)
            parts += [struct.pack("<I", _RIGID_BODY), self._size(model), model]
        return _message(_MODELS, b"".join(parts))

    def _frame(self, bodies: Sequence[Pose | None], now: float) -> bytes:
        records = [
            struct.pack("<I3f4ffH", number, *place, *np.roll(turn, -1), 0.0002, int(body is not None))
            for number, body in enumerate(bodies, start=1)
            for place, turn in [body or _NOWHERE]
        ]
        exposed, sent = int(now * _CLOCK_HZ), int((now + self._latency) * _CLOCK_HZ)
        sections: list[Iterable[bytes]] = [[], [], records, [], *([[]] if self._sized else []), [], [], []]
        suffix = struct.pack("<IId3QH", 0, 0, now, exposed, sent, sent, 0) + bytes(4)
        return _message(
            _FRAME, struct.pack("<I", self._number) + b"".join(map(self._section, sections)) + suffix
        )

    def _section(self, records: Iterable[bytes]) -> bytes:
        """A section of a frame: the number of records, from 4.1 on their size, and the records."""
        records = list(records)
        content = b"".join(records)
        return struct.pack("<I", len(records)) + self._size(content) + content

    def _size(self, content: bytes) -> bytes:
        return struct.pack("<I", len(content)) if self._sized else b""

    @property
    def _sized(self) -> bool:
        return self._version >= (4, 1)


def _message(kind: int, content: bytes) -> bytes:
    return struct.pack("<HH", kind, len(content)) + content
