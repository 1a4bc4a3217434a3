"""A Go1 and its cameras on loopback: the robot's own protocol with MuJoCo physics behind it, `amhe emulate`.

What can be made to go wrong is a fault, such as `loss=0.02,hot=10`.

The robot answers whoever sent last, from the same socket. Motive's clients send their request from their
command socket, get frames there, and repeat it within ten seconds. Frames come by the clock, never as an
answer: a client that answers frames would be answered for ever.
"""

from __future__ import annotations

import errno
import heapq
import itertools
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields, replace
from typing import Literal

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.errors import AmheError, ConfigError, one_of
from amhe_cli.core.log import Samples
from amhe_cli.core.rotations import exp, multiply, normalised, rotate, yaw_of
from amhe_cli.robots.go1.link.packets import (
    DAMPED,
    SERVO,
    VELOCITY_OFF,
    CrcForm,
    MotorCommand,
    PacketError,
    RobotState,
    decode_command,
    encode_state,
    pressing,
)
from amhe_cli.robots.go1.link.process import Clock, Opened
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.poses.gate import rigid_body
from amhe_cli.robots.go1.poses.sources import Pose, pose_datagram
from amhe_cli.robots.go1.settings import Go1Settings
from amhe_cli.robots.go1.tasks import Task


@dataclass(frozen=True, slots=True)
class Faults:
    """Shares from 0 to 1, delays [s], and when things happen [s after the motors were first driven].

    Args:
        loss, duplicate: Share of datagrams, either way.
        corrupt: Share of states that come damaged.
        delay: Delay of all datagrams, either way [s].
        after: Time at which these four begin; by default they act from the first datagram on.
        silence: States stop: the cable is pulled.
        stale: The robot's clock stands still.
        remote: Somebody presses L2 + B.
        hot, mode, battery, tilt, speed, power, nan: The robot reports this fault.
        mocap: Motion capture stops.
        frozen, frozen_box: The pose of trunk or box stays, and its times go on.
        swap: Trunk and box have each other's name; 1: from the start.
        yup: Motion capture has y upward; 1: from the start.
        high: The robot is in high-level mode; 1: from the start.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0
    delay: float = 0.0
    after: float = -np.inf
    silence: float = np.inf
    stale: float = np.inf
    remote: float = np.inf
    hot: float = np.inf
    mode: float = np.inf
    battery: float = np.inf
    tilt: float = np.inf
    speed: float = np.inf
    power: float = np.inf
    nan: float = np.inf
    mocap: float = np.inf
    frozen: float = np.inf
    frozen_box: float = np.inf
    swap: float = 0.0
    yup: float = 0.0
    high: float = 0.0

    def reported(self, state: RobotState, driven: float) -> RobotState:
        """The state that the robot reports, so long after its motors were first driven [s]."""
        for name, change in _TELLING.items():
            if driven >= getattr(self, name):
                state = change(state)
        return state


def parse_faults(text: str) -> Faults:
    """'loss=0.02,delay=5ms' as values; times in s, or with ms.

    Raises:
        ConfigError: An unknown name, or no number.
    """
    names = [entry.name for entry in fields(Faults)]
    given: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, value = part.partition("=")
        if name not in names:
            raise ConfigError(one_of("fault", name, names))
        try:
            given[name] = 1e-3 * float(value[:-2]) if value.endswith("ms") else float(value.removesuffix("s"))
        except ValueError:
            raise ConfigError(f"`fault` {part}: write {name}=NUMBER, such as {name}=0.5") from None
    return Faults(**given)


def _one(values: FloatArray, value: float) -> FloatArray:
    changed = np.array(values)
    changed[4] = value
    return changed


_TELLING: dict[str, Callable[[RobotState], RobotState]] = {
    "stale": lambda state: replace(state, tick=1),
    "remote": lambda state: replace(state, remote=pressing("L2", "B")),
    "hot": lambda state: replace(state, temperatures=_one(state.temperatures, 95.0)),
    "mode": lambda state: replace(state, modes=_one(state.modes.astype(float), 8.0).astype(int)),
    "battery": lambda state: replace(state, charge=4),
    "tilt": lambda state: replace(state, quaternion=np.array([np.cos(0.6), np.sin(0.6), 0.0, 0.0])),
    "speed": lambda state: replace(state, joint_rates=_one(state.joint_rates, 40.0)),
    "power": lambda state: replace(state, joint_rates=np.full(12, 7.0), torques=np.full(12, 12.0)),
    "nan": lambda state: replace(state, joints=_one(state.joints, np.nan)),
}


_LARGEST = 2048
_HIGH_LEVEL = bytes(1087)


def bound(host: str, port: int, arguments: tuple[str, str] = ("port", "port")) -> socket.socket:
    """A non-blocking UDP socket.

    Args:
        host, port: Address to bind.
        arguments: What chooses the port here, and in the program that comes to it.

    Raises:
        AmheError: Another program has the port, or this computer has no such address.
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
        raise AmheError(f"port {port} of {host} cannot be had: {error.strerror or error}{advice}") from error
    return end


