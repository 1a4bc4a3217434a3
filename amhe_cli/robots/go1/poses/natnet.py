"""OptiTrack's Motive by the NatNet protocol (package `natnet`), unicast or multicast."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
import time
from typing import Any

import numpy as np

from amhe_cli.robots.go1.poses.source import PoseError, Sighting, sighting

#: Motive's command port.
PORT = 1510
#: Frequency of the clock of Motive's computer, as Windows has it [Hz].
_CLOCK_HZ = 1e7
_STEP = 0.002


class NatNet:
    """See `source.PoseSource`.

    Args:
        host: Host of Motive.
        port: Motive's command port.
        seconds: Longest wait for an answer [s].
        data_port: Port from which Motive sends frames, if not from its command port.
    """

    def __init__(self, host: str, port: int, seconds: float, data_port: int = 1511) -> None:
        self._host, self._port, self._seconds, self._data_port = host, port, seconds, data_port
        self._client: Any = None
        self._names: dict[int, str] = {}
        self._seen: list[Sighting] = []

    @property
    def about(self) -> str:
        """See `PoseSource`."""
        return f"natnet from {self._host}, ports {self._port} and {self._data_port}; NatNet is not signed"

    def connect(self) -> None:
        """See `PoseSource`."""
        try:
            from natnet import NatNetClient
        except ImportError:
            raise PoseError("`pose=natnet` needs the package natnet: pip install 'amhe[mocap]'") from None
        motive = _address(self._host)
        peers = {(motive, self._port), (motive, self._data_port)}
        self._client = _listening_to(peers, NatNetClient)(
            motive, _own_address(motive, self._port), command_port=self._port, use_multicast=False
        )
        self._client.on_data_description_received_event.handlers.append(self._describe)
        self._client.on_data_frame_received_event.handlers.append(self._frame)
        try:
            self._client.connect(self._seconds)
        except TimeoutError:
            raise PoseError(
                f"no Motive answers from {self._host}:{self._port}: check `pose_host`, and that Motive "
                "streams by unicast (Edit > Settings > Streaming)"
            ) from None
        except Exception as error:  # the package has errors of its own
            raise PoseError(f"no way to Motive on {self._host}:{self._port}: {error}") from error
        self._client.request_modeldef()

    def wait(self, seconds: float) -> list[Sighting]:
        """See `PoseSource`."""
        end = time.monotonic() + seconds
        while not self._seen and time.monotonic() < end:
            # a damaged datagram is left out
            with contextlib.suppress(struct.error, UnicodeDecodeError, OverflowError, MemoryError):
                self._client.update_sync()
            time.sleep(_STEP)
        seen, self._seen = self._seen, []
        return seen

    def close(self) -> None:
        """See `PoseSource`."""
        if self._client is not None:
            self._client.shutdown()

    def _describe(self, descriptions: Any) -> None:
        self._names = {body.id_num: body.name for body in descriptions.rigid_bodies}

    def _frame(self, frame: Any) -> None:
        suffix = frame.suffix
        exposed, sent = suffix.stamp_camera_mid_exposure, suffix.stamp_transmit
        age = (sent - exposed) / _CLOCK_HZ if exposed and sent and sent >= exposed else 0.0
        for body in frame.rigid_bodies:
            name = self._names.get(body.id_num)
            if name is None or body.tracking_valid is False:
                continue
            # NatNet's quaternions are x, y, z, w
            seen = sighting(name, body.pos, np.roll(body.rot, 1), suffix.timestamp, age)
            if seen:
                self._seen.append(seen)


class _PeerSocket(socket.socket):
    """A UDP socket that receives from some addresses and ports only; `bind` first."""

    peers: frozenset[tuple[str, int]] = frozenset()

    def recvfrom(self, bufsize: int, flags: int = 0) -> tuple[bytes, Any]:  # type: ignore[override]
        """Receive a datagram of one of them; those of others are dropped."""
        while True:
            datagram, sender = super().recvfrom(bufsize, flags)
            if sender in self.peers:
                return datagram, sender


def _listening_to(peers: set[tuple[str, int]], client: type) -> type:
    """A client of the package whose sockets are at its own address, and receive from these peers only.

    The package's own ones take datagrams from everybody, the one for data on every network of this computer.

    Raises:
        PoseError: This version of the package makes its sockets in another way.
    """
    if not callable(getattr(client, "_NatNetClient__create_socket", None)):
        raise PoseError("this version of natnet makes its sockets in another way; install natnet 0.3")

    class Client(client):
        def _NatNetClient__create_socket(self, address: str = "", port: int = 0) -> socket.socket:  # noqa: N802
            made = _PeerSocket(socket.AF_INET, socket.SOCK_DGRAM)
            made.peers = frozenset(peers)
            made.setblocking(False)
            made.bind((address or self.local_ip_address, port))
            return made

    return Client


def _address(host: str) -> str:
    """Address of a computer, as datagrams give it.

    Raises:
        PoseError: There is no such computer.
    """
    try:
        return socket.gethostbyname(host)
    except OSError as error:
        raise PoseError(f"no way to Motive on {host}: {error.strerror or error}") from error


def _own_address(host: str, port: int) -> str:
    """This computer's address in the network that another address is in."""
    if ipaddress.ip_address(host).is_loopback:
        return "127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((host, port))  # connecting a UDP socket sends nothing
        return probe.getsockname()[0]
