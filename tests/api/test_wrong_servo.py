"""A servo's gain or limit that a model has wrong: what rests on it is never plainly identified."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("unexplained")]

GAIN, LIMIT, MASS, STEP = 12.0, 1.6, 0.5, 0.004


def bench(gain: float, limit: float, mass: float) -> str:
    """A load on a servo that saturates now and then."""
    return f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
      <joint name="hinge" axis="0 1 0" damping="0.1" frictionloss="0.03" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" mass="0.05" contype="0" conaffinity="0"/>
      <body name="load" pos="0 0 -0.2"><geom size="0.03" mass="{mass}" contype="0" conaffinity="0"/></body>
      </body></worldbody><actuator>
      <position name="servo" joint="hinge" kp="{gain}" kv="0.3" forcerange="-{limit} {limit}"/>
      </actuator></mujoco>"""


@pytest.mark.parametrize(("gain", "limit"), [(1.3, 1.0), (1.0, 1.4)])
def test_a_load_is_not_identified_by_a_gain_or_a_limit_that_is_wrong(gain: float, limit: float) -> None:
    """The log is of the true servo, and the system takes the wrong one as exact."""
    rng = np.random.default_rng(3)
    model = mujoco.MjModel.from_xml_string(bench(GAIN, LIMIT, MASS))
    data, times = mujoco.MjData(model), np.arange(0.0, 5.0, STEP)
    target = 0.9 * np.sin(1.7 * times) + 0.6 * np.sin(5.3 * times + 1.0)
    angles = np.empty(times.size)
    for k in range(times.size):
        angles[k], data.ctrl[0] = data.qpos[0], target[k]
        mujoco.mj_step(model, data)
    assert np.abs(GAIN * (target - angles)).max() > LIMIT
    parameters = {
        "load_mass": {"nominal": 0.6, "prior_sd": 0.7, "targets": [{"body": "load", "set": "mass"}]},
        "damping": {"nominal": 0.08, "prior_sd": 0.7, "targets": [{"joint": "hinge", "set": "damping"}]},
        "friction": {
            "nominal": 0.04,
            "prior_sd": 0.7,
            "targets": [{"joint": "hinge", "set": "friction_loss"}],
        },
    }
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(bench(gain * GAIN, limit * LIMIT, 0.6)),
        parameters=parameters,
        signals={
            "joints": {"joints": ["hinge"], "noise": {"position": 0.003}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        warn=False,
    )
    arrays = {
        "joints": {"time": times, "position": angles + rng.normal(0.0, 0.003, times.size)},
        "command": {"time": times, "position": target},
    }
    mass = amhe.identify(system, amhe.Log.from_arrays(arrays, system), threads=1).parameters["load_mass"]
    assert mass.verdict != "identified"
    assert mass.lower <= MASS <= mass.upper