class RobotPort:
    """The robot's end of the protocol.

    Args:
        host, port: Address to bind.
        faults: What goes wrong; `cause` replaces it.
        crc: Form of the states' checksums.

    Attributes:
        command: The newest good command; before the first, one that does nothing in damping mode.
        accepted, rejected: Number of datagrams so far.
        undisturbed: Loss, duplicates, damage and delay have not begun.
        peer: The address that sent last; None: nobody yet.
    """

    def __init__(self, host: str, port: int, faults: Faults, crc: CrcForm = "plain") -> None:
        self._socket = bound(host, port)
        self._crc: CrcForm = crc
        self.cause(faults)
        self._waiting: list[tuple[float, int, bool, bytes]] = []
        self._order = itertools.count()
        self._received: list[MotorCommand] = []
        self.command = MotorCommand(DAMPED)
        self.accepted = self.rejected = 0
        self.undisturbed = faults.after > -np.inf
        self.peer: tuple[str, int] | None = None

    @property
    def address(self) -> tuple[str, int]:
        """The address at which it listens."""
        return self._socket.getsockname()

    def cause(self, faults: Faults) -> None:
        """Replace the faults from now on."""
        self.faults, self._rng = faults, np.random.default_rng(1)

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
        self._delay(now, False, _HIGH_LEVEL if self.faults.high else encode_state(reported, self._crc))
        self._deliver(now)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _delay(self, now: float, inward: bool, datagram: bytes) -> None:
        copies, delay = [datagram], 0.0
        if not self.undisturbed:
            copies, delay = self._copies(datagram, inward), self.faults.delay
        for copy in copies:
            heapq.heappush(self._waiting, (now + delay, next(self._order), inward, copy))

    def _copies(self, datagram: bytes, inward: bool) -> list[bytes]:
        """What arrives of a datagram, by chance: nothing, itself, itself twice, or something else."""
        f = self.faults
        lost, doubled, damaged = self._rng.random(3)
        if lost < f.loss:
            return []
        if damaged < f.corrupt and not inward:
            position = int(self._rng.integers(3, 600))
            datagram = datagram[:position] + bytes([datagram[position] ^ 1]) + datagram[position + 1 :]
        return [datagram] * (2 if doubled < f.duplicate else 1)

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
            self.command = decode_command(datagram)
        except PacketError:
            self.rejected += 1
            return
        self.accepted += 1
        self._received.append(self.command)


#: Messages of NatNet.
_CONNECT, _SERVER_INFO, _REQUEST_MODELS, _MODELS, _FRAME, _KEEP_ALIVE = 0, 1, 4, 5, 7, 10
_FORGOTTEN = 10.0
#: Frequency of the clock of a frame's exposure and transmission [Hz]: that of Windows.
_CLOCK_HZ = 10_000_000
_DATA_PORT = 1511
_RIGID_BODY = 1
#: Time from exposure to transmission [s].
_LATENCY = 0.004
#: Pose of a body that is not seen.
_NOWHERE = np.zeros(3), np.zeros(4)


