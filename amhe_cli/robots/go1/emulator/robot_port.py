"""The robot's UDP port: takes commands from whoever sent last, and answers there from the same socket."""

from __future__ import annotations

import errno
import heapq
import itertools
import socket

import numpy as np

from amhe_cli.core.errors import AmheError
from amhe_cli.robots.go1.emulator.faults import Dice, Faults
from amhe_cli.robots.go1.link import command, state, wire
from amhe_cli.robots.go1.link.command import MotorCommand
from amhe_cli.robots.go1.link.state import RobotState

_LARGEST = 2048
_HIGH_LEVEL = bytes(1087)


class PortError(AmheError):
    """A port cannot be opened."""


def bound(host: str, port: int, arguments: tuple[str, str] = ("port", "port")) -> socket.socket:
    """A non-blocking UDP socket.

    Args:
        host, port: Address to bind.
        arguments: What chooses the port here, and in the program that comes to it.

    Raises:
        PortError: Another program has the port, or this computer has no such address.
    """
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.setblocking(False)
    try:
        end.bind((host, port))
    except OSError as error:
        end.close()
        here, there = arguments
        other = f"; with another emulator there, give this one `{here}` and its `amhe run` the same `{there}`"
        advice = other if error.errno == errno.EADDRINUSE else ""
        raise PortError(f"port {port} of {host} cannot be had: {error.strerror or error}{advice}") from error
    return end


class RobotPort:
    """The robot's end of the protocol.

    Args:
        host, port: Address to bind.
        faults: What goes wrong on the way.
        crc: Form of the states' checksums.

    Attributes:
        command: The newest good command; before the first, one that does nothing in damping mode.
        accepted, rejected: Number of datagrams so far.
        undisturbed: Loss, duplicates, damage and delay have not begun.
        peer: The address that sent last; None: nobody yet.
    """

    def __init__(self, host: str, port: int, faults: Faults, crc: wire.CrcForm = "plain") -> None:
        self._socket = bound(host, port)
        self._crc: wire.CrcForm = crc
        self.cause(faults)
        self._waiting: list[tuple[float, int, bool, bytes]] = []
        self._order = itertools.count()
        self._received: list[MotorCommand] = []
        self.command = MotorCommand(wire.DAMPED)
        self.accepted = self.rejected = 0
        self.undisturbed = faults.after > -np.inf
        self.peer: tuple[str, int] | None = None

    @property
    def address(self) -> tuple[str, int]:
        """The address at which it listens."""
        return self._socket.getsockname()

    def cause(self, faults: Faults) -> None:
        """Replace the faults on the way from now on."""
        self._faults, self._dice = faults, Dice(faults, np.random.default_rng(1))

    def receive(self, now: float) -> list[MotorCommand]:
        """Good commands that have come by a time [s]."""
        while True:
            try:
                datagram, peer = self._socket.recvfrom(_LARGEST)
            except OSError:  # nothing more; or an earlier peer has gone
                break
            self.peer = peer
            self._delay(now, True, datagram)
        self._deliver(now)
        received, self._received = self._received, []
        return received

    def send(self, reported: RobotState, now: float) -> None:
        """Send a state to the last sender."""
        if self.peer is None:
            return
        self._delay(now, False, _HIGH_LEVEL if self._faults.high else state.encode(reported, self._crc))
        self._deliver(now)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _delay(self, now: float, inward: bool, datagram: bytes) -> None:
        copies, delay = [datagram], 0.0
        if not self.undisturbed:
            copies, delay = self._dice.copies(datagram, inward), self._faults.delay
        for copy in copies:
            heapq.heappush(self._waiting, (now + delay, next(self._order), inward, copy))

    def _deliver(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            _, _, inward, datagram = heapq.heappop(self._waiting)
            if inward:
                self._read(datagram)
            elif self.peer is not None:
                try:
                    self._socket.sendto(datagram, self.peer)
                except OSError:
                    self.peer = None

    def _read(self, datagram: bytes) -> None:
        try:
            self.command = command.decode(datagram)
        except wire.PacketError:
            self.rejected += 1
            return
        self.accepted += 1
        self._received.append(self.command)
