"""Signals of a system, and the page that documents systems."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core import rotations
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.description.data import Channel
from amhe_cli.system.description.schema import KINDS, ParameterEntry, SignalEntry
from amhe_cli.system.description.targets import WORDS
from amhe_cli.system.system import System

Write = Callable[..., Path]


@pytest.fixture
def measuring(written: Write) -> Callable[[str], System]:
    """Load a system with one signal."""

    def load(signal: str) -> System:
        return System.load(
            written("  p: {targets: [{body: box, set: mass}]}\n", signals=f"signals:\n  s: {signal}\n")
        )

    return load


def channels(system: System) -> dict[str, Channel]:
    return {channel.key: channel for channel in system.channels}


def test_a_free_body_sets_the_state_and_is_compared_where_it_has_noise(measuring) -> None:
    system = measuring(
        "{topic: /odom, body: box, noise: {position: 0.01, orientation: 0.02, linear_velocity: null}}"
    )
    found = channels(system)
    assert system.signals[0].quantities == ("position", "orientation", "linear_velocity", "angular_velocity")
    assert [(c.source, c.columns, c.noise, c.kind) for c in system.channels] == [
        ("qpos", (0, 1, 2), 0.01, "linear"),
        ("qpos", (3, 4, 5, 6), 0.02, "rotation"),
        ("qvel", (0, 1, 2), None, "linear"),
        ("qvel", (3, 4, 5), None, "linear"),
    ]
    assert all(channel.sets_state for channel in system.channels)
    assert found["s.orientation"].unit == "rad"


def test_joints_are_matched_by_name_in_the_logs_own_words(measuring) -> None:
    system = measuring(
        "{topic: /joint_states, joints: {knee: knee_joint, hip: hip_joint}, noise: {position: 0.01}}"
    )
    assert system.signals[0].names == ("knee_joint", "hip_joint")
    assert channels(system)["s.position"].columns == (8, 7)  # after the box's seven
    assert channels(system)["s.velocity"].columns == (7, 6)


def test_joint_effort_is_the_force_of_the_actuators(measuring) -> None:
    system = measuring("{topic: /joint_states, joints: [hip, knee], noise: {effort: 0.1}}")
    data = mujoco.MjData(system.model)
    data.ctrl[1] = 2.0
    mujoco.mj_forward(system.model, data)
    channel = channels(system)["s.effort"]
    assert channel.source == "sensordata"
    np.testing.assert_allclose(data.sensordata[list(channel.columns)], data.qfrc_actuator[[6, 7]])


def test_a_body_that_is_not_free_is_measured_by_sensors_in_the_logs_conventions(measuring) -> None:
    """World linear velocity of the frame's origin; angular velocity in the body's own frame."""
    quantities = "position: 1, orientation: 1, linear_velocity: 1, angular_velocity: 1"
    system = measuring(f"{{topic: /odom, body: hand, noise: {{{quantities}}}}}")
    model, data = system.model, mujoco.MjData(system.model)
    rng = np.random.default_rng(1)
    data.qpos[:] = rng.normal(size=model.nq)
    data.qvel[:] = rng.normal(size=model.nv)
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    body = model.body("hand").id
    world = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, world, 0)
    expected = {
        "position": data.xpos[body],
        "orientation": data.xquat[body],
        "linear_velocity": world[3:],
        "angular_velocity": rotations.rotate(rotations.conjugate(data.xquat[body]), world[:3]),
    }
    for quantity, values in expected.items():
        columns = list(channels(system)[f"s.{quantity}"].columns)
        np.testing.assert_allclose(data.sensordata[columns], values, atol=1e-12, err_msg=quantity)


def test_an_imu_at_a_site(measuring) -> None:
    system = measuring("{topic: /imu, site: imu, noise: {angular_velocity: 0.01, linear_acceleration: 0.1}}")
    model, data = system.model, mujoco.MjData(system.model)
    data.qvel[7] = 2.0  # the knee turns about y; the site's x axis is the hand's y
    mujoco.mj_forward(model, data)
    columns = list(channels(system)["s.angular_velocity"].columns)
    np.testing.assert_allclose(data.sensordata[columns], [2.0, 0.0, 0.0], atol=1e-12)


def test_a_sensor_of_the_model_is_a_value(measuring) -> None:
    system = measuring("{topic: /touch, sensor: [touch, hip_angle], noise: {value: 0.1}}")
    assert channels(system)["s.value"].columns == (1, 0)


def test_a_topic_without_a_place_in_the_model_is_read_only(measuring) -> None:
    system = measuring("{topic: /wrench, type: geometry_msgs/msg/WrenchStamped}")
    assert system.signals[0].quantities == ("force", "torque")
    assert system.channels == ()
    assert system.inputs == ()


def test_fields_of_foreign_types_are_passed_on(measuring) -> None:
    system = measuring(
        "{topic: /low_state, joints: [hip], fields: {position: 'motorState[0].q'}, noise: {position: 1}}"
    )
    assert system.signals[0].fields == {"position": ("motorState[0].q",)}


@pytest.mark.parametrize(
    ("actuator", "quantity"),
    [("hip_servo", "position"), ("knee_motor", "effort"), ("knee_speed", "velocity")],
)
def test_a_command_is_what_its_actuator_takes(actuator: str, quantity: str, measuring) -> None:
    system = measuring(f"{{topic: /command, actuators: [{actuator}]}}")
    assert system.signals[0].quantities == (quantity,)
    assert system.signals[0].is_input
    assert system.inputs[0].delayed
    address = system.model.actuator_ctrladr[system.model.actuator(actuator).id]
    assert system.inputs[0].columns == (address,)


def test_array_commands_are_values(measuring) -> None:
    system = measuring(
        "{topic: /command, type: std_msgs/msg/Float64MultiArray, actuators: [knee_motor, hip_servo]}"
    )
    assert system.signals[0].quantities == ("value",)
    assert system.inputs[0].columns == (1, 0)


def test_input_columns_are_those_of_mujocos_state_vector(written: Write) -> None:
    system = System.load(
        written(
            "  p: {targets: [{body: box, set: mass}]}\n",
            signals="""