class Motive:
    """The emulated server.

    Args:
        host, port: Address to bind: the command port.
        names: Names of the rigid bodies; their ids count from 1.
    """

    def __init__(self, host: str, port: int, names: Sequence[str]) -> None:
        self._socket = bound(host, port, ("mocap_port", "pose_port"))
        self._names = list(names)
        self._clients: dict[tuple[str, int], float] = {}
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._number = 0

    @property
    def address(self) -> tuple[str, int]:
        """The address at which it listens."""
        return self._socket.getsockname()

    def serve(self, now: float) -> None:
        """Answer the requests of clients, and send them the frames that are due; `now` [s]."""
        self._listen(now)
        while self._waiting and self._waiting[0][0] <= now:
            self._transmit(self._waiting.popleft()[1], now)

    def show(self, bodies: Sequence[Pose | None], now: float) -> None:
        """Take a frame, exposed at a time [s], with bodies that are not seen as None; `serve` sends it."""
        self._number += 1
        self._waiting.append((now + _LATENCY, self._frame(bodies, now)))

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _listen(self, now: float) -> None:
        while True:
            try:
                message, client = self._socket.recvfrom(2048)
            except OSError:
                return
            kind = int.from_bytes(message[:2], "little") if len(message) >= 4 else -1
            if kind in (_CONNECT, _KEEP_ALIVE):
                self._clients[client] = now
            answer = {_CONNECT: self._server_info, _REQUEST_MODELS: self._models}.get(kind)
            if answer:
                self._send(answer(), client)

    def _transmit(self, frame: bytes, now: float) -> None:
        """Send to all clients that have sent a request lately."""
        for client, requested in list(self._clients.items()):
            if now - requested > _FORGOTTEN:
                del self._clients[client]
            else:
                self._send(frame, client)

    def _send(self, message: bytes, client: tuple[str, int]) -> None:
        try:
            self._socket.sendto(message, client)
        except OSError:
            self._clients.pop(client, None)

    def _server_info(self) -> bytes:
        name = b"amhe emulated Motive".ljust(256, b"\0")
        versions = bytes([3, 1, 0, 0, 4, 1, 0, 0])  # its own, and that of the protocol
        clock = struct.pack("<QHB4B", _CLOCK_HZ, _DATA_PORT, 0, 0, 0, 0, 0)
        return _message(_SERVER_INFO, name + versions + clock)

    def _models(self) -> bytes:
        parts = [struct.pack("<I", len(self._names))]
        for number, name in enumerate(self._names, start=1):
            model = name.encode() + b"\0" + struct.pack("<II3fI", number, 0xFFFFFFFF, 0.0, 0.0, 0.0, 0)
            parts += [struct.pack("<II", _RIGID_BODY, len(model)), model]
        return _message(_MODELS, b"".join(parts))

    def _frame(self, bodies: Sequence[Pose | None], now: float) -> bytes:
        records = [
            struct.pack("<I3f4ffH", number, *place, *np.roll(turn, -1), 0.0002, int(body is not None))
            for number, body in enumerate(bodies, start=1)
            for place, turn in [body or _NOWHERE]
        ]
        exposed, sent = int(now * _CLOCK_HZ), int((now + _LATENCY) * _CLOCK_HZ)
        sections: list[list[bytes]] = [[], [], records, [], [], [], [], []]
        suffix = struct.pack("<IId3QH", 0, 0, now, exposed, sent, sent, 0) + bytes(4)
        return _message(_FRAME, struct.pack("<I", self._number) + b"".join(map(_section, sections)) + suffix)


def _section(records: list[bytes]) -> bytes:
    """A section of a frame: the number of records, their size, and the records."""
    content = b"".join(records)
    return struct.pack("<II", len(records), len(content)) + content


def _message(kind: int, content: bytes) -> bytes:
    return struct.pack("<HH", kind, len(content)) + content


STEP = 0.001
#: Damping of a motor that is not driven [N m s/rad].
_IDLE = 0.3
#: Temperature of the motors [deg C], and charge of the battery [%]; faults have others.
_WARM, _CHARGE = 32.0, 85
#: A box that has moved so far has begun to be pushed [m]: from then on the task's clock runs.
_MOVED = 0.005
#: Height of the trunk from which a robot with folded legs is put down [m], and the time that it settles [s].
_DROP, _SETTLING = 0.07, 1.0
#: Joint angles of a lying robot: knees apart, the belly on the floor [rad].
_FOLDED = sealed(np.array([-0.34, 1.19, -2.81, 0.34, 1.19, -2.81] * 2))
_NONE = sealed(np.zeros(12))


