"""Friction of gears in a loop of MuJoCo or mjlab, which do not use what `amhe` identified of them."""

import numpy as np


class GearFriction:
    """hook = GearFriction(model); then, in the loop: hook(data); mujoco.mj_step(model, data).

    Of many environments at once, with arrays (n, nv), it takes their model and what computes with its arrays:
    hook = GearFriction(env.sim.mj_model, env.sim.model, torch), and then hook(env.sim.data).
    """

    def __init__(self, model, batch=None, xp=np):
        self.model, self.xp = model if batch is None else batch, xp
        gears = [i for i in range(model.nnumeric) if "gear_friction/" in model.numeric(i).name]
        joints = [model.numeric(i).name.replace("gear_friction/", "") for i in gears]  # mjlab: robot/JOINT
        self.dofs = [int(model.joint(name).dofadr[0]) for name in joints]
        self.dry = 0.0 + self.model.dof_frictionloss[..., self.dofs]
        numbers = np.array([model.numeric(i).data for i in gears]).reshape(-1, 8).T
        self.numbers = xp.asarray(numbers, dtype=self.dry.dtype, device=self.dry.device)

    def __call__(self, data):
        k_m, k_e, f_s, v_s, a, k_ms, k_es, q = self.numbers
        d, holds = self.dofs, self.model.dof_frictionloss[..., self.dofs]
        motor, constraint = data.qfrc_actuator[..., d], data.qfrc_constraint[..., d]
        external = data.qfrc_smooth[..., d] - data.qfrc_damper[..., d] - motor  # all but motor and friction
        external += constraint - self.xp.clip(
            constraint, -holds, holds
        )  # what friction cannot hold: contacts
        slow = self.xp.exp(-(abs(data.qvel[..., d] / v_s) ** a))
        friction = self.dry + abs(k_e * external - k_m * motor) + slow * abs(k_es * external - k_ms * motor)
        friction += slow * f_s + q * self.xp.clip(-motor * external, 0.0, None)
        self.model.dof_frictionloss[..., d] = friction
