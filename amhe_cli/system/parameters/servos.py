"""Position servos as they are built: firmware, supply and motor, of which MuJoCo knows a gain and a limit.

With the torque g (command - position) - kv dq that the model's servo alone would give, over its largest
torque F, both at the nominal supply, the torque is

    (F d V/V_0 - b dq) / (1 + s d^2)    while it is enabled, else 0.

The duty d is that share; 0 while its size is within g times the dead band, else at least the punch (the least
PWM), and at most 1. b is the motor's back-EMF K^2/R, which the limit of the duty does not hold. A supply with
the resistance R_s sags under the motor's current, and s is R_s/R: at standstill and full duty the motor gets
V_0 / (1 + s). V is the supply as a log has it, then without s.

The numbers of a servo are those of `<custom><numeric name="servo/ACTUATOR" data="..."/>` in its model.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.parameters.edits import Cells
from amhe_cli.system.parameters.numerics import Numerics

#: Numbers of a servo in their order, each with its value where nothing says otherwise.
OF_SERVO = {
    "punch": 0.0,  # share of the largest duty
    "dead_band": 0.0,  # [rad]
    "supply_sag": 0.0,  # s
    "back_emf": 0.0,  # b [N m s/rad]
    "supply": 0.0,  # V_0 [V]
}
#: What a log may say of a servo from instant to instant, by an actuator that amhe adds.
SIGNALS = ("voltage", "enabled")
SERVOS = Numerics("servo/", mujoco.mjtObj.mjOBJ_ACTUATOR, OF_SERVO, ("supply",))
#: The field that gives a servo its torque: the constant part of MuJoCo's affine bias.
BIAS = "actuator_biasprm"


def carrier(signal: str, actuator: str) -> str:
    """Name of the actuator without any force whose control is the voltage of a servo, or its enabling."""
    return f"amhe/{signal}/{actuator}"


@dataclass(frozen=True, eq=False)
class Servos:
    """The servos of a model that are more than a gain and a limit.

    Args:
        rows: Their actuators, shape (g,).
        at: Where the numbers of each are in the model's `numeric_data`, shape (g, 5).
    """

    model: mujoco.MjModel
    rows: IntArray
    at: IntArray

    @classmethod
    def of(cls, model: mujoco.MjModel, set_by_parameters: Collection[int] = ()) -> Servos | None:
        """Those of a model; None where there is none. Arguments as of `GearFriction.of`."""
        acting, every = SERVOS.acting(model, set_by_parameters), SERVOS.rows(model)
        told = {signal: {row for row in every if _carrier(model, row, signal) >= 0} for signal in SIGNALS}
        rows = sorted(set(acting).union(*told.values()))
        for row in rows:
            _check(model, row)
            rated = every[row][-1]
            if row in told["voltage"] and not (model.numeric_data[rated] or rated in set_by_parameters):
                raise ConfigError(
                    f"a signal has the voltage of {model.actuator(row).name!r}, and nothing says at which "
                    "voltage its forcerange holds: set its supply, by a parameter with prior_sd: 0"
                )
        return cls(model, np.array(rows), np.array([every[row] for row in rows])) if rows else None

    def unlimited(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """A copy of a model of this layout that leaves the limit of their torques to `law`."""
        model = copy.copy(model)
        model.actuator_forcelimited[self.rows] = 0
        return model

    @cached_property
    def places(self) -> IntArray:
        """Their actuators, places of position and velocity, and controls of command and `SIGNALS`.

        Shape (g, 6); -1 where the log has no such signal.
        """
        model, rows = self.model, self.rows
        joints = model.actuator_trnid[rows, 0]
        of_joints = rows, model.jnt_qposadr[joints], model.jnt_dofadr[joints], model.actuator_ctrladr[rows]
        told = ([_carrier(model, row, signal) for row in rows] for signal in SIGNALS)
        return np.column_stack([*of_joints, *told])

    @property
    def ratio(self) -> FloatArray:
        """Joint -> servo, shape (g,)."""
        return self.model.actuator_gear[self.model.actuator_outadr[self.rows], 0]

    def law(self, numbers: Callable[[str], FloatArray]) -> Callable[..., FloatArray]:
        """Of n simulations, their `BIAS` from positions (n, nq), velocities, controls and activations.

        Args:
            numbers: Name of a field of the model -> its numbers, shape (n or 1, ...).
        """
        model, rows = self.model, self.rows
        _, position, dofs, controls, *told = self.places.T
        ratio, state = self.ratio, model.actuator_actadr[rows]
        least, most = np.where(
            model.actuator_ctrllimited[controls, None] != 0,
            numbers("actuator_ctrlrange")[:, controls],
            [-np.inf, np.inf],
        ).transpose(2, 0, 1)
        gain, limit = numbers("actuator_gainprm")[:, rows, 0], numbers("actuator_forcerange")[:, rows, 1]
        _, by_position, by_speed = np.moveaxis(numbers(BIAS)[:, rows, :3], -1, 0)
        punch, band, sag, back_emf, supply = np.moveaxis(numbers("numeric_data")[:, self.at], -1, 0)
        volts, enabled = ([(i, at[i]) for i in np.flatnonzero(at >= 0)] for at in told)

        by_position, dead = by_position * ratio, gain * band
        filtered = np.flatnonzero(state >= 0)

        def bias(qpos: FloatArray, qvel: FloatArray, ctrl: FloatArray, act: FloatArray) -> FloatArray:
            speed = ratio * qvel[:, dofs]
            command = np.minimum(np.maximum(ctrl[:, controls], least), most)
            command[:, filtered] = act[:, state[filtered]]
            alone = gain * command + by_position * qpos[:, position] + by_speed * speed
            size = np.abs(alone)
            duty = np.copysign(np.minimum(np.maximum(size / limit, punch), 1.0) * (size > dead), alone)
            driven = limit * duty
            for i, at in volts:
                driven[:, i] *= ctrl[:, at] / supply[:, i]
            given = (driven - back_emf * speed) / (1.0 + sag * duty**2)
            for i, at in enabled:
                given[:, i] *= ctrl[:, at] != 0.0
            return given - alone

        return bias


def with_servos(
    model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, ctrl: FloatArray, act: FloatArray
) -> tuple[mujoco.MjModel, Callable[[int], None]]:
    """A copy of a model, and what gives its servos their torques in it at one of n instants.

    Args:
        qpos, qvel, ctrl, act: The instants, each (n, ...).
    """
    servos = Servos.of(model)
    if servos is None:
        return model, lambda instant: None
    free, rows = servos.unlimited(model), servos.rows
    biases = servos.law(lambda name: getattr(model, name)[None])(qpos, qvel, ctrl, act)

    def drive(instant: int) -> None:
        free.actuator_biasprm[rows, 0] = biases[instant]

    return free, drive


def servo_cells(model: mujoco.MjModel, row: int, word: str) -> list[Cells]:
    """A number of a servo that a target sets.

    Raises:
        ConfigError: The actuator is no position servo of a joint, or has no limit of its force.
    """
    _check(model, row)
    return SERVOS.cells(model, row, [word], model.actuator(row).name)


def _check(model: mujoco.MjModel, row: int) -> None:
    name, bias = model.actuator(row).name, model.actuator_biasprm[row]
    feedback = bias[1] or not model.actuator_gainprm[row, 0]  # a parameter may say that the torque is off
    if int(model.actuator_trntype[row]) != mujoco.mjtTrn.mjTRN_JOINT or bias[0] or not feedback:
        raise ConfigError(f"actuator {name!r} is no position servo of a joint: only these have a firmware")
    if not model.actuator_forcelimited[row]:
        raise ConfigError(f"actuator {name!r} needs a forcerange in the model: its torque at full duty")


def _carrier(model: mujoco.MjModel, row: int, signal: str) -> int:
    """Address of the control that a log's signal of a servo is; -1 where it has none."""
    added = mujoco.mj_name2id(model, SERVOS.kind, carrier(signal, model.actuator(row).name))
    return added if added < 0 else int(model.actuator_ctrladr[added])
