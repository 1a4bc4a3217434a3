"""The identified position servos as actuator configurations of trainings, with their joints' numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.system.export.randomisation import Drawn, code, ends
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.servos import OF_SERVO, SERVOS

#: Poses that a joint's usual load is taken from, and the seed of their generator.
_POSES, _SEED = 200, 0
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_TEXT = '''

def identified_actuators(timestep: float = {timestep}):
    """Actuators with the identified numbers, {form}.

    They are the model's position servos; other actuators of it need a configuration of their own. A delay is
    drawn between its ends, in whole physics steps of `timestep` [s].
    """
    from {module} import {name}

    def steps(seconds):
        return round(seconds / timestep)

    return {opening}
{entries}
    {closing}
'''


@dataclass(frozen=True, slots=True)
class PositionServo:
    """A position servo at its joint, in SI units.

    Args:
        joint: Its joint.
        stiffness, damping: Its gains.
        effort: Its largest torque; None: it has no limit.
        armature, viscous: Numbers of the joint.
        friction: Dry friction of the joint; that of a gear under its usual load.
        delay: The shortest and the longest of its delays.
    """

    joint: str
    stiffness: float
    damping: float
    effort: float | None
    armature: float
    friction: float
    viscous: float
    delay: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Form:
    """How a tool writes actuators.

    Args:
        module, name: Where its configuration is imported from.
        braces: What stands around the entries.
        of: The arguments of one servo -> code; `delay` stands for its delay in steps.
        words: What the function returns, in words.
    """

    module: str
    name: str
    braces: str
    of: Callable[[PositionServo], dict[str, object]]
    words: str


def servos(draws: Drawn) -> list[PositionServo]:
    """The model's position servos on hinges and slides, under the estimate."""
    model, delays = draws.model, draws.system.edits.delays(draws.theta)
    friction, firmware, back_emf = _friction(model), SERVOS.rows(model), list(OF_SERVO).index("back_emf")
    found = []
    for row in _rows(model):
        gain, bias, gear = (
            model.actuator_gainprm[row, 0], model.actuator_biasprm[row], model.actuator_gear[row, 0],
        )  # fmt: skip
        joint = int(model.actuator_trnid[row, 0])
        dof = int(model.jnt_dofadr[joint])
        limited = model.actuator_forcelimited[row]
        lost_by_speed = model.numeric_data[firmware[row][back_emf]] if row in firmware else 0.0
        found.append(
            PositionServo(
                model.joint(joint).name,
                float(gain * gear**2),
                float((lost_by_speed - bias[2]) * gear**2),
                float(model.actuator_forcerange[row, 1] * abs(gear)) if limited else None,
                float(model.dof_armature[dof]),
                float(friction[dof]),
                float(np.ravel(model.dof_damping[dof])[0]),
                ends(delays[:, min(row, delays.shape[1] - 1)]),
            )
        )
    return found


def _rows(model: mujoco.MjModel) -> Iterator[int]:
    """Rows of the position servos whose joint is a hinge or a slide."""
    for row in np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT):
        gain = model.actuator_gainprm[row, 0]
        servo = gain and np.isclose(model.actuator_biasprm[row, 1], -gain)
        if servo and model.jnt_type[model.actuator_trnid[row, 0]] in _SINGLE:
            yield int(row)


def actuators_text(draws: Drawn, form: Form) -> str:
    """A function that returns the servos as the tool's configurations; empty where the model has none."""
    made = servos(draws)
    if not made:
        return ""
    opening, closing = form.braces
    entries = "\n".join(f"        {entry}" for entry in _entries(made, form))
    return _TEXT.format(
        timestep=draws.model.opt.timestep, form=form.words, module=form.module, name=form.name,
        opening=opening, entries=entries, closing=closing,
    )  # fmt: skip


def _entries(made: list[PositionServo], form: Form) -> Iterator[str]:
    for servo in made:
        values = {key: value for key, value in form.of(servo).items() if value is not None}
        given = ", ".join(f"{key}={_value(key, value)}" for key, value in values.items())
        key = f"{code(servo.joint)}: " if form.braces == "{}" else ""
        yield f"{key}{form.name}({given}),"


def _value(key: str, value: object) -> str:
    """A value as Python text with five digits; a delay as the steps that it lasts."""
    if isinstance(value, float):
        short = float(f"{value:.5g}")
        return f"steps({short})" if "delay" in key else repr(short)
    return code(value)


def _friction(model: mujoco.MjModel) -> FloatArray:
    """Dry friction of each degree of freedom; that of a gear as it is under gravity, motor against load."""
    friction = np.array(model.dof_frictionloss)
    gears = GearFriction.of(model)
    if gears is not None:
        load, numbers = usual_load(model)[gears.dofs], model.numeric_data[gears.at]
        friction[gears.dofs] += (numbers[:, 0] + numbers[:, 1]) * load
    return friction


def usual_load(model: mujoco.MjModel) -> FloatArray:
    """Median force of gravity at each degree of freedom over poses within the joints' ranges, (nv,)."""
    rng, data = np.random.default_rng(_SEED), mujoco.MjData(model)
    forces = np.zeros((_POSES, model.nv))
    single = np.flatnonzero(np.isin(model.jnt_type, _SINGLE))
    low, high = np.where(model.jnt_limited[single, None], model.jnt_range[single], (-np.pi, np.pi)).T
    for pose in forces:
        data.qpos[model.jnt_qposadr[single]] = rng.uniform(low, high)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        mujoco.mj_fwdVelocity(model, data)
        pose[:] = np.abs(data.qfrc_bias)
    return np.median(forces, axis=0)


def lost(draws: Drawn) -> list[str]:
    """Lines about what these configurations cannot say."""
    lines = []
    if SERVOS.acting(draws.model, ()):
        lines.append(
            "firmware of servos: punch, dead band and sag of supply are not in the actuators; back-EMF is "
            "in their damping, which counts against the effort limit there"
        )
    if GearFriction.of(draws.model) is None:
        return lines
    return [
        *lines,
        "friction of gears: constant in the actuators, as under the median load of gravity; it neither grows "
        "with load nor falls with speed (examples/gear_friction.py is a hook for MuJoCo that applies it)",
    ]