signals:
  marker: {topic: /marker, mocap: marker}
  torque: {topic: /torque, joint_force: [knee]}
  command: {topic: /command, actuators: [hip_servo]}
""",
        )
    )
    data = mujoco.MjData(system.model)
    size = mujoco.mj_stateSize(system.model, system.input_spec)
    vector = np.zeros(size)
    values = {
        "marker.position": [1, 2, 3],
        "marker.orientation": [0, 1, 0, 0],
        "torque.effort": [4],
        "command.position": [5],
    }
    for driven in system.inputs:
        vector[list(driven.columns)] = values[driven.key]
    mujoco.mj_setState(system.model, data, vector, system.input_spec)
    np.testing.assert_array_equal(data.mocap_pos[0], [1, 2, 3])
    np.testing.assert_array_equal(data.mocap_quat[0], [0, 1, 0, 0])
    mujoco.mj_forward(system.model, data)
    assert data.actuator("amhe/torque/knee").force[0] == 4
    assert data.actuator("hip_servo").ctrl[0] == 5


@pytest.mark.parametrize("frame", ["world", "body"])
@pytest.mark.parametrize("reaction", [False, True])
def test_a_known_wrench_acts_at_a_point_in_its_frame(frame: str, reaction: bool, measuring) -> None:
    system = measuring(
        f"{{topic: /ft, force_on: box, at: grip, frame: {frame}, reaction: {str(reaction).lower()}}}"
    )
    model, data = system.model, mujoco.MjData(system.model)
    data.qpos[3:7] = rotations.exp(np.array([0.3, -0.5, 0.8]))
    force, torque = np.array([1.0, 2.0, 3.0]), np.array([0.1, -0.2, 0.3])
    vector = np.zeros(mujoco.mj_stateSize(model, system.input_spec))
    for driven, values in zip(system.inputs, (force, torque), strict=True):
        assert not driven.delayed
        vector[list(driven.columns)] = values
    mujoco.mj_setState(model, data, vector, system.input_spec)
    mujoco.mj_forward(model, data)
    if frame == "body":
        force, torque = (rotations.rotate(data.qpos[3:7], v) for v in (force, torque))
    point, expected = data.site("grip").xpos, np.zeros(model.nv)
    sign = -1.0 if reaction else 1.0
    mujoco.mj_applyFT(model, data, sign * force, sign * torque, point, model.body("box").id, expected)
    np.testing.assert_allclose(data.qfrc_actuator[:6], expected[:6], atol=1e-12)


@pytest.mark.parametrize(
    ("signal", "text"),
    [
        (
            "{topic: /x, joints: [socket]}",
            "no single position; only hinge and slide joints do. .* body: ball",
        ),
        ("{topic: /x, joints: [box]}", "body: box"),
        ("{topic: /x, body: marker, noise: {position: 1}}", "write mocap: marker"),
        ("{topic: /x, mocap: box}", 'give it mocap="true"'),
        ("{topic: /x, body: hand}", "give noise for what is to be compared: position, orientation"),
        ("{topic: /x, body: box, noise: {effort: 1}}", "no quantity to compare 'effort'"),
        ("{topic: /x, actuators: [hip_servo], noise: {position: 1}}", "a command is not"),
        ("{topic: /x, mocap: marker, noise: {position: 1}}", "this signal is not"),
        ("{topic: /x, actuators: [two], quantity: effort}", "no quantity that actuator .two. takes .effort."),
        ("{topic: /x, sensor: touch}", "give noise: {value: SD}"),
        ("{topic: /x, sensor: tuch, noise: {value: 1}}", r"no sensor 'tuch' \(did you mean 'touch'"),
        ("{topic: /x, force_on: box, at: grap}", r"no site 'grap' \(did you mean 'grip'"),
        ("{topic: /x}", "say what to read: type"),
    ],
)
def test_signals_that_cannot_be_are_refused(signal: str, text: str, measuring) -> None:
    with pytest.raises(ConfigError, match=text):
        measuring(signal)


PAGE = Path(__file__).parents[2] / "docs" / "systems.md"


def test_the_example_loads(tmp_path: Path) -> None:
    example = next(re.finditer(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)).group(1)
    scene = (bundled_root() / "models" / "pendulum" / "scene.xml").read_text()
    (tmp_path / "scene.xml").write_text(
        scene.replace("</mujoco>", '<keyframe><key name="home"/></keyframe></mujoco>')
    )
    (tmp_path / "system.yaml").write_text(example)
    system = System.load(tmp_path)
    assert system.space.names == ("load_mass",)
    assert system.keyframe == 0


#: A model with what the shorter examples name.
SCENE = """
<mujoco>
  <worldbody>
    <body name="box" pos="1 0 0"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
    <body><joint name="shoulder" axis="0 1 0"/><geom size="0.1"/>
      <body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/><geom size="0.05"/><site name="wrist"/></body>
    </body>
    <body pos="0 1 0"><joint name="hinge" axis="0 1 0"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><position name="servo" joint="hinge" kp="1"/></actuator>
