"""Robot, box and cameras by the clock: `amhe emulate`."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.core.samples import Samples
from amhe_cli.robots.go1.emulator.body import STEP, EmulatedBody
from amhe_cli.robots.go1.emulator.faults import Faults
from amhe_cli.robots.go1.emulator.motive import Motive
from amhe_cli.robots.go1.emulator.robot_port import RobotPort, bound
from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.command import MotorCommand
from amhe_cli.robots.go1.link.wire import CrcForm
from amhe_cli.robots.go1.poses import udp
from amhe_cli.robots.go1.poses.frame import NO_OFFSET, Offset, rigid_body
from amhe_cli.robots.go1.poses.source import Pose
from amhe_cli.robots.go1.tasks import Task

#: An emulator this far behind the clock [s] stops catching up, and from then on is slower than it reports.
_BEHIND = 0.1
#: What it leaves to others in each millisecond, even when it is late [s of the wall clock]. Linux stops a
#: process of real-time priority that never sleeps for 50 ms a second: a link takes that for the robot's end.
_BREATH = 1e-4
_Y_UP = exp(np.array([-0.5 * np.pi, 0.0, 0.0]))

#: Called with every good command, and when it came [s of the emulator's clock].
OnCommand = Callable[[float, MotorCommand], None]


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What is emulated, and on which ports.

    Args:
        task: The task whose box stands before the robot.
        host, port: Address of the robot; port 0: any that is free.
        mocap: Protocol of the cameras.
        mocap_port: natnet: port on which Motive listens, 0: any; udp: port to which datagrams are sent.
        faults: What goes wrong.
        slow: How many times slower than the wall clock the emulation runs.
        seed: Seed of the sensors' noise.
        bodies: Names of trunk and box.
        offsets: Offsets of both in their rigid bodies, as `go1.trunk_offset` and `go1.box_offset`.
        crc: Form of the states' checksums; commands are accepted with either.
    """

    task: Task
    host: str = "127.0.0.1"
    port: int = 8007
    mocap: Literal["natnet", "udp", "none"] = "natnet"
    mocap_port: int = 1510
    faults: Faults = field(default_factory=Faults)
    slow: float = 1.0
    seed: int = 0
    bodies: tuple[str, str] = ("go1", "box")
    offsets: tuple[Offset, Offset] = (NO_OFFSET, NO_OFFSET)
    crc: CrcForm = "plain"


class Emulator:
    """Robot, box and cameras, served until `stopped`; use it as a context manager.

    Args:
        options: What is emulated, and on which ports.
        on_command: Is called with each command.

    Attributes:
        body: The emulated robot and its box.
        lag: Total time by which the emulation has fallen behind the clock [s].
    """

    def __init__(self, options: EmulatorOptions, on_command: OnCommand | None = None) -> None:
        o, self._faults = options, options.faults
        self._clock, self._on_command = Clock(o.slow), on_command
        self._offsets = o.offsets
        self._driven_since: float | None = None
        self._shown: list[Pose] = []
        self.lag = 0.0
        with ExitStack() as opening:  # a port is given back where a later step fails
            self._port = opening.enter_context(closing(RobotPort(o.host, o.port, o.faults, o.crc)))
            self._cameras = opening.enter_context(closing(_cameras(o)))
            self.body = EmulatedBody(o.task, np.random.default_rng(o.seed))
            self._opened = opening.pop_all()

    def __enter__(self) -> Emulator:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    @property
    def address(self) -> tuple[str, int]:
        """Address of the robot."""
        return self._port.address

    @property
    def mocap_address(self) -> tuple[str, int] | None:
        """Address of the cameras; None: nobody listens there."""
        return self._cameras.address

    @property
    def counts(self) -> tuple[int, int]:
        """Commands accepted and datagrams rejected, so far."""
        return self._port.accepted, self._port.rejected

    def cause(self, faults: Faults) -> None:
        """Replace the faults from now on."""
        self._faults = faults
        self._port.cause(faults)

    def serve(self, stopped: Callable[[], bool]) -> None:
        """Emulate millisecond by millisecond until `stopped`.

        Raises:
            SimulationError: The simulation diverged.
        """
        offset = self._clock.now() - self.body.time
        while not stopped():
            due = offset + self.body.time + STEP
            late = self._clock.now() - due
            if late > _BEHIND:
                offset += late
                self.lag += late
            if late > 0.0:
                time.sleep(_BREATH)
            self._clock.sleep_until(due)
            self._millisecond()

    def _millisecond(self) -> None:
        now = self._clock.now()
        for received in self._port.receive(now):
            if self._on_command:
                self._on_command(now, received)
            if self._driven_since is None and received.kp.max() > 0.0:
                self._driven_since = self.body.time
        state, measured = self.body.obey(self._port.command)
        driven = -1.0 if self._driven_since is None else self.body.time - self._driven_since
        faults = self._faults
        self._port.undisturbed = driven < faults.after
        if driven >= faults.stale:
            state = replace(state, tick=1)
        if driven < faults.silence:
            self._port.send(faults.reported(state, driven), now)
        self._cameras.serve(now)
        if len(measured["trunk.position"][0]) and driven < faults.mocap:
            seen, stays = _seen(measured, faults, self._offsets), (faults.frozen, faults.frozen_box)
            for number, since in enumerate(stays):
                if driven >= since:
                    seen[number] = self._shown[number]
            self._shown = seen
            self._cameras.show(seen, now)


class _Cameras:
    """Cameras without a protocol: nobody sees their frames."""

    address: tuple[str, int] | None = None

    def serve(self, now: float) -> None: ...

    def show(self, poses: list[Pose], now: float) -> None: ...

    def close(self) -> None: ...


class _UdpCameras(_Cameras):
    def __init__(self, options: EmulatorOptions) -> None:
        self._socket = bound(options.host, 0)
        self._to, self._names = (options.host, options.mocap_port), options.bodies

    def show(self, poses: list[Pose], now: float) -> None:
        for name, (position, orientation) in zip(self._names, poses, strict=True):
            try:
                self._socket.sendto(udp.datagram(name, now, position, orientation), self._to)
            except OSError:  # nobody listens yet
                return

    def close(self) -> None:
        self._socket.close()


def _cameras(options: EmulatorOptions) -> _Cameras | Motive:
    if options.mocap == "natnet":
        return Motive(options.host, options.mocap_port, options.bodies)
    return _UdpCameras(options) if options.mocap == "udp" else _Cameras()


def _seen(measured: Samples, faults: Faults, offsets: tuple[Offset, Offset]) -> list[Pose]:
    """Poses of what is named trunk and box, in the cameras' frame."""
    poses = [
        (measured[f"{body}.position"][1][-1], measured[f"{body}.orientation"][1][-1])
        for body in ("trunk", "box")
    ]
    poses = [rigid_body(pose, offset) for pose, offset in zip(poses, offsets, strict=True)]
    if faults.swap:
        poses.reverse()
    if faults.yup:
        poses = [(rotate(_Y_UP, position), multiply(_Y_UP, turn)) for position, turn in poses]
    return poses
