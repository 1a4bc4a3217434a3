"""A cart on a driven wheel and a skid, which never leaves the floor."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.log import Log
from amhe_cli.estimation.explain.inputs import Remapped, mended
from amhe_cli.estimation.offline.clips import whole

STEP = 0.002
TRUTH = {"load": 4.3, "damping": 0.04, "gain": 1.0}
PARAMETERS = {
    "load": {"nominal": 3.1, "prior_sd": 0.3, "targets": [{"body": "hull", "set": "mass"}]},
    "damping": {"nominal": 0.01, "prior_sd": 0.7, "targets": [{"joint": "wheel", "set": "damping"}]},
    "gain": {
        "nominal": 1.0,
        "prior_sd": 0.1,
        "targets": [{"actuator": "drive", "set": "gain", "mode": "scale"}],
    },
}


def cart(load: float, damping: float) -> mujoco.MjSpec:
    """The cart with a load [kg] and damping of its wheel [N m s/rad]."""
    return mujoco.MjSpec.from_string(f"""<mujoco><option timestep="{STEP}"/><worldbody>
<geom type="plane" size="9 9 1"/>
<body name="hull" pos="0 0 0.08"><joint name="along" type="slide" axis="1 0 0"/>
<joint name="up" type="slide" axis="0 0 1"/><joint name="pitch" axis="0 1 0"/>
<geom type="box" size=".15 .1 .04" mass="{load}"/>
<geom type="sphere" size=".03" pos="-.13 0 -.05" mass=".1"/>
<body name="wheel" pos=".08 0 -.02"><joint name="wheel" axis="0 1 0" damping="{damping}" armature=".002"/>
<geom type="cylinder" size=".06 .015" zaxis="0 1 0" mass=".4"/></body></body></worldbody>
<actuator><velocity name="drive" joint="wheel" kv=".5"/></actuator></mujoco>""")


@pytest.fixture(scope="module")
def system() -> amhe.System:
    spec = cart(3.0, 0.01)
    signals = {
        "joints": {
            "joints": [joint.name for joint in spec.joints],
            "noise": {"position": 0.002, "velocity": None},
        },
        "command": {"actuators": ["drive"], "quantity": "velocity"},
    }
    settings = {
        "identify": {"assumed": 0, "iterations": 8, "polish": 4},
        "clips": {"length": [0.5, 1.0], "held_out": 0.0},
    }
    return amhe.System.from_model(spec, parameters=PARAMETERS, signals=signals, settings=settings)


@pytest.fixture(scope="module")
def drive(system: amhe.System) -> Log:
    """6 s of drive at changing speeds, with noise, at 50 Hz."""
    model, rng = cart(4.2, TRUTH["damping"]).compile(), np.random.default_rng([7, 0])
    data, rows = mujoco.MjData(model), []
    mujoco.mj_step(model, data, 250)
    for k in range(round(6.0 / STEP) + 1):
        if k % 250 == 0:
            data.ctrl[:] = rng.uniform(-6.0, 8.0)
        if k % 10 == 0:
            rows.append(np.concatenate(([k * STEP], data.qpos, data.qvel, data.ctrl)))
        mujoco.mj_step(model, data)
    time, position, velocity, command = np.split(np.array(rows), np.cumsum([1, model.nq, model.nv]), axis=1)
    position += 0.001 * rng.standard_normal(position.shape)
    velocity += 0.02 * rng.standard_normal(velocity.shape)
    joints = {"time": time[:, 0], "position": position, "velocity": velocity}
    return Log.from_arrays({"joints": joints, "command": {"time": time[:, 0], "velocity": command}}, system)


@pytest.mark.medium
@pytest.mark.parametrize("key", ["", "command.velocity", "joints.position"])
def test_a_column_with_the_other_sign_is_named_where_wheels_never_leave_the_floor(
    system: amhe.System, drive: Log, key: str
) -> None:
    signs = Remapped({key: {0 if key[:1] == "c" else 3: (0 if key[:1] == "c" else 3, -1.0)}} if key else {})
    wrong = mended(system, [whole(signs(drive))], np.random.default_rng(0))[:1]
    named = {"command.velocity": ["command of drive"], "joints.position": ["wheel"]}
    assert [one.place for one in wrong] == named.get(key, [])


@pytest.mark.slow
def test_a_cart_on_wheels_is_found_within_the_intervals(system: amhe.System, drive: Log) -> None:
    found = amhe.identify(system, drive).parameters
    for name, value in TRUTH.items():
        assert found[name].lower < value < found[name].upper, name
    assert found["damping"].estimate > 0.02, "four times as large as in the model"