</mujoco>
"""
SIGNALS = "signals: {joints: {topic: /q, joints: [elbow], noise: {position: 0.002}}}\n"
PARAMETERS = "parameters:\n  mass: {targets: [{body: box, set: mass}]}\n"


def test_the_examples_of_signals_load(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    examples = [
        text
        for text in re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL)
        if text.startswith(("signals:", "parameters:"))
    ]
    examples += re.findall(r"```yaml\n(signals:.*?)```", PAGE.with_name("servo.md").read_text(), re.DOTALL)
    assert len(examples) == 5
    for text in examples:
        parameters = "" if text.startswith("parameters:") else PARAMETERS
        signals = "" if "signals:" in text else SIGNALS
        (tmp_path / "system.yaml").write_text(f"model: scene.xml\n{parameters}{text}{signals}")
        System.load(tmp_path, warn=False)


def test_every_target_kind_and_key_is_explained() -> None:
    text = PAGE.read_text()
    for word in (*WORDS, *KINDS, *ParameterEntry.model_fields, *SignalEntry.model_fields):
        assert f"`{word}" in text or f"{word}:" in text, word


def test_bundled_folders_can_be_copied_and_used_from_anywhere(tmp_path: Path) -> None:
    for name in ("pendulum", "cube_toss"):
        shutil.copytree(bundled_root() / "models" / name, tmp_path / name)
        assert System.load(tmp_path / name).name == name
