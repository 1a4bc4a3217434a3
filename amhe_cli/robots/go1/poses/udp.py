"""Our own datagrams, for every source that no other protocol covers.

One UDP datagram is one JSON object, of one body:

    {"body": "go1", "time": 12.345, "position": [x, y, z], "orientation": [w, x, y, z]}

`time` [s] is the sender's own clock, of the moment of exposure, and may be left out. Metres; z upward.
"""

from __future__ import annotations

import json
import select
import socket

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

PORT = 1512
_LARGEST = 2048


def datagram(body: str, time: float, position: FloatArray, orientation: FloatArray) -> bytes:
    """The datagram that a sender sends."""
    content = {"body": body, "time": time, "position": list(position), "orientation": list(orientation)}
    return json.dumps(content).encode()


def read(message: bytes) -> Sighting | None:
    """The sighting in a datagram; None: it holds none."""
    try:
        content = json.loads(message)
        stamp = content.get("time")
        return sighting(
            str(content["body"]),
            content["position"],
            content["orientation"],
            None if stamp is None else float(stamp),
        )
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        return None


class UdpPoses:
    """See `source.PoseSource`.

    Args:
        host: Address of this computer to listen on.
        port: Port to listen on.
        peer: ADDRESS:PORT to take poses from; '': the first that sends one.
    """

    def __init__(self, host: str, port: int, peer: str = "") -> None:
        self._where, self._named = (host, port), peer
        self._peer: tuple[str, int] | None = None
        self._socket: socket.socket | None = None

    @property
    def about(self) -> str:
        """See `PoseSource`."""
        who = self._named or "the first that sends"
        return f"udp on {self._where[0]}:{self._where[1]} from {who}, not signed"

    def connect(self) -> None:
        """See `PoseSource`."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(self._where)
            if self._named:
                address, _, port = self._named.rpartition(":")
                self._peer = (socket.gethostbyname(address), int(port))
        except OSError as error:
            host, port = self._where
            raise PoseError(f"cannot listen for poses on {host}:{port}: {error.strerror or error}") from error
        except ValueError:
            raise PoseError(f"go1.poses.peer {self._named!r} is not of the form ADDRESS:PORT") from None
        self._socket.setblocking(False)

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`."""
        assert self._socket is not None
        select.select([self._socket], [], [], seconds)
        seen = []
        while True:
            try:
                message, sender = self._socket.recvfrom(_LARGEST)
            except OSError:
                return seen
            if self._peer not in (None, sender):
                continue
            pose = read(message)
            if pose:
                seen.append(pose)
                self._peer = self._peer or sender

    def close(self) -> None:
        """See `PoseSource`."""
        if self._socket is not None:
            self._socket.close()
