"""Unknowns of a drive: each is found in a log of a simulated robot that has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe

DT = 0.004
CHEAP = {
    "clips": {"count": 6, "length": [0.4, 0.8]},
    "identify": {"iterations": 12, "bootstrap": 0, "profile_points": 0},
}
NOISE = 0.001


def arm(servo: str = '<position name="{0}" joint="{0}" kp="8" kv="0.3"/>', joint: str = "") -> str:
    """An arm of two joints; `servo` is each joint's actuator, `joint` has further attributes."""
    return f"""
<mujoco>
  <option timestep="{DT}" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.05" armature="0.01" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.5"/>
      <body name="lower" pos="0 0 -0.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01" {joint}/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>{servo.format("shoulder")}{servo.format("elbow")}</actuator>
</mujoco>"""


def played(
    model: mujoco.MjModel, size: float, late: Sequence[int] = (0, 0), seconds: float = 6.0
) -> dict[str, Any]:
    """A log of a model under steps of its two commands, which act some steps late."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    steps = round(seconds / DT)
    commands = np.repeat(rng.uniform(-size, size, (steps // 50 + 1, 2)), 50, axis=0)[:steps]
    angles = np.empty((steps, 2))
    for step in range(steps):
        angles[step] = data.qpos
        for joint in (0, 1):
            data.ctrl[joint] = commands[max(0, step - late[joint]), joint]
        mujoco.mj_step(model, data)
    time = DT * np.arange(steps)
    return {
        "joints": {"time": time, "position": angles + NOISE * rng.normal(size=angles.shape)},
        "command": {"time": time, "value": commands},
    }


def found(model: str, parameters: dict[str, Any], log: dict[str, Any]) -> amhe.Result:
    """The result of identifying parameters from a log of the arm."""
    signals = {
        "joints": {"joints": ["shoulder", "elbow"], "noise": {"position": NOISE}},
        "command": {"actuators": ["shoulder", "elbow"], "quantity": "value"},
    }
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(model), parameters=parameters, signals=signals, settings=CHEAP, name="arm"
    )
    return amhe.identify(system, amhe.Log.from_arrays(log, system), threads=1)


def close(result: amhe.Result, **truth: float) -> None:
    """Every parameter lies within 3.5 sd of its truth, and is known well."""
    for name, value in truth.items():
        one = result.parameters[name]
        assert abs(one.estimate - value) < 3.5 * one.sd, (name, one.estimate, one.sd)
        assert one.shrinkage > 0.8, (name, one.shrinkage)


def test_each_drive_has_its_own_delay() -> None:
    def delay(actuator: str) -> dict[str, Any]:
        target = {"actuator": actuator, "set": "command_delay"}
        return {"nominal": 0.01, "bounds": [0.0, 0.06], "prior_sd": 0.01, "targets": [target]}

    log = played(mujoco.MjModel.from_xml_string(arm()), 0.8, late=(3, 9))
    result = found(arm(), {"shoulder": delay("shoulder"), "elbow": delay("elbow")}, log)
    close(result, shoulder=3 * DT, elbow=9 * DT)


def unknown(nominal: float, **target: str) -> dict[str, Any]:
    return {"nominal": nominal, "targets": [target]}


def test_drag_that_grows_with_speed_is_found() -> None:
    truth = arm().replace('damping="0.05"', 'damping="0.05 0.06"')
    log = played(mujoco.MjModel.from_xml_string(truth), 1.5)
    found_ = found(arm(), {"drag": unknown(0.03, joint="*", set="damping_quadratic")}, log)
    close(found_, drag=0.06)
    assert found_.parameters["drag"].unit == "N m s^2/rad^2"
    model = found_.model()
    assert model.dof_dampingpoly[:, 0] == pytest.approx(0.06, rel=0.1)


def test_the_constants_of_a_dc_motor_are_found_from_its_voltage() -> None:
    """Torque per volt and braking by the back-EMF tell the motor's constant from its resistance."""
    motor = '<dcmotor name="{0}" joint="{0}" motorconst="%g" resistance="%g"/>'
    log = played(mujoco.MjModel.from_xml_string(arm(motor % (0.5, 2.0))), 6.0)
    result = found(
        arm(motor % (0.4, 2.5)),
        {
            "constant": unknown(0.4, actuator="*", set="motor_constant"),
            "resistance": unknown(2.5, actuator="*", set="resistance"),
        },
        log,
    )
    close(result, constant=0.5, resistance=2.0)


def test_a_torque_constant_is_the_gain_of_a_motor_whose_commands_are_currents() -> None:
    motor = '<motor name="{0}" joint="{0}" gear="%g"/>'
    log = played(mujoco.MjModel.from_xml_string(arm(motor % 0.8)), 2.0)
    target = {"actuator": "*", "set": "gain"}
    result = found(arm(motor % 1.0), {"constant": {"unit": "N m/A", "targets": [target]}}, log)
    close(result, constant=0.8)
