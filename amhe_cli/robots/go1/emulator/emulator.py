"""Robot, box and cameras by the clock: `amhe emulate`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from typing import Literal

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.log import Samples
from amhe_cli.core.rotations import exp, multiply, normalised, rotate, yaw_of
from amhe_cli.robots.go1.emulator.ports import Faults, Motive, RobotPort, bound
from amhe_cli.robots.go1.link.packets import SERVO, VELOCITY_OFF, CrcForm, MotorCommand, RobotState
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.poses.gate import NO_OFFSET, Offset, rigid_body
from amhe_cli.robots.go1.poses.sources import Pose, pose_datagram
from amhe_cli.robots.go1.tasks import Task

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
    if options.mocap == "natnet":
        return Motive(options.host, options.mocap_port, options.bodies)
    return _UdpCameras(options.host, options.mocap_port, options.bodies if options.mocap == "udp" else ())


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
