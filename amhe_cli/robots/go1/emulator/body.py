"""The emulated robot without its network: a command goes in, a millisecond passes, a state comes out."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.core.rotations import exp, multiply, normalised, yaw_of
from amhe_cli.core.samples import Samples
from amhe_cli.robots.go1.kinematics import JOINTS, LEGS
from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.command import MotorCommand
from amhe_cli.robots.go1.link.state import RobotState
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.plant import Plant
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
        self._leg_of = np.full(model.nbody, -1)
        self._leg_of[[model.joint(name).bodyid[0] for name in JOINTS]] = np.repeat(np.arange(len(LEGS)), 3)
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
        live = command.mode == wire.SERVO
        follows = live & (np.abs(command.position) < 1e6)
        damps = live & (np.abs(command.velocity) < wire.VELOCITY_OFF)
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
            foot_force=_ZERO + _PER_NEWTON * self._foot_forces(),
            charge=_CHARGE,
            serial=_SERIAL,
            version=_VERSION,
        )

    def _foot_forces(self) -> FloatArray:
        """Normal forces of floor or box on the legs [N], shape (4,)."""
        contact = self._data.contact
        rows = contact.efc_address  # with elliptic cones the first of a contact's forces is the normal one
        legs = self._leg_of[self.model.geom_bodyid[contact.geom]].max(axis=1, initial=-1)
        touching = (rows >= 0) & (legs >= 0)
        forces = np.bincount(legs[touching], self._data.efc_force[rows[touching]], len(LEGS))
        return forces.astype(np.float64)
