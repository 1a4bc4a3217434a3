"""Our own datagrams, for every source that no other protocol covers.

One UDP datagram is one JSON object, of one body:

    {"body": "go1", "time": 12.345, "position": [x, y, z], "orientation": [w, x, y, z]}

`time` [s] is the sender's own clock, of the moment of exposure, and may be left out. Metres; z upward.

With a shared key, a datagram is 32 bytes of HMAC-SHA256 over all that follows, a counter of 8 bytes, most
significant first, and the object. The counter of a body only grows: a datagram that is sent again is none.
"""

from __future__ import annotations

import hmac
import json
import select
import socket
from pathlib import Path

from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

PORT = 1512
_LARGEST = 2048
_TAG, _COUNTER = 32, 8
_SHORTEST_KEY = 16


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


def read_key(file: str) -> bytes:
    """The key in a file, without white space around it; empty where there is no file.

    Raises:
        PoseError: It cannot be read, or is too short.
    """
    if not file:
        return b""
    try:
        key = Path(file).read_bytes().strip()
    except OSError as error:
        raise PoseError(f"go1.poses.key {file}: {error.strerror}") from error
    if len(key) < _SHORTEST_KEY:
        raise PoseError(f"go1.poses.key {file}: {len(key)} bytes; a key has at least {_SHORTEST_KEY}")
    return key


def signed(message: bytes, key: bytes, counter: int) -> bytes:
    """A datagram with the signature of a key."""
    counted = counter.to_bytes(_COUNTER, "big") + message
    return hmac.digest(key, counted, "sha256") + counted


def unsigned(message: bytes, key: bytes) -> tuple[int, bytes] | None:
    """Counter and content of a signed datagram; None: it was not signed with the key."""
    tag, counted = message[:_TAG], message[_TAG:]
    if len(counted) < _COUNTER or not hmac.compare_digest(tag, hmac.digest(key, counted, "sha256")):
        return None
    return int.from_bytes(counted[:_COUNTER], "big"), counted[_COUNTER:]


class UdpPoses:
    """See `source.PoseSource`.

    Args:
        host: Address of this computer to listen on.
        port: Port to listen on.
        peer: ADDRESS:PORT to take poses from; '': the first that sends one, or all that have the key.
        key: File with the key; '': datagrams are not signed.
    """

    def __init__(self, host: str, port: int, peer: str = "", key: str = "") -> None:
        self._where, self._named, self._key_file = (host, port), peer, key
        self._key, self._counters = b"", dict[str, int]()
        self._peer: tuple[str, int] | None = None
        self._socket: socket.socket | None = None

    @property
    def about(self) -> str:
        """See `PoseSource`."""
        who = self._named or ("whoever has the key" if self._key_file else "the first that sends")
        signs = "signed" if self._key_file else "not signed (`go1.poses.key`)"
        return f"udp on {self._where[0]}:{self._where[1]} from {who}, {signs}"

    def connect(self) -> None:
        """See `PoseSource`."""
        self._key = read_key(self._key_file)
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
            one = self._read(message)
            if one:
                seen.append(one)
                self._peer = self._peer or (None if self._key else sender)

    def _read(self, message: bytes) -> Sighting | None:
        if not self._key:
            return read(message)
        counted = unsigned(message, self._key)
        one = read(counted[1]) if counted else None
        if counted is None or one is None or counted[0] <= self._counters.get(one.body, -1):
            return None
        self._counters[one.body] = counted[0]
        return one

    def close(self) -> None:
        """See `PoseSource`."""
        if self._socket is not None:
            self._socket.close()
