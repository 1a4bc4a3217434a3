"""The emulated robot without its network: a command goes in, a millisecond passes, a state comes out."""

from __future__ import annotations

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.samples import Samples
from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.command import MotorCommand
from amhe_cli.robots.go1.link.state import RobotState
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.motor_plant import MotorPlant
from amhe_cli.robots.go1.state import State
from amhe_cli.robots.go1.tasks import Task

STEP = 0.001
#: Damping of a motor that is not driven [N m s/rad].
_IDLE = 0.3
#: Temperature of the motors [deg C], and charge of the battery [%]; faults have others.
_WARM, _CHARGE = 32.0, 85
#: Foot sensors give so many counts per newton, and have a zero of their own.
_PER_NEWTON, _ZERO = 1.2, np.array([12.0, -7.0, 20.0, 3.0])
#: A box that has moved so far has begun to be pushed [m]: from then on the task's clock runs.
_MOVED = 0.005
_SERIAL, _VERSION = (0x0304, 0), (0x00010205, 0)
_AT_REST = np.zeros(12)


class EmulatedBody:
    """One emulated robot and its box.

    Args:
        task: Gives the box, and what changes on the way: by place, or by time since the box first moved.
        rng: Random generator of the sensors' noise.
    """

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        self._plant = MotorPlant(plant_model(task.box, timestep=STEP), rng)
        self._plant.lie_down()
        self._pending = list(task.changes)
        self._box_start = self._plant.state.box.position[:2]
        self._moving_since: float | None = None
        self._modes = np.full(12, wire.DAMPED)

    @property
    def time(self) -> float:
        """Time since the robot was switched on [s]."""
        return self._plant.time

    @property
    def parameters(self) -> dict[str, float]:
        """The box's true numbers, by name."""
        return self._plant.parameters

    @property
    def state(self) -> State:
        """True state of robot and box."""
        return self._plant.state

    @property
    def contacts(self) -> FloatArray:
        """Forces between touching bodies, for pictures; see `engine.contacts`."""
        return self._plant.contacts

    @property
    def trunk_height(self) -> float:
        """Height of the trunk over the floor [m]."""
        return float(self._plant.state.trunk.position[2])

    def advance(self, command: MotorCommand) -> tuple[RobotState, Samples]:
        """Advance by a millisecond under a command; the robot's state, and what the cameras saw.

        Raises:
            SimulationError: The simulation diverged.
        """
        position = self._drive(command)
        measured = self._plant.advance(position, STEP)
        torques = self._plant.torques
        self._change_what_is_due()
        return self._state(measured, torques), measured

    def _drive(self, command: MotorCommand) -> FloatArray:
        self._modes = np.full(12, command.mode)
        live = self._modes == wire.SERVO
        follows = live & (np.abs(command.position) < 1e6)
        damps = live & (np.abs(command.velocity) < wire.VELOCITY_OFF)
        position = np.where(follows, command.position, 0.0)
        kd = np.where(damps, command.kd, np.where(live, 0.0, _IDLE))
        forward = np.where(live, command.torque, 0.0) + np.where(damps, command.kd * command.velocity, 0.0)
        self._plant.drive(position, forward, np.where(follows, command.kp, 0.0), kd)
        return position

    def _change_what_is_due(self) -> None:
        if not self._pending:
            return
        place = self._plant.state.box.position[:2]
        if self._moving_since is None and np.hypot(*(place - self._box_start)) > _MOVED:
            self._moving_since = self.time
        pushed = 0.0 if self._moving_since is None else self.time - self._moving_since
        for change in [change for change in self._pending if change.due(pushed, float(place[0]))]:
            change.apply(self._plant.model)
            self._pending.remove(change)

    def _state(self, measured: Samples, torques: FloatArray) -> RobotState:
        truth = self._plant.state
        return RobotState(
            tick=round(1e3 * self.time),
            quaternion=rotations.normalised(truth.trunk.orientation),
            gyro=measured["imu.angular_velocity"][1][-1],
            accelerometer=measured["imu.linear_acceleration"][1][-1],
            modes=self._modes,
            joints=measured["joints.position"][1][-1],
            joint_rates=measured["joints.velocity"][1][-1],
            torques=torques,
            temperatures=np.full(12, _WARM),
            foot_force=_ZERO + _PER_NEWTON * self._plant.foot_forces,
            charge=_CHARGE,
            serial=_SERIAL,
            version=_VERSION,
        )
