"""A plant whose joints are driven as a Go1's firmware drives them: gains and torques change by the packet."""

from __future__ import annotations

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import exp, multiply, yaw_of
from amhe_cli.robots.go1.kinematics import JOINTS, LEGS
from amhe_cli.robots.go1.model import layout
from amhe_cli.robots.go1.plant import Plant, SensorNoise

#: Height of the trunk from which a robot with folded legs is put down [m].
_DROP = 0.07
#: Damping of the motors while the robot sinks down [N m s/rad], and how long that takes [s].
_LIMP, _SETTLING = 0.3, 1.0
#: Joint angles of a lying robot: knees apart, the belly on the floor [rad].
_FOLDED = np.array([-0.34, 1.19, -2.81, 0.34, 1.19, -2.81] * 2)


class MotorPlant(Plant):
    """Like `Plant`, but with motors in place of servos, advanced by single time steps.

    The joints' own damping is removed: in the models it represents that of the motors, which is commanded
    here.

    Args:
        model: A model made by `plant_model`; it is changed.
        rng: Random generator of the sensors' noise.
        noise: Noise of the sensors.
    """

    def __init__(
        self, model: mujoco.MjModel, rng: np.random.Generator, noise: SensorNoise | None = None
    ) -> None:
        super().__init__(model, (), rng, noise or SensorNoise())
        model.actuator_ctrllimited[:] = 0  # motors have no limits but those of torque
        model.dof_damping[layout(model).joints_v] = 0.0
        self._leg_of = np.full(model.nbody, -1)
        self._leg_of[[model.joint(name).bodyid[0] for name in JOINTS]] = np.repeat(np.arange(len(LEGS)), 3)

    def lie_down(self) -> None:
        """Put the robot on its belly, legs folded, let it come to rest, and put it back at its start."""
        pose = np.array(self._data.qpos)
        pose[self._at.trunk][2] = _DROP
        pose[self._at.joints] = _FOLDED
        self._data.qpos[:] = pose
        start = np.array(self._data.qpos[self._at.trunk])
        self.drive(_NONE, _NONE, _NONE, _NONE + _LIMP)
        for _ in range(round(_SETTLING / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self._data)
        self._face(start)

    def _face(self, start: FloatArray) -> None:
        """Turn and move the robot over the floor to the place and the heading of a pose (7,)."""
        place, turn = self._data.qpos[self._at.trunk][:3], self._data.qpos[self._at.trunk][3:]
        back = exp(np.array([0.0, 0.0, yaw_of(start[3:]) - yaw_of(turn)]))
        self._data.qpos[self._at.trunk] = (*start[:2], place[2], *multiply(back, turn))
        self._data.qvel[:] = 0.0
        mujoco.mj_forward(self.model, self._data)

    def drive(self, position: FloatArray, torque: FloatArray, kp: FloatArray, kd: FloatArray) -> None:
        """Set the motors, each (12,): torque + kp (position - q) - kd dq, within the torque limits."""
        servos = self._at.servos
        self._data.ctrl[servos] = position
        self.model.actuator_gainprm[servos, 0] = kp
        self.model.actuator_biasprm[servos, 0] = torque
        self.model.actuator_biasprm[servos, 1] = -kp
        self.model.actuator_biasprm[servos, 2] = -kd

    @property
    def torques(self) -> FloatArray:
        """Torques of the motors [N m], shape (12,)."""
        return np.array(self._data.actuator_force[self._at.servos])

    @property
    def foot_forces(self) -> FloatArray:
        """Normal forces of floor or box on the legs [N], shape (4,)."""
        contact = self._data.contact
        # with elliptic cones the first of a contact's forces is the normal one
        rows = contact.efc_address
        legs = self._leg_of[self.model.geom_bodyid[contact.geom]].max(axis=1, initial=-1)
        touching = (rows >= 0) & (legs >= 0)
        forces = np.bincount(legs[touching], self._data.efc_force[rows[touching]], len(LEGS))
        return forces.astype(np.float64)


_NONE = np.zeros(12)
