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
    """

    def __init__(self, host: str, port: int) -> None:
        self._where = (host, port)
        self._socket: socket.socket | None = None

    def connect(self) -> None:
        """See `PoseSource`."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(self._where)
        except OSError as error:
            host, port = self._where
            raise PoseError(f"cannot listen for poses on {host}:{port}: {error.strerror or error}") from error
        self._socket.setblocking(False)

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`."""
        assert self._socket is not None
        select.select([self._socket], [], [], seconds)
        seen = []
        while True:
            try:
                message = self._socket.recv(_LARGEST)
            except OSError:
                return seen
            one = read(message)
            if one:
                seen.append(one)

    def close(self) -> None:
        """See `PoseSource`."""
        if self._socket is not None:
            self._socket.close()
