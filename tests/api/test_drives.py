"""Unknowns of a drive: each is found in a log of a simulated robot that has it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.system.model.gaps import add_gaps

DT = 0.004
CHEAP = {
    "clips": {"count": 6, "length": [0.4, 0.8]},
    "identify": {"iterations": 12, "assumed": 0},  # the logs are those of the model
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
    model: mujoco.MjModel,
    size: float,
    late: Sequence[int] = (0, 0),
    seconds: float = 6.0,
    seen: Sequence[str] = ("shoulder", "elbow"),
    seed: int = 0,
) -> dict[str, Any]:
    """A log of a model under steps of its two commands, which act some steps late."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    steps = round(seconds / DT)
    commands = np.repeat(rng.uniform(-size, size, (steps // 50 + 1, 2)), 50, axis=0)[:steps]
    commands[:25] = 0.0  # as every robot, it begins at rest
    angles, read = np.empty((steps, 2)), [model.joint(name).qposadr[0] for name in seen]
    for step in range(steps):
        angles[step] = data.qpos[read]
        for joint in (0, 1):
            data.ctrl[model.actuator_ctrladr[joint]] = commands[max(0, step - late[joint]), joint]
        mujoco.mj_step(model, data)
    time = DT * np.arange(steps)
    return {
        "joints": {"time": time, "position": angles + NOISE * rng.normal(size=angles.shape)},
        "command": {"time": time, "value": commands},
    }


def found(
    model: str | mujoco.MjSpec,
    parameters: dict[str, Any],
    *logs: dict[str, Any],
    joints: Sequence[str] = ("shoulder", "elbow"),
    **settings: Any,
) -> amhe.Result:
    """The result of identifying parameters from a log of the arm; of several, the first validates."""
    signals = {
        "joints": {"joints": [*joints], "noise": {"position": NOISE}},
        "command": {"actuators": ["shoulder", "elbow"], "quantity": "value"},
    }
    spec = mujoco.MjSpec.from_string(model) if isinstance(model, str) else model
    system = amhe.System.from_model(
        spec, parameters=parameters, signals=signals, settings={**CHEAP, **settings}, name="arm"
    )
    first, *more = [amhe.Log.from_arrays(log, system) for log in logs]
    return amhe.identify(system, more or first, held_out=first if more else None, threads=1)


def close(result: amhe.Result, **truth: float) -> None:
    """Every parameter lies within 3.5 sd of its truth, and is known well."""
    for name, value in truth.items():
        one = result.parameters[name]
        assert abs(one.estimate - value) < 3.5 * one.sd, (name, one.estimate, one.sd)
        assert one.shrinkage > 0.8, (name, one.shrinkage)


@pytest.mark.medium
def test_each_drive_has_its_own_delay() -> None:
    def delay(actuator: str) -> dict[str, Any]:
        target = {"actuator": actuator, "set": "command_delay"}
        return {"nominal": 0.01, "bounds": [0.0, 0.06], "prior_sd": 0.01, "targets": [target]}

    log = played(mujoco.MjModel.from_xml_string(arm()), 0.8, late=(3, 9))
    result = found(arm(), {"shoulder": delay("shoulder"), "elbow": delay("elbow")}, log)
    close(result, shoulder=3 * DT, elbow=9 * DT)


def unknown(nominal: float, **target: str) -> dict[str, Any]:
    return {"nominal": nominal, "targets": [target]}


@pytest.mark.medium
def test_drag_that_grows_with_speed_is_found() -> None:
    truth = arm().replace('damping="0.05"', 'damping="0.05 0.06"')
    log = played(mujoco.MjModel.from_xml_string(truth), 1.5)
    found_ = found(arm(), {"drag": unknown(0.03, joint="*", set="damping_quadratic")}, log)
    close(found_, drag=0.06)
    assert found_.parameters["drag"].unit == "N m s^2/rad^2"
    model = found_.model()
    assert model.dof_dampingpoly[:, 0] == pytest.approx(0.06, rel=0.1)


@pytest.mark.medium
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


LUGRE = '<dcmotor name="{0}" joint="{0}" motorconst="0.5" resistance="2" lugre="%g %g %g %g %g"/>'
PID = '<pid name="{0}" joint="{0}" kp="8" kv="0.3" %s/>'


def from_whole_logs(truth: str, start: str, size: float, **words: float) -> amhe.Result:
    """The result of logs that are one clip each: they begin with the states that no log has."""
    model, words_ = mujoco.MjModel.from_xml_string(truth), words.items()
    unknowns = {word: unknown(own, actuator="*", set=word) for word, own in words_}
    logs = [played(model, size, seconds=1.5, seed=seed) for seed in range(7)]
    return found(start, unknowns, *logs, clips={"length": [9.0, 9.0]})


@pytest.mark.medium
def test_the_stiction_of_a_dc_motor_is_found() -> None:
    """Friction falls from its static to its Coulomb value as the joint gets faster."""
    words = ("bristle_stiffness", "coulomb_friction", "static_friction", "stribeck_velocity")
    truth, start = (10.0, 0.15, 0.3, 0.2), (15.0, 0.1, 0.2, 0.3)
    true, wrong = (arm(LUGRE % (stiffness, 1.0, *others)) for stiffness, *others in (truth, start))
    result = from_whole_logs(true, wrong, 4.0, **dict(zip(words, start, strict=True)))
    close(result, **dict(zip(words, truth, strict=True)))


@pytest.mark.medium
def test_the_damping_of_a_dc_motors_bristles_is_found() -> None:
    true, wrong = (arm(LUGRE % (10.0, damping, 0.15, 0.3, 0.2)) for damping in (2.0, 1.0))
    close(from_whole_logs(true, wrong, 4.0, bristle_damping=1.0), bristle_damping=2.0)


@pytest.mark.medium
def test_the_limit_of_a_dc_motors_current_is_found() -> None:
    """MuJoCo keeps it as the torque K i."""
    motor = '<dcmotor name="{0}" joint="{0}" motorconst="0.5" resistance="2" saturation="0 %g"/>'
    log = played(mujoco.MjModel.from_xml_string(arm(motor % 1.2)), 6.0)
    target = {"limit": unknown(0.5 * 2.0, actuator="*", set="force_limit")}
    close(found(arm(motor % 2.0), target, log), limit=0.5 * 1.2)


@pytest.mark.medium
def test_the_limited_slew_of_a_pid_is_found() -> None:
    result = from_whole_logs(arm(PID % 'slewmax="3"'), arm(PID % 'slewmax="4"'), 0.8, slew_limit=4.0)
    close(result, slew_limit=3.0)


@pytest.mark.medium
def test_the_terms_of_a_pid_are_found_where_the_log_begins_with_its_integral() -> None:
    result = from_whole_logs(
        arm(PID % 'ki="20" imax="0.06"'),
        arm((PID % 'ki="30" imax="0.09"').replace('"8"', '"10"').replace('"0.3"', '"0.2"')),
        0.8,
        gain=10.0,
        actuator_damping=0.2,
        integral_gain=30.0,
        integral_limit=0.09,
    )
    close(result, gain=8.0, actuator_damping=0.3, integral_gain=20.0, integral_limit=0.06)


@pytest.mark.medium
def test_a_torque_constant_is_the_gain_of_a_motor_whose_commands_are_currents() -> None:
    motor = '<motor name="{0}" joint="{0}" gear="%g"/>'
    log = played(mujoco.MjModel.from_xml_string(arm(motor % 0.8)), 2.0)
    target = {"actuator": "*", "set": "gain"}
    result = found(arm(motor % 1.0), {"constant": {"unit": "N m/A", "targets": [target]}}, log)
    close(result, constant=0.8)


@pytest.mark.medium
@pytest.mark.parametrize("side", ["shoulder", "shoulder_drive"])
def test_a_backlash_is_found_from_an_encoder_on_either_side_of_the_gap(side: str) -> None:
    def spec(width: float) -> mujoco.MjSpec:
        own = mujoco.MjSpec.from_string(arm(joint='frictionloss="0.1"'))
        add_gaps(own, {"shoulder": width})
        return own

    model = spec(0.03).compile()
    log = played(model, 0.8, seen=[side, "elbow"])
    result = found(
        spec(0.01),
        {"gap": {"nominal": 0.01, "prior_sd": 1.0, "targets": [{"joint": "shoulder", "set": "backlash"}]}},
        log,
        joints=[side, "elbow"],
    )
    close(result, gap=0.03)
    assert np.ptp(result.model().tendon_range[0]) == pytest.approx(result.parameters["gap"].estimate)


@pytest.mark.medium
def test_the_stiffness_of_an_elastic_drive_is_found() -> None:
    def spec(stiffness: float) -> mujoco.MjSpec:
        own = mujoco.MjSpec.from_string(arm(joint='frictionloss="0.1"'))
        add_gaps(own, {"shoulder": stiffness}, elastic=True)
        return own

    plant = spec(60.0).compile()
    plant.tendon_stiffness[0] = 90.0
    log = played(plant, 0.8)
    targets = [{"joint": "shoulder", "set": "drive_stiffness"}]
    close(found(spec(60.0), {"k": {"nominal": 60.0, "prior_sd": 1.0, "targets": targets}}, log), k=90.0)
