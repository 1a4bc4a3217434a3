"""Stand-ins for a Go1 and its cameras: a puppet, a stage, an emulator of its own, and a sender that spins."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.link import sender
from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    MotorCommand,
    RobotState,
    decode_command,
    encode_state,
)
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.poses.sources import pose_datagram

ROOT = Path(__file__).parents[3]


def slowed() -> int:
    """By how much an emulated robot is slowed down, for this machine to keep up with it: at least 3.

    On two cores on which ten million additions took 2.3 s, 3 was enough and 2 was not.
    """
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        sum(i for i in range(1_000_000))
        times.append(time.perf_counter() - begun)
    return int(np.clip(np.ceil(16.0 * min(times)), 3, 8))


#: `go1.slow` of robots that are emulated, and of what drives them.
SLOW = slowed()


@contextmanager
def repeating(period: float, action: Callable[[], object]) -> Iterator[None]:
    """Do something again and again in a thread, with a pause [s] between, until the block ends."""
    stop = threading.Event()

    def act() -> None:
        while not stop.wait(period):
            action()

    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def udp() -> socket.socket:
    """A socket of datagrams."""
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)


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
        self._socket = udp()
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]
        self.received: list[tuple[float, MotorCommand]] = []
        self.change: Callable[[RobotState], RobotState] = lambda sent: sent
        self.mangle: Callable[[bytes], bytes | None] = lambda packet: packet
        self._begun, self._peer, self._ticks = 0.0, None, 1
        self._joints, self._mode = np.array(FOLDED), DAMPED

    def __enter__(self) -> Puppet:
        self._begun = time.monotonic()
        self._serving = ExitStack()
        self._serving.enter_context(self._socket)
        self._serving.enter_context(repeating(0.0005, self._serve))
        return self

    def __exit__(self, *_: Any) -> None:
        self._serving.close()

    @property
    def idle(self) -> bool:
        """Whether all commands so far do nothing."""
        return all(
            got.kp.max() == got.kd.max() == np.abs(got.torque).max() == 0.0 for _, got in self.received
        )

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
        while True:
            try:
                datagram, self._peer = self._socket.recvfrom(2048)
            except OSError:
                break
            got = decode_command(datagram)
            self.received.append((time.monotonic(), got))
            self._mode = got.mode
            if got.kp.max() > 0:
                self._joints = np.array(got.position)
        done = int(1e3 * (time.monotonic() - self._begun))
        for tick in range(self._ticks, done):
            modes = np.full(12, self._mode)
            sent = self.change(replace(a_state(tick=tick, joints=self._joints), modes=modes))
            packet = self.mangle(encode_state(sent))
            if self._peer and packet is not None:
                self._socket.sendto(packet, self._peer)
        self._ticks = max(self._ticks, done)


def damps(got: MotorCommand) -> bool:
    """Whether a command only damps."""
    return got.kp.max() == 0.0 and got.kd.min() > 0.0


_WELL, _LONG = 50, 5.0


class SpinningSender(sender.Sender):
    """A sender that computes without a pause, much longer than it may, once it has sent for a while."""

    _driven = 0

    def _send(self, command: MotorCommand, now: float) -> None:
        super()._send(command, now)
        self._driven += command.kp.max() > 0.0
        end = time.monotonic() + _LONG
        while self._driven > _WELL and time.monotonic() < end:
            pass


def main() -> None:
    """Send as `sender.main`, by the one that spins."""
    sender.Sender = SpinningSender  # type: ignore[misc]
    sender.main()


#: A robot that lies somewhere, headed somewhere.
TRUNK = (np.array([2.0, -1.0, 0.09]), exp(np.array([0.0, 0.0, 0.7])))


def free_port() -> int:
    """A UDP port that nobody has."""
    with udp() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Stage:
    """Robot and box before cameras; use it as a context manager.

    Args:
        port: Where to send poses.
        box: Its place as the robot sees it [m].
        turn: Of the cameras' frame.
        names: Of trunk and box.
    """

    def __init__(
        self, port: int, box: tuple[float, float, float] = (0.6, 0.0, 0.15),
        turn: np.ndarray | None = None, names: tuple[str, str] = ("go1", "box"),
    ) -> None:  # fmt: skip
        self.trunk, self.silent = TRUNK, False
        self.off = 0
        floor = TRUNK[0] * [1.0, 1.0, 0.0]
        poses = [TRUNK, (floor + rotate(TRUNK[1], np.array(box)), TRUNK[1])]
        if turn is not None:
            poses = [(rotate(turn, place), multiply(turn, pose)) for place, pose in poses]
        self._bodies = list(zip(names, poses, strict=True))
        self._to, self._clock, self._client = ("127.0.0.1", port), Clock(), udp()

    def __enter__(self) -> Stage:
        self._sending = ExitStack()
        self._sending.enter_context(self._client)
        self._sending.enter_context(repeating(0.01, self._send))
        return self

    def __exit__(self, *_: object) -> None:
        self._sending.close()

    def move_box(self, by: tuple[float, float, float]) -> None:
        """In the cameras' frame [m]."""
        name, (place, turn) = self._bodies[1]
        self._bodies[1] = name, (place + by, turn)

    def shift_box(self, frames: int) -> None:
        """Show it 0.5 m off to the side in the next frames."""
        self.off = frames

    def _send(self) -> None:
        now = self._clock.now() - 77.0
        shift = np.array([0.0, 0.5, 0.0]) if self.off > 0 else np.zeros(3)
        self.off -= 1
        for number, (name, (true, pose)) in enumerate(self._bodies):
            if not self.silent:
                self._client.sendto(pose_datagram(name, now, true + number * shift, pose), self._to)


@dataclass
class Emulated:
    """Where an emulator in a process of its own is to be found."""

    port: int
    mocap_port: int
    process: subprocess.Popen[str]
    stderr: str = ""


@contextmanager
def emulating(*arguments: str) -> Iterator[Emulated]:
    """Run `amhe emulate` until the end of the block; its stderr is in `stderr` then."""
    command = [sys.executable, "-m", "amhe_cli", "emulate", "--port", "0"]
    if "--mocap-port" not in arguments:
        command += ["--mocap-port", "0"]
    with subprocess.Popen(
        [*command, *arguments], stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    ) as process:
        assert process.stderr is not None
        try:
            first = process.stderr.readline()
            ports = [int(port) for port in re.findall(r"127\.0\.0\.1:(\d+)", first)]
            assert ports, first
            emulated = Emulated(ports[0], ports[-1], process)
            yield emulated
            process.send_signal(signal.SIGINT)
            emulated.stderr = process.stderr.read()
            process.wait(10)
        finally:
            process.kill()