class EmulatedBody(Plant):
    """One emulated robot, on its belly before its box, with motors in place of servos.

    The joints' own damping is removed: in the models it represents that of the motors, which is commanded
    here. Changes on the way are by place, or by time since the box first moved.

    Args:
        task: Gives the box, and what changes on the way.
        rng: Random generator of the sensors' noise.
    """

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        model = plant_model(task.box, timestep=STEP)
        super().__init__(model, task.changes, rng)
        model.actuator_ctrllimited[:] = 0  # motors have no limits but those of torque
        model.dof_damping[self._at.joints_v] = 0.0
        self._lie_down()
        self._box_start = self.state.box.position[:2]
        self._moving_since: float | None = None

    @property
    def task_time(self) -> float:
        """See `Plant`."""
        return 0.0 if self._moving_since is None else self.time - self._moving_since

    def obey(self, command: MotorCommand) -> tuple[RobotState, Samples]:
        """Advance by a millisecond under a command; the robot's state, and what the cameras saw.

        Raises:
            SimulationError: The simulation diverged.
        """
        live = command.mode == SERVO
        follows = live & (np.abs(command.position) < 1e6)
        damps = live & (np.abs(command.velocity) < VELOCITY_OFF)
        position = np.where(follows, command.position, 0.0)
        kd = np.where(damps, command.kd, 0.0 if live else _IDLE)
        forward = np.where(live, command.torque, 0.0) + np.where(damps, command.kd * command.velocity, 0.0)
        self._drive(forward, np.where(follows, command.kp, 0.0), kd)
        measured = self.advance(position, STEP)
        place = self._data.qpos[self._at.box][:2]
        if self._moving_since is None and np.hypot(*(place - self._box_start)) > _MOVED:
            self._moving_since = self.time
        return self._reported(command.mode, measured), measured

    def _lie_down(self) -> None:
        """Put the robot on its belly, legs folded, let it come to rest, and put it back at its start."""
        data, trunk = self._data, self._at.trunk
        start = np.array(data.qpos[trunk])
        data.qpos[trunk.start + 2] = _DROP
        data.qpos[self._at.joints] = _FOLDED
        self._drive(_NONE, _NONE, _NONE + _IDLE)
        mujoco.mj_step(self.model, data, round(_SETTLING / STEP))
        lying = data.qpos[trunk]
        back = exp(np.array([0.0, 0.0, yaw_of(start[3:]) - yaw_of(lying[3:])]))
        data.qpos[trunk] = (*start[:2], lying[2], *multiply(back, lying[3:]))
        data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, data)

    def _drive(self, torque: FloatArray, kp: FloatArray, kd: FloatArray) -> None:
        """Set the motors, each (12,): torque + kp (target - q) - kd dq, within the torque limits."""
        servos = self._at.servos
        self.model.actuator_gainprm[servos, 0] = kp
        self.model.actuator_biasprm[servos, :3] = np.stack((torque, -kp, -kd), axis=1)

    def _reported(self, mode: int, measured: Samples) -> RobotState:
        return RobotState(
            tick=round(1e3 * self.time),
            quaternion=normalised(self._data.qpos[self._at.trunk][3:]),
            gyro=measured["imu.angular_velocity"][1][-1],
            accelerometer=measured["imu.linear_acceleration"][1][-1],
            modes=np.full(12, mode),
            joints=measured["joints.position"][1][-1],
            joint_rates=measured["joints.velocity"][1][-1],
            torques=np.array(self._data.actuator_force[self._at.servos]),
            temperatures=np.full(12, _WARM),
            charge=_CHARGE,
        )


