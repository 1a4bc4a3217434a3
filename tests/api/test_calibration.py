"""Calibration of signals: what a sensor adds to the truth is found, and costs the parameters nothing."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core import rotations

ARM = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" damping="0.02" armature="0.01" limited="true" range="-80 80"/>
      <geom name="load" type="sphere" pos="0 0 -0.2" size="0.03" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="2" kv="0.02"/></actuator>
</mujoco>
"""
CART = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.05" mass="1"/>
      <body name="load" pos="0 0 0.1">
        <geom type="box" size="0.05 0.05 0.05" mass="0.8"/>
        <site name="wrist"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail"/></actuator>
  <sensor><force name="truth" site="wrist"/></sensor>
</mujoco>
"""
BALL = """
<mujoco>
  <option timestep="0.004"/>
  <worldbody><body name="ball"><freejoint/><geom size="0.05" mass="0.2"/></body></worldbody>
</mujoco>
"""
CHEAP = {
    "clips": {"count": 6, "length": [0.4, 0.8]},
    # the masses of the models have been weighed: they decide how well a force sensor's scale is known
    "identify": {"iterations": 12, "assumed": {"mass": 0.0}},
}
DT = 0.004


def system(model: str, parameters: dict[str, Any], signals: dict[str, Any]) -> amhe.System:
    spec = mujoco.MjSpec.from_string(model)
    return amhe.System.from_model(spec, parameters=parameters, signals=signals, settings=CHEAP, name="made")


def close(result: amhe.Result, **truth: float) -> None:
    """Every parameter lies within 3.5 sd of its truth, and is known well."""
    for name, value in truth.items():
        found = result.parameters[name]
        assert abs(found.estimate - value) < 3.5 * found.sd, (name, found.estimate, found.sd)
        assert found.shrinkage > 0.8, (name, found.shrinkage)


def swing(zero: float, commands: float = 0.0, seconds: float = 6.0) -> dict[str, Any]:
    """An arm under steps of its servo's command, in the frame of an encoder that is off by `zero`.

    The servo goes to what is commanded less `commands`.
    """
    model, rng = mujoco.MjModel.from_xml_string(ARM), np.random.default_rng(0)
    data, rows = mujoco.MjData(model), []
    command = 0.0
    for step in range(round(seconds / DT)):
        if step % 100 == 0:
            command = rng.uniform(-1.0, 1.0)
        data.ctrl[0] = command - commands - zero
        rows.append((data.time, data.qpos[0] + zero + 0.001 * rng.normal(), command))
        mujoco.mj_step(model, data)
    time, angle, command = np.array(rows).T
    return {"joints": {"time": time, "position": angle}, "command": {"time": time, "position": command}}


@pytest.mark.medium
@pytest.mark.parametrize("commands", [0.0, -0.05])
def test_the_zero_of_an_encoder_is_found_with_commands_in_its_frame(commands: float) -> None:
    """Gravity shows where down is, and where the servo stands beside its command what that counts from."""
    offset = {"signal": "command", "set": "bias", "actuator": "servo"}
    arm = system(
        ARM,
        {
            "offset": {"bounds": [-0.1, 0.1], "prior_sd": 0.02, "targets": [offset]},
            "zero": {
                "bounds": [-0.5, 0.5],
                "prior_sd": 0.2,
                "targets": [{"signal": "joints", "set": "bias", "joint": "hinge", "quantity": "position"}],
            },
            "load": {"nominal": 0.4, "targets": [{"body": "arm", "set": "mass"}]},
        },
        {"joints": {"joints": ["hinge"], "noise": {"position": 0.001}}, "command": {"actuators": ["servo"]}},
    )
    result = amhe.identify(arm, amhe.Log.from_arrays(swing(0.12, commands), arm), threads=1)
    close(result, zero=0.12, load=0.5, offset=commands)
    assert result.parameters["zero"].unit == result.parameters["offset"].unit == "rad"
    model = result.model()
    assert model.qpos0[0] == pytest.approx(0.12, abs=0.01)  # its coordinate is the encoder's
    assert model.jnt_range[0] == pytest.approx(np.radians([-80, 80]) + model.qpos0[0])
    xml = result_xml(result)
    assert 'ref="' not in xml and 'biasprm="0 -2 -0.02"' in xml  # zeros belong to the log


def result_xml(result: amhe.Result) -> str:
    from amhe_cli.system.export.mjcf import identified_xml

    return identified_xml(result.system, result.belief.estimate)


@pytest.mark.medium
def test_a_known_zero_is_said_in_the_signal() -> None:
    signals = {
        "joints": {"joints": ["hinge"], "noise": {"position": 0.001}, "bias": {"position": 0.12}},
        "command": {"actuators": ["servo"]},
    }
    arm = system(ARM, {"load": {"nominal": 0.4, "targets": [{"body": "arm", "set": "mass"}]}}, signals)
    log = amhe.Log.from_arrays(swing(0.12), arm)
    close(amhe.identify(arm, log, threads=1), load=0.5)


def drive(scale: float, bias: float, hertz: float) -> dict[str, Any]:
    """A cart that is shaken; the force on its load passes a filter, a gain and an offset."""
    model, rng = mujoco.MjModel.from_xml_string(CART), np.random.default_rng(1)
    data, rows, shown = mujoco.MjData(model), [], np.zeros(3)
    share = 1.0 - np.exp(-2.0 * np.pi * hertz * DT)
    for step in range(1500):
        if step % 10 == 0:
            data.ctrl[0] = rng.uniform(-20.0, 20.0)
        mujoco.mj_forward(model, data)
        shown = shown + share * (data.sensordata - shown) if step else data.sensordata.copy()
        noisy = scale * shown + bias + 0.05 * rng.normal(size=3)
        rows.append((data.time, data.qpos[0] + 1e-4 * rng.normal(), data.ctrl[0], *noisy))
        mujoco.mj_step(model, data)
    table = np.array(rows)
    return {
        "rail": {"time": table[:, 0], "position": table[:, 1]},
        "push": {"time": table[:, 0], "effort": table[:, 2]},
        "wrist": {"time": table[:, 0], "force": table[:, 3:]},
    }


def wrist(**said: Any) -> dict[str, Any]:
    return {
        "rail": {"joints": ["rail"], "noise": {"position": 1e-4}},
        "push": {"actuators": ["push"]},
        "wrist": {"site": "wrist", "noise": {"force": 0.05}, **said},
    }


@pytest.mark.medium
def test_scale_bias_and_band_of_a_force_sensor_are_found() -> None:
    def of_wrist(word: str, **more: Any) -> dict[str, Any]:
        return {"targets": [{"signal": "wrist", "set": word, **more}]}

    cart = system(
        CART,
        {
            "gain": of_wrist("scale") | {"prior_sd": 0.3},
            "zero": of_wrist("bias", axis="x") | {"bounds": [-5, 5]},
            "band": of_wrist("band") | {"nominal": 12.0, "bounds": [4, 60]},
            "damping": {"nominal": 0.7, "targets": [{"joint": "rail", "set": "damping"}]},
        },
        wrist(band=20.0, bias={"force": [0, 0.7, 0.7]}),
    )
    result = amhe.identify(cart, amhe.Log.from_arrays(drive(1.1, 0.7, 8.0), cart), threads=1)
    close(result, gain=1.1, zero=0.7, band=8.0, damping=1.0)
    assert [result.parameters[name].unit for name in ("gain", "zero", "band")] == ["-", "N", "Hz"]


def toss(pitch: float, origin: list[float]) -> dict[str, Any]:
    """Tosses of a ball, seen by cameras whose frame is turned and moved."""
    model, rng = mujoco.MjModel.from_xml_string(BALL), np.random.default_rng(2)
    turn = rotations.of_rpy(np.array([0.0, pitch, 0.4]))
    data, rows = mujoco.MjData(model), []
    data.qvel[:] = 1.0, 0.5, 6.0, 1.0, 2.0, 3.0
    for _ in range(300):
        position = rotations.rotate(rotations.conjugate(turn), data.qpos[:3] - np.array(origin))
        small = rotations.exp(0.002 * rng.normal(size=3))
        quaternion = rotations.multiply(rotations.conjugate(turn), data.qpos[3:])
        rows.append(
            (data.time, *(position + 0.001 * rng.normal(size=3)), *rotations.multiply(quaternion, small))
        )
        mujoco.mj_step(model, data)
    table = np.array(rows)
    return {"camera": {"time": table[:, 0], "position": table[:, 1:4], "orientation": table[:, 4:]}}


@pytest.mark.medium
def test_the_frame_of_a_camera_is_found_as_far_as_gravity_shows_it() -> None:
    parameters = {
        axis: {
            "bounds": [-0.5, 0.5],
            "prior_sd": 0.1,
            "targets": [{"signal": "camera", "set": "frame", "axis": axis}],
        }
        for axis in ("roll", "pitch")
    }
    camera = {
        "body": "ball",
        "noise": {"position": 0.001, "orientation": 0.002},
        "frame": [0.5, -0.2, 0.1, 0.0, 0.0, 0.4],
    }
    made = system(BALL, parameters, {"camera": camera})
    result = amhe.identify(made, amhe.Log.from_arrays(toss(0.15, [0.5, -0.2, 0.1]), made), threads=1)
    close(result, roll=0.0, pitch=0.15)


def at_rest(**said: Any) -> np.ndarray:
    """Force that the wrist of a cart at rest is predicted to show, shape (3,)."""
    from amhe_cli.core.log import Window
    from amhe_cli.engine.open import open_engine
    from amhe_cli.matching.cost import MatchingCost

    parameters = {"damping": {"targets": [{"joint": "rail", "set": "damping"}]}}
    cart = system(CART, parameters, wrist(**said))
    time = DT * np.arange(100)
    still = {"time": time, "position": np.zeros(100), "velocity": np.zeros(100)}
    push, force = {"time": time, "effort": np.zeros(100)}, {"time": time, "force": np.zeros((100, 3))}
    log = amhe.Log.from_arrays({"rail": still, "push": push, "wrist": force}, cart)
    cost = MatchingCost(cart, [Window(log, 0, 90)], open_engine(cart), cart.settings.cost)
    index = next(i for i, o in enumerate(cost.clips.observed) if o.channel.key == "wrist.force")
    return cost.predict(np.zeros((1, 1))).values[index][0, 0, -1]


def test_a_sites_force_is_that_of_the_parent_on_its_body() -> None:
    """The cart carries a load of 0.8 kg: it pushes the load up, and the load pushes it down."""
    weight = 0.8 * 9.81
    np.testing.assert_allclose(at_rest(), [0.0, 0.0, weight], atol=1e-9)
    np.testing.assert_allclose(at_rest(reaction=True), [0.0, 0.0, -weight], atol=1e-9)


def test_a_reading_is_scaled_turned_and_biased() -> None:
    weight = 0.8 * 9.81
    shown = at_rest(scale=2.0, bias={"force": [1.0, 2.0, 3.0]}, frame=[9.0, 9.0, 9.0, np.pi / 2, 0.0, 0.0])
    # a sensor that is rolled by a quarter turn has the vertical along its y
    np.testing.assert_allclose(shown, [1.0, 2.0 + 2.0 * weight, 3.0], atol=1e-9)
    turned = at_rest(scale={"force": 2.0}, bias={"force": 1.0}, reaction=True, band=30.0)
    np.testing.assert_allclose(turned, [1.0, 1.0, 1.0 - 2.0 * weight], atol=1e-9)


PUCK = """
<mujoco>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>
    <body name="puck"><freejoint/><geom type="box" size="0.1 0.1 0.05" mass="2"/></body>
  </worldbody>
