"""The UDP socket to the robot: packets out, states in as they arrive."""

from __future__ import annotations

import math
import select
import socket
from collections.abc import Iterator

import numpy as np

from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.command import MotorCommand, encode
from amhe_cli.robots.go1.link.wire import LinkError
from amhe_cli.robots.go1.settings import Go1Settings

#: Largest datagram, and the most that are read at one go: a flood does not hold packets up.
_LARGEST, _MOST = 2048, 1000


class RobotSocket:
    """A UDP socket for one address only; it ignores all others.

    Args:
        connected: The socket, see `connected`.
        clock: The program's clock.

    Attributes:
        refused: How often the other computer reported that no program listens there.
        empty: When there was nothing to read for the last time [s]: what is read next arrived later.
    """

    def __init__(self, connected: socket.socket, clock: Clock) -> None:
        self._socket, self._clock = connected, clock
        self.refused = 0
        self.empty = -math.inf

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

    def received(self, until: float) -> Iterator[tuple[bytes, float]]:
        """All datagrams that arrive until a time [s], each with the time at which it was read [s].

        The kernel's own stamps are not used: they are of a clock that may be set.
        """
        for _ in range(_MOST):
            now = self._clock.now()
            try:
                datagram = self._socket.recv(_LARGEST)
            except ConnectionRefusedError:
                self.refused += 1
            except OSError:
                self.empty = now
                if now >= until:
                    return
                select.select([self._socket], [], [], (until - now) * self._clock.slow)
            else:
                yield datagram, self._clock.now()


def connected(host: str, port: int) -> socket.socket:
    """A UDP socket for a robot's address.

    Raises:
        LinkError: There is no such host, or no way to it.
    """
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.connect((host, port))
    except OSError as error:
        opened.close()
        raise LinkError(f"no way to {host}:{port}: {error.strerror or error}") from error
    return opened


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
