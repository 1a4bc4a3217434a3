"""States of a robot that all is well with."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    MotorCommand,
    RobotState,
    decode_command,
    encode_state,
)

#: Legs of a robot that lies, calves folded.
FOLDED = np.tile([0.0, 1.25, -2.75], 4)


def a_state(**changes: Any) -> RobotState:
    """A robot that stands still."""
    return replace(
        RobotState(
            tick=1, quaternion=np.array([1.0, 0, 0, 0]), gyro=np.zeros(3),
            accelerometer=np.array([0, 0, 9.81]), modes=np.full(12, SERVO),
            joints=np.array(HOME), joint_rates=np.zeros(12), torques=np.zeros(12),
            temperatures=np.full(12, 30.0), charge=80,
        ),
        **changes,
    )  # fmt: skip


class Puppet:
    """Answers the last sender with 1000 states a second; use it as a context manager.

    Attributes:
        received: (time [s], command), in order.
        change: Applied to every state that is sent.
        mangle: Applied to every datagram; None keeps it back.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self.received: list[tuple[float, MotorCommand]] = []
        self.change: Callable[[RobotState], RobotState] = lambda sent: sent
        self.mangle: Callable[[bytes], bytes | None] = lambda packet: packet
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> Puppet:
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def wait(self, test: Callable[[MotorCommand], bool], patience: float = 15.0) -> float:
        """When the first command of a kind came [s], from those that come from now on."""
        seen, end = len(self.received), time.monotonic() + patience
        while time.monotonic() < end:
            for when, got in self.received[seen:]:
                seen += 1
                if test(got):
                    return when
            time.sleep(0.001)
        raise AssertionError("the command never came")

    def _serve(self) -> None:
        begun, peer, joints, mode, ticks = time.monotonic(), None, np.array(FOLDED), DAMPED, 1
        while not self._stop.wait(0.0005):
            while True:
                try:
                    datagram, peer = self._socket.recvfrom(2048)
                except OSError:
                    break
                got = decode_command(datagram)
                self.received.append((time.monotonic(), got))
                mode = got.mode
                if got.kp.max() > 0:
                    joints = np.array(got.position)
            done = int(1e3 * (time.monotonic() - begun))
            for tick in range(ticks, done):
                sent = self.change(replace(a_state(tick=tick, joints=joints), modes=np.full(12, mode)))
                packet = self.mangle(encode_state(sent))
                if peer and packet is not None:
                    self._socket.sendto(packet, peer)
            ticks = max(ticks, done)


def damps(got: MotorCommand) -> bool:
    """Whether a command only damps."""
    return got.kp.max() == 0.0 and got.kd.min() > 0.0