</mujoco>
"""


def pushed(bias: float) -> dict[str, Any]:
    """A free puck under a force in the world whose point of action wanders; the log's force has an offset."""
    model, rng = mujoco.MjModel.from_xml_string(PUCK), np.random.default_rng(3)
    data, rows = mujoco.MjData(model), []
    force, point = np.zeros(3), np.zeros(3)
    for step in range(1000):
        if step % 50 == 0:
            force = rng.normal(size=3) * [4.0, 4.0, 0.0]
        offset = np.array([-0.1, 0.05 * np.sin(2.0 * data.time), 0.0])
        point = data.qpos[:3] + rotations.rotate(data.qpos[3:7], offset)
        data.xfrc_applied[1] = [*force, *np.cross(point - data.qpos[:3], force)]
        noise = rotations.exp(0.002 * rng.normal(size=3))
        pose = (*(data.qpos[:3] + 0.001 * rng.normal(size=3)), *rotations.multiply(data.qpos[3:7], noise))
        rows.append((data.time, *pose, force[0] + bias, *force[1:], *point))
        mujoco.mj_step(model, data)
    table = np.array(rows)
    time = table[:, 0]
    return {
        "puck": {"time": time, "position": table[:, 1:4], "orientation": table[:, 4:8]},
        "push": {"time": time, "force": table[:, 8:11]},
        "tip": {"time": time, "position": table[:, 11:14]},
    }


