"""Friction of gears in a loop of MuJoCo alone, which does not use what `amhe` identified of them."""

import numpy as np


class GearFriction:
    """hook = GearFriction(model); then, in the loop: hook(data); mujoco.mj_step(model, data)."""

    def __init__(self, model):
        self.model, gears = (
            model,
            [i for i in range(model.nnumeric) if model.numeric(i).name.startswith("gear_friction/")],
        )
        self.dofs = np.array([model.joint(model.numeric(i).name[14:]).dofadr[0] for i in gears], dtype=int)
        self.numbers = np.array([model.numeric(i).data for i in gears]).reshape(-1, 8).T
        self.dry = model.dof_frictionloss[self.dofs].copy()

    def __call__(self, data):
        k_m, k_e, f_s, v_s, a, k_ms, k_es, q = self.numbers
        d, holds = self.dofs, self.model.dof_frictionloss[self.dofs]
        motor, constraint = data.qfrc_actuator[d], data.qfrc_constraint[d]
        external = data.qfrc_smooth[d] - data.qfrc_damper[d] - motor  # all but the motor and friction
        external += np.sign(constraint) * np.maximum(
            np.abs(constraint) - holds, 0.0
        )  # what friction cannot hold is a contact
        slow = np.exp(-(np.abs(data.qvel[d] / v_s) ** a))
        friction = self.dry + np.abs(k_e * external - k_m * motor) + q * np.maximum(-motor * external, 0.0)
        self.model.dof_frictionloss[d] = friction + slow * (f_s + np.abs(k_es * external - k_ms * motor))
