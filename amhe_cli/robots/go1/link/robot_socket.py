"""The UDP socket to the robot: packets out, states in with the time at which they arrived."""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Iterator

import numpy as np

from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.command import MotorCommand, encode
from amhe_cli.robots.go1.link.wire import LinkError
from amhe_cli.robots.go1.settings import Go1Settings

#: Linux stamps datagrams as they arrive, whenever the program reads them; Python has no name for the option.
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@qq")
_LARGEST = 2048


class RobotSocket:
    """A UDP socket for one address only; it ignores all others.

    Args:
        host, port: Address of the robot.
        clock: The program's clock.

    Attributes:
        refused: How often the other computer reported that no program listens there.

    Raises:
        LinkError: There is no such host.
    """

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self._clock = clock
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if sys.platform == "linux":
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            self._socket.connect((host, port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"no way to {host}:{port}: {error.strerror or error}") from error
        self.refused = 0

    def send(self, packet: bytes) -> bool:
        """Send a packet; False where the network did not take it."""
        try:
            self._socket.send(packet)
        except ConnectionRefusedError:
            self.refused += 1
            return False
        except OSError:
            return False
        return True

    def received(self) -> Iterator[tuple[bytes, float]]:
        """All datagrams that have arrived, each with its time of arrival [s]."""
        while True:
            try:
                datagram, extra, _, _ = self._socket.recvmsg(_LARGEST, 64)
            except ConnectionRefusedError:
                self.refused += 1
                continue
            except OSError:
                return
            yield datagram, self._arrival(extra)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _arrival(self, extra: list[tuple[int, int, bytes]]) -> float:
        for level, kind, value in extra:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(value) >= _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(value[: _TIMESPEC.size])
                return self._clock.from_wall(seconds + 1e-9 * nanoseconds)
        return self._clock.now()


def let_down(robot: RobotSocket, settings: Go1Settings, clock: Clock, least: float = 0.0) -> None:
    """Let the robot down without the state machine, after a failure.

    Damps the motors for `settings.damp_time`, but no shorter than `least` [s]; then commands them to do
    nothing.
    """
    period, end = 1.0 / settings.rate, clock.now() + max(settings.damp_time, least)
    damped = MotorCommand(velocity=np.zeros(12), kd=np.full(12, settings.damping))
    while clock.now() < end:
        robot.send(encode(damped, settings.crc))
        clock.sleep_until(clock.now() + period)
    robot.send(encode(MotorCommand(), settings.crc))