@pytest.mark.medium
def test_a_force_acts_where_a_signal_says() -> None:
    signals = {
        "puck": {"body": "puck", "noise": {"position": 0.001, "orientation": 0.002}},
        "push": {"force_on": "puck", "quantity": "force", "at": "tip"},
        "tip": {"quantity": "position"},
    }
    parameters = {
        "mass": {"nominal": 1.5, "targets": [{"body": "puck", "set": "mass", "carry_inertia": False}]},
        "inertia": {"nominal": 0.02, "targets": [{"body": "puck", "set": "inertia", "axis": "z"}]},
    }
    made = system(PUCK, parameters, signals)
    result = amhe.identify(made, amhe.Log.from_arrays(pushed(0.0), made), threads=1)
    close(result, mass=2.0, inertia=2.0 / 12.0 * (0.2**2 + 0.2**2))


def test_the_bias_of_a_force_that_drives_the_model_is_found() -> None:
    signals = {
        "puck": {"body": "puck", "noise": {"position": 0.001}},
        "push": {"force_on": "puck", "quantity": "force", "bias": {"force": [0.0, 0.0, 0.0]}},
        "tip": {"quantity": "position"},
    }
    zero = {
        "bounds": [-3, 3],
        "prior_sd": 1.0,
        "targets": [{"signal": "push", "set": "bias", "quantity": "force", "axis": "x"}],
    }
    mass = {"nominal": 1.5, "targets": [{"body": "puck", "set": "mass"}]}
    made = system(PUCK, {"zero": zero, "mass": mass}, signals)
    result = amhe.identify(made, amhe.Log.from_arrays(pushed(0.8), made), threads=1)
    close(result, zero=0.8, mass=2.0)
    assert result.parameters["zero"].unit == "N"


