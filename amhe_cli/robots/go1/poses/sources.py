"""Sources of poses: OptiTrack's Motive (natnet), Vicon, VRPN and Qualisys (motioncapture), our own datagrams.

One of our UDP datagrams is one JSON object, of one body:

    {"body": "go1", "time": 12.345, "position": [x, y, z], "orientation": [w, x, y, z]}

`time` [s] is the sender's own clock, of the moment of exposure, and may be left out. Metres; z upward.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import math
import select
import socket
import struct
import time
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError

#: A body's position [m], shape (3,), and its orientation, a unit quaternion w, x, y, z, shape (4,).
Pose = tuple[FloatArray, FloatArray]


class PoseError(AmheError):
    """Poses do not come, or cannot be trusted."""


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One body at one instant, as the source reports it.

    Args:
        position: Position [m], shape (3,).
        orientation: Unit quaternion w, x, y, z, shape (4,).
        stamp: Time stamp on the source's own clock [s]; None: it gives none.
        age: Time from the exposure to the sending, as far as the source gives it [s].
    """

    body: str
    position: FloatArray
    orientation: FloatArray
    stamp: float | None = None
    age: float = 0.0


def sighting(
    body: str, position: object, orientation: object, stamp: float | None = None, age: float = 0.0
) -> Sighting | None:
    """A sighting of a valid pose; None for any other: sources mark lost bodies by NaN or 0.

    Raises:
        ValueError, TypeError, OverflowError: Position or orientation are no numbers that fit.
    """
    place = np.asarray(position, dtype=np.float64)
    turn = np.asarray(orientation, dtype=np.float64)
    if place.shape != (3,) or turn.shape != (4,):
        return None
    size = math.hypot(*turn.tolist())
    if not (np.isfinite(place).all() and 0.5 < size < 2.0 and math.isfinite(stamp or 0.0)):
        return None
    return Sighting(body, place, turn / size, stamp, age)


#: Motive's command port.
NATNET_PORT = 1510
#: Frequency of the clock of Motive's computer, as Windows has it [Hz].
_CLOCK_HZ = 1e7
_STEP = 0.002


class NatNet:
    """OptiTrack's Motive, by its own protocol.

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
        """Whom it listens to, in words."""
        return f"natnet from {self._host}, ports {self._port} and {self._data_port}; NatNet is not signed"

    def connect(self) -> None:
        """Reach the source; a PoseError says what to check where that fails."""
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
        """What was seen since the last call; waits for something, but no longer than this [s]."""
        end = time.monotonic() + seconds
        while not self._seen and time.monotonic() < end:
            # a damaged datagram is left out
            with contextlib.suppress(struct.error, UnicodeDecodeError, OverflowError, MemoryError):
                self._client.update_sync()
            time.sleep(_STEP)
        seen, self._seen = self._seen, []
        return seen

    def close(self) -> None:
        """Disconnect."""
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


UDP_PORT = 1512
_LARGEST = 2048


def pose_datagram(body: str, time: float, position: FloatArray, orientation: FloatArray) -> bytes:
    """The datagram that a sender sends."""
    content = {"body": body, "time": time, "position": list(position), "orientation": list(orientation)}
    return json.dumps(content).encode()


def read_pose(message: bytes) -> Sighting | None:
    """The sighting in a datagram; None: it holds none."""
    try:
        content = json.loads(message)
        stamp = content.get("time")
        stamp = None if stamp is None else float(stamp)
        return sighting(str(content["body"]), content["position"], content["orientation"], stamp)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        return None


class UdpPoses:
    """Our own datagrams: one JSON object of one body each.

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
        """Whom it listens to, in words."""
        who = self._named or "the first that sends"
        return f"udp on {self._where[0]}:{self._where[1]} from {who}, not signed"

    def connect(self) -> None:
        """Reach the source; a PoseError says what to check where that fails."""
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
        """What was seen since the last call; waits for something, but no longer than this [s]."""
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
            pose = read_pose(message)
            if pose:
                seen.append(pose)
                self._peer = self._peer or sender

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            self._socket.close()


#: The kinds that its package on PyPI was built with.
KINDS = ("vicon", "vrpn", "qualisys", "optitrack", "mock")


class MotionCapture:
    """Vicon, VRPN, Qualisys and others, by libmotioncapture.

    Args:
        kind: One of `KINDS`.
        host: Host of the system; for `mock`: what to mock, 'name(x,y,z,qw,qx,qy,qz);...'.
    """

    def __init__(self, kind: str, host: str) -> None:
        self._kind, self._host = kind, host
        self._client: Any = None

    @property
    def about(self) -> str:
        """Whom it listens to, in words."""
        return f"{self._kind} at {self._host}, by libmotioncapture, which checks no sender"

    def connect(self) -> None:
        """Reach the source; a PoseError says what to check where that fails."""
        try:
            import motioncapture  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise PoseError("`pose=motioncapture` needs: pip install 'amhe[mocap]'") from None
        mock = {"rigid_bodies": self._host, "frequency": "100"}
        settings = mock if self._kind == "mock" else {"hostname": self._host}
        self._client = motioncapture.connect(self._kind, settings)  # pyright: ignore[reportAttributeAccessIssue]
        if self._client is None:
            raise PoseError(
                f"this build of motioncapture knows no {self._kind!r}; there is: {', '.join(KINDS)}"
            )

    def wait(self, seconds: float) -> list[Sighting]:
        """What is in the next frame; waits for it, however long."""
        self._client.waitForNextFrame()
        found = []
        for name, body in dict(self._client.rigidBodies).items():
            turn = body.rotation
            one = sighting(name, body.position, (turn.w, turn.x, turn.y, turn.z))
            if one:
                found.append(one)
        return found

    def close(self) -> None:
        """Disconnect."""
        self._client = None


#: A source of poses. It lives in a process of its own: it may block, and may die.
PoseSource: TypeAlias = NatNet | UdpPoses | MotionCapture