#: An emulator this far behind the clock [s] stops catching up, and from then on is slower than it reports.
_BEHIND = 0.1
#: What it leaves to others in each millisecond, even when it is late [s of the wall clock]. Linux stops a
#: process of real-time priority that never sleeps for 50 ms a second: a link takes that for the robot's end.
_BREATH = 1e-4
_Y_UP = exp(np.array([-0.5 * np.pi, 0.0, 0.0]))


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What is emulated, and on which ports.

    Args:
        task: The task whose box stands before the robot.
        host, port: Address of the robot; port 0: any that is free.
        mocap: Protocol of the cameras.
        mocap_port: natnet: port on which Motive listens, 0: any; udp: port to which datagrams are sent.
        faults: What goes wrong.
        seed: Seed of the sensors' noise.
        settings: Names and offsets of trunk and box, how slow it runs, and the states' checksums; commands
            are accepted with either form.
    """

    task: Task
    host: str = "127.0.0.1"
    port: int = 8007
    mocap: Literal["natnet", "udp", "none"] = "natnet"
    mocap_port: int = 1510
    faults: Faults = field(default_factory=Faults)
    seed: int = 0
    settings: Go1Settings = field(default_factory=Go1Settings)


class Emulator(Opened):
    """Robot, box and cameras, served until `stopped`; use it as a context manager.

    Args:
        options: What is emulated, and on which ports.
        on_command: Is called with every good command, and when it came [s of the emulator's clock].

    Attributes:
        body: The emulated robot and its box.
        lag: Total time by which the emulation has fallen behind the clock [s].
    """

    def __init__(
        self, options: EmulatorOptions, on_command: Callable[[float, MotorCommand], None] | None = None
    ) -> None:
        self._options, self._on_command = options, on_command
        self._clock = Clock(options.settings.slow)
        self._driven_since: float | None = None
        self._shown: list[Pose] = []
        self.lag = 0.0

    def _open(self, opening: ExitStack) -> None:
        o = self._options
        self._port = RobotPort(o.host, o.port, o.faults, o.settings.crc)
        opening.callback(self._port.close)
        self._cameras = _cameras(o)
        opening.callback(self._cameras.close)
        self.body = EmulatedBody(o.task, np.random.default_rng(o.seed))

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
        faults = self._port.faults
        self._port.undisturbed = driven < faults.after
        if driven < faults.silence:
            self._port.send(faults.reported(state, driven), now)
        self._cameras.serve(now)
        if len(measured["trunk.position"][0]) and driven < faults.mocap:
            seen, stays = _seen(measured, faults, self._options.settings), (faults.frozen, faults.frozen_box)
            for number, since in enumerate(stays):
                if driven >= since:
                    seen[number] = self._shown[number]
            self._shown = seen
            self._cameras.show(seen, now)


class _UdpCameras:
    """Cameras that send our own datagrams; nobody sees a body without a name."""

    address: tuple[str, int] | None = None

    def __init__(self, host: str, port: int, names: Sequence[str]) -> None:
        self._socket, self._to, self._names = bound(host, 0), (host, port), names

    def serve(self, now: float) -> None: ...

    def show(self, poses: list[Pose], now: float) -> None:
        for name, (position, orientation) in zip(self._names, poses, strict=False):
            with suppress(OSError):  # nobody listens yet
                self._socket.sendto(pose_datagram(name, now, position, orientation), self._to)

    def close(self) -> None:
        self._socket.close()


def _cameras(options: EmulatorOptions) -> _UdpCameras | Motive:
    names = options.settings.trunk, options.settings.box
    if options.mocap == "natnet":
        return Motive(options.host, options.mocap_port, names)
    return _UdpCameras(options.host, options.mocap_port, names if options.mocap == "udp" else ())


def _seen(measured: Samples, faults: Faults, settings: Go1Settings) -> list[Pose]:
    """Poses of what is named trunk and box, in the cameras' frame."""
    poses = [
        rigid_body((measured[f"{body}.position"][1][-1], measured[f"{body}.orientation"][1][-1]), offset)
        for body, offset in (("trunk", settings.trunk_offset), ("box", settings.box_offset))
    ]
    if faults.swap:
        poses.reverse()
    if faults.yup:
        poses = [(rotate(_Y_UP, position), multiply(_Y_UP, turn)) for position, turn in poses]
    return poses