@pytest.mark.medium
def test_a_servo_that_is_switched_off_for_a_third_is_no_servo_then() -> None:
    given = swing(0.0)
    third = given["command"]["time"] > 4.0
    fallen = swing(0.0)["joints"]["position"].copy()
    fallen[third] = np.cumsum(np.full(third.sum(), 1e-3))  # as nothing under power moves
    given["joints"]["position"] = fallen
    given["torque"] = {"time": given["command"]["time"], "value": np.where(third, 0.0, 1.0)}
    signals = {
        "joints": {"joints": ["hinge"], "noise": {"position": 0.001}},
        "command": {"actuators": ["servo"], "active": {"torque": 1}},
        "torque": {"quantity": "value"},
    }
    arm = system(ARM, {"load": {"nominal": 0.4, "targets": [{"body": "arm", "set": "mass"}]}}, signals)
    result = amhe.identify(arm, amhe.Log.from_arrays(given, arm), threads=1)
    close(result, load=0.5)
    assert result.found.clips.across_gaps > 0


def test_samples_of_an_estimator_get_their_signals_offset() -> None:
    signals = {
        "joints": {"joints": ["hinge"], "noise": {"position": 0.001, "velocity": 0.05}, "offset": -0.02},
        "command": {"actuators": ["servo"]},
    }
    arm = system(ARM, {"load": {"nominal": 0.4, "targets": [{"body": "arm", "set": "mass"}]}}, signals)
    given = swing(0.0, seconds=2.0)
    time, angle = given["joints"]["time"], given["joints"]["position"]
    speed = np.asarray(np.gradient(angle, time), dtype=np.float64)
    estimator = amhe.Estimator(arm)
    late = {
        "joints.position": (time + 0.02, angle),
        "joints.velocity": (time + 0.02, speed),
        "command.position": (time, given["command"]["position"]),
    }
    estimate = estimator.update(late)
    assert estimate is not None
    assert estimate.time == pytest.approx(time[-1])
