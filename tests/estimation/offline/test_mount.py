"""A robot on a mount that rocks is reported, at the mount's frequency; one on a rigid base is not."""

from __future__ import annotations

import logging
import re

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe

#: Time step, and time between two samples [s].
STEP = 0.005
SETTINGS = {
    "clips": {"length": [0.4, 1.0], "count": 12},
    "identify": {"profile_points": 0, "iterations": 8, "bootstrap": 50},
}
TRUNK, BELOW = 10.0, 0.25


def arm(payload: float, stiffness: float = 0.0) -> str:
    """Two links on servos, on a trunk that stands on a spring if that has a stiffness [N m/rad]."""
    rock = ""
    if stiffness:
        damping = 0.06 * np.sqrt(stiffness * TRUNK * BELOW**2)
        rock = f"""<joint axis="0 1 0" pos="0 0 {-BELOW}" stiffness="{stiffness}" damping="{damping}"/>
          <geom type="box" size="0.15 0.15 0.15" mass="{TRUNK}"/>"""
    joint = 'axis="0 1 0" damping="0.5" frictionloss="0.2" armature="0.02"'
    return f"""<mujoco><option timestep="{STEP}"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody><body>{rock}
      <body><joint name="shoulder" {joint}/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
        <body pos="0.3 0 0"><joint name="elbow" {joint}/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.5"/>
          <body name="payload" pos="0.25 0 0"><geom type="sphere" size="0.04" mass="{payload}"/></body>
        </body></body></body></worldbody>
      <actuator><position name="shoulder" joint="shoulder" kp="120" kv="4"/>
        <position name="elbow" joint="elbow" kp="80" kv="2"/></actuator></mujoco>"""


def frequency(xml: str) -> float:
    """Frequency at which the base rings that is the model's first joint, the servos on and no friction."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.dof_frictionloss[:] = 0.0
    data, step = mujoco.MjData(model), np.zeros((2 * model.nv, 2 * model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mjd_transitionFD(model, data, 1e-6, 1, step, None, None, None)
    values, vectors = np.linalg.eig(step)
    rates = np.log(values.astype(complex)) / STEP
    base = np.abs(vectors[0]) / np.abs(vectors[: model.nv]).max(axis=0)
    return float(max(rates.imag[(base > 0.5) & (rates.imag > 1.0)]) / (2.0 * np.pi))


def identified(xml: str, seconds: float = 15.0) -> amhe.Result:
    """The arm's payload and damping from a log of the plant `xml`, whose servos step twice a second."""
    rng, noise = np.random.default_rng(3), 0.0005
    model = mujoco.MjModel.from_xml_string(xml)
    data, columns = mujoco.MjData(model), [model.joint(name).qposadr[0] for name in ("shoulder", "elbow")]
    steps = round(seconds / STEP)
    targets = rng.uniform(-0.4, 0.4, (round(2.0 * seconds) + 1, 2))
    commands = np.repeat(targets, round(0.5 / STEP), axis=0)[:steps]
    positions = np.empty((steps, 2))
    for k in range(steps):
        positions[k] = data.qpos[columns]
        data.ctrl[:] = commands[k]
        mujoco.mj_step(model, data)
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(arm(0.6)),
        parameters={
            "payload": {
                "nominal": 0.6,
                "prior_sd": 0.7,
                "scale": "log",
                "targets": [{"body": "payload", "set": "mass"}],
            },
            "damping": {
                "nominal": 0.6,
                "prior_sd": 0.7,
                "scale": "log",
                "targets": [{"joint": name, "set": "damping"} for name in ("shoulder", "elbow")],
            },
        },
        signals={
            "joints": {"joints": ["shoulder", "elbow"], "noise": {"position": noise}},
            "command": {"actuators": ["shoulder", "elbow"], "quantity": "position"},
        },
        settings=SETTINGS,
        name="arm",
    )
    time = STEP * np.arange(steps)
    measured = positions + rng.normal(0.0, noise, positions.shape)
    log = amhe.Log.from_arrays(
        {
            "joints": {"time": time, "position": measured},
            "command": {"time": time, "position": commands},
        },
        system,
    )
    return amhe.identify(system, [log], seed=1, threads=1)


def reported(result: amhe.Result) -> list[float]:
    """Frequencies of mounts in the warnings."""
    found = (re.search(r"a mount that rocks at about ([\d.]+) Hz", text) for text in result.warnings)
    return [float(one[1]) for one in found if one]


@pytest.mark.medium
@pytest.mark.parametrize("stiffness", [2500.0, 5500.0])
def test_a_mount_that_rocks_is_told_at_its_frequency(stiffness: float) -> None:
    xml = arm(0.8, stiffness)
    (found,) = reported(identified(xml))
    assert found == pytest.approx(frequency(xml), rel=0.1)


@pytest.mark.medium
def test_a_rigid_base_is_no_mount(caplog) -> None:
    with caplog.at_level(logging.WARNING):
        assert not reported(identified(arm(0.8)))


@pytest.mark.medium
def test_another_lack_of_the_model_is_no_mount() -> None:
    """Servos that are a third weaker than modelled leave residuals that repeat, and do not ring."""
    assert not reported(identified(arm(0.8).replace('kp="120"', 'kp="80"')))
