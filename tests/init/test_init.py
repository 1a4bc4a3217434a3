"""A system made from a model: names and efforts."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from amhe_cli.api.identify import identify
from amhe_cli.cli.main import run
from amhe_cli.core.bundled import bundled_logs, bundled_models, bundled_root
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.parameters import Parameter
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.efforts import largest_inertias
from amhe_cli.init.folder import _rounding, _topics, init_system
from amhe_cli.init.names import is_command, joint_paths, matched, names_the_same
from amhe_cli.init.parameters import guess_parameters
from amhe_cli.init.signals import Guess, Topic, fields_example, foreign, notes_on
from amhe_cli.init.tables import topics_in
from amhe_cli.logs import LogWriter, read_log, read_signals
from amhe_cli.system.description.schema import SignalEntry
from amhe_cli.system.system import System
from tests.system.test_urdf import mesh_file

LEGS = [f"{leg}_{part}" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
STEP_NS = 10_000_000


def walker(free: str = "<freejoint/>") -> str:
    """A trunk with twelve joints above a floor."""
    legs = "".join(
        f'<body name="{j}_link" pos="{i * 0.01} 0 -0.1"><joint name="{j}_joint" axis="0 1 0"/>'
        f'<geom size="0.02"/></body>'
        for i, j in enumerate(LEGS)
    )
    servos = "".join(f'<position name="{j}" joint="{j}_joint" kp="30"/>' for j in LEGS)
    return f"""<mujoco><worldbody><geom name="floor" type="plane" size="3 3 1"/>
      <body name="trunk" pos="0 0 0.5">{free}<geom type="box" size="0.2 0.1 0.05"/>{legs}</body>
      <body name="crate" pos="1 0 0.2"><freejoint/><geom type="box" size="0.2 0.2 0.2"/></body>
      </worldbody><actuator>{servos}</actuator></mujoco>"""


@pytest.fixture(scope="module")
def walker_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("logs") / "walk.mcap"
    with LogWriter(path, {}) as log:
        for step in range(120):
            stamp, t = 10**18 + step * STEP_NS, step * 0.01
            wave = np.sin(t + np.arange(12)) + rng.normal(0.0, 0.01, 12)
            log.joint_state(
                "/joint_states", stamp, [f"{j}_joint" for j in LEGS][::-1], wave, np.cos(t + np.arange(12))
            )
            log.joint_state("/leg_cmd", stamp, [j.lower() for j in LEGS], wave)
            place, still = np.array([t, 0.0, 0.5]), np.array([1.0, 0.0, 0.0, 0.0])
            log.odometry("/trunk/odom", stamp, place, still, np.array([1.0, 0.0, 0.0]), child_frame="trunk")
            log.pose("/mocap/crate/pose", stamp, place, still)
            log.pose("/camera/pose", stamp, place, still)
    return path


def made(
    tmp_path: Path, model: str, logs: Sequence[Path], name: str = "robot.xml"
) -> tuple[System, str, list[str]]:
    (tmp_path / name).write_text(model)
    guesses = init_system(tmp_path / name, logs, tmp_path / "out").sentences
    return System.load(tmp_path / "out"), (tmp_path / "out" / "system.yaml").read_text(), guesses


@pytest.fixture(scope="module")
def walked(
    tmp_path_factory: pytest.TempPathFactory, walker_log: Path
) -> tuple[System, dict[str, Parameter], str, list[str]]:
    """The walker's system, its parameters by name, its text, and what is said of it."""
    system, text, guesses = made(tmp_path_factory.mktemp("walker"), walker(), [walker_log])
    return system, {p.name: p for p in system.space.parameters}, text, guesses


def test_a_walker_is_matched_by_name_whatever_the_order(walked, walker_log: Path) -> None:
    system, _, text, guesses = walked
    signals = {signal.name: signal for signal in system.signals}
    assert set(signals) == {"joints", "command", "trunk", "crate"}
    assert signals["joints"].names == tuple(f"{j}_joint" for j in LEGS)
    assert signals["command"].names == tuple(j.lower() for j in LEGS)
    assert signals["command"].quantities == ("position",)
    assert signals["crate"].topic == "/mocap/crate/pose"
    assert "not used: /camera/pose" in text
    assert any("odom" in guess for guess in guesses)
    read_signals(walker_log, system.signals, 0.002, LogSettings())


def test_many_joints_share_their_parameters(walked) -> None:
    system, parameters, text, _ = walked
    kinds, parts = ("damping", "friction_loss", "armature"), ("hip", "thigh", "calf")
    shared = {f"{part}_joint_{kind}" for part in parts for kind in kinds}
    others = {"trunk_mass", "crate_mass", "crate_inertia_scale", "friction", "gain_scale", "command_delay"}
    assert set(parameters) == shared | others
    edited = system.edits.apply(system.model, system.space.nominal * 1.5)
    damping = [parameters[f"{part}_joint_damping"].nominal for part in parts]
    np.testing.assert_allclose(edited.dof_damping[6:18], np.tile(1.5 * np.array(damping), 4))
    assert np.all(system.space.nominal > 0.0), "a zero in the model becomes a positive guess"
    assert "the model has none: of the size of the joint's inertia" in text


def test_noise_is_estimated_from_the_log(walked) -> None:
    noise = {channel.key: channel.noise for channel in walked[0].channels}
    assert noise["joints.position"] == pytest.approx(0.01, rel=0.3)
    assert noise["crate.position"] == pytest.approx(0.0005)  # noise-free: the floor
    assert noise["crate.linear_velocity"] is None  # a pose has none: differentiated, sets the state only


@pytest.mark.parametrize("speed", [0.4, 6.0])
def test_a_speed_that_is_held_and_rounded_errs_by_its_steps(tmp_path: Path, speed: float) -> None:
    """As a servo's bus has it: news in every fourth sample, in steps of 0.0767 rad/s, at uneven stamps."""
    time = np.arange(0.0, 6.0, 0.0067) + np.random.default_rng(1).uniform(0.0, 5e-4, 896)
    angle, held = np.sin(speed * time), speed * np.cos(speed * time)[np.arange(896) // 4 * 4]
    table = np.column_stack([1e3 * time, np.degrees(angle), np.degrees(0.0767 * np.round(held / 0.0767))])
    header = "time_ms,position_deg,speed_deg_s,goal_deg"
    np.savetxt(tmp_path / "log.csv", table[:, [0, 1, 2, 1]], delimiter=",", header=header, comments="")
    system, _, _ = made(tmp_path, ARM.replace("motor", "position"), [tmp_path / "log.csv"])
    noise = {channel.key: channel.noise for channel in system.channels}
    assert noise["joints.velocity"] == pytest.approx(0.0767 / np.sqrt(12.0), rel=0.02)


@pytest.mark.parametrize("step", [1.0, 0.1, np.radians(0.5)])
def test_the_steps_of_a_steady_motion_are_no_rounding(step: float) -> None:
    """Nor are those of a motion whose differences are equal but for the last bits, or change by a percent."""
    ramp = step * np.arange(500) + np.pi
    assert _rounding(ramp) == 0.0
    assert _rounding(ramp + 3.0 * step * np.sin(0.003 * np.arange(500))) == 0.0
    assert _rounding(step * np.round(ramp / step / 20.0)) == pytest.approx(step / np.sqrt(12.0))


def test_servo_gain_is_known_only_so_well(walked) -> None:
    """Masses and torques are measured by it: taken for exact, it would make them look exact."""
    assert walked[1]["gain_scale"].prior_sd == 0.1
    assert "delete it if the gains were measured" in walked[2]


def test_an_array_command_and_a_frame_of_tf(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        for step in range(50):
            stamp = 10**18 + step * STEP_NS
            log.numbers("/controller/commands", stamp, np.zeros(2))
            log.joint_state("/joint_states", stamp, ["shoulder", "elbow"], np.zeros(2))
            log.transform("/tf", stamp, {"tool": (np.zeros(3), np.array([1.0, 0, 0, 0]))})
    model = """<mujoco><worldbody><body name="arm"><joint name="shoulder"/><geom size="0.1"/>
      <body name="forearm"><joint name="elbow"/><geom size="0.1"/>
        <body name="tool"><geom size="0.1"/></body></body></body></worldbody>
      <actuator><motor name="one" joint="shoulder"/><motor name="two" joint="elbow"/></actuator></mujoco>"""
    system, _, _ = made(tmp_path, model, [path])
    signals = {signal.name: signal for signal in system.signals}
    assert signals["command"].quantities == ("value",)
    assert signals["tool"].child_frame == "tool"
    assert "shoulder_damping" in system.space.names
    assert "tool_mass" in system.space.names or "forearm_mass" in system.space.names
    read_signals(path, system.signals, 0.002, LogSettings())


URDF = """<robot name="arm"><link name="base"/>
  <link name="upper"><inertial><mass value="1"/><origin xyz="0 0 -0.2"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder_joint" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="5"/></joint></robot>"""


def test_a_urdf_gets_servos_for_its_commanded_joints(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        for step in range(50):
            stamp = 10**18 + step * STEP_NS
            log.joint_state("/joint_states", stamp, ["shoulder"], np.array([0.01 * step]))
            log.joint_state("/joint_commands", stamp, ["shoulder"], np.array([0.01 * step]))
    system, text, guesses = made(tmp_path, URDF, [path], "arm.urdf")
    assert "a URDF has no actuators" in text
    assert any("position servos of guessed gain" in guess for guess in guesses)
    assert system.model.nactuator == 1
    assert system.model.actuator_gainprm[0, 0] > 1.0
    gain = system.space.parameters[system.space.names.index("shoulder_joint_gain")]
    assert gain.log and gain.prior_sd >= 1.0
    assert gain.nominal == pytest.approx(system.model.actuator_gainprm[0, 0])
    assert "shoulder_joint_kv" in system.space.names
    assert "gain_scale" not in text
    assert "data sheet" in text
    assert (tmp_path / "out" / "model.xml").is_file()


def test_a_command_has_a_delay_and_a_log_without_commands_has_none(walked, tmp_path: Path) -> None:
    delay = walked[1]["command_delay"]
    assert (delay.lower, delay.upper, delay.log, delay.prior_sd) == (0, 0.1, False, 0.01)
    assert delay.nominal == pytest.approx(0.011), "between 10 and 12 ms, the instants of a step of 2 ms"
    silent = tmp_path / "silent.mcap"
    with LogWriter(silent, {}) as log:
        for step in range(50):
            log.joint_state("/joint_states", 10**18 + step * STEP_NS, ["FL_hip"], np.array([0.01 * step]))
    assert "command_delay" not in made(tmp_path, walker(), [silent])[0].space.names


@pytest.mark.parametrize(
    ("parts", "mass"),
    [
        ('<body name="gripper" pos="0 0 -1"><geom size="0.1" mass="0.5"/></body>', "gripper_mass"),
        (
            '<body name="flange" pos="0 0 -1"><geom size="0.1" mass="0.5"/></body>'
            '<body name="payload_1" pos="0 0 -0.5"><geom size="0.1" mass="0.4"/></body>',
            "payload_1_mass",
        ),
        ('<body name="camera" pos="0 0 -1"><geom size="0.1" mass="0.001"/></body>', "arm_mass"),
    ],
)
def test_what_an_arm_carries_is_at_its_end_or_called_so(tmp_path: Path, parts: str, mass: str) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        for step in range(50):
            log.joint_state("/joint_states", 10**18 + step * STEP_NS, ["hip"], np.array([0.01 * step]))
    model = f"""<mujoco><worldbody><body name="arm"><joint name="hip"/><geom size="0.1" mass="2"/>{parts}
      </body></worldbody></mujoco>"""
    system, _, _ = made(tmp_path, model, [path])
    assert [name for name in system.space.names if name.endswith("_mass")] == [mass]
    assert ("payload_1_com_x" in system.space.names) == (mass == "payload_1_mass")


def test_a_fixed_link_of_a_urdf_can_be_named(written: Callable[..., Path], tmp_path: Path) -> None:
    """MuJoCo would fuse it with its parent: the load at the end of an arm would be no body."""
    load = """<link name="load"><inertial><mass value="0.3"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="screw" type="fixed"><parent link="upper"/><child link="load"/></joint></robot>"""
    (tmp_path / "arm.urdf").write_text(URDF.replace("</robot>", load))
    signals = "signals: {j: {topic: /j, joints: [shoulder_joint], noise: {position: 0.01}}}\n"
    folder = written("  p: {targets: [{body: load, set: mass}]}\n", signals=signals, more="")
    system = System.load(folder, {"model": "arm.urdf"})
    assert system.space.nominal[0] == pytest.approx(0.3)


def test_a_model_is_copied_with_its_files(tmp_path: Path, walker_log: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (tmp_path / "parts" / "floor.xml").write_text("<mujoco><option timestep='0.004'/></mujoco>")
    model = walker().replace(
        "<mujoco>",
        "<mujoco><!-- mine --><compiler meshdir='parts'/><include file='parts/floor.xml'/>"
        "<asset><mesh name='m' file='box.obj'/></asset>",
    )
    system, _, _ = made(tmp_path, model, [walker_log])
    assert system.model.opt.timestep == 0.004
    assert "<!-- mine -->" in (tmp_path / "out" / "robot.xml").read_text()
    assert (tmp_path / "out" / "parts" / "box.obj").is_file()


def test_a_model_whose_files_are_elsewhere_is_written_anew(tmp_path: Path, walker_log: Path) -> None:
    (tmp_path / "box.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    model = walker().replace("<mujoco>", "<mujoco><asset><mesh name='m' file='../box.obj'/></asset>")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "robot.xml").write_text(model)
    init_system(tmp_path / "deep" / "robot.xml", [walker_log], tmp_path / "out")
    assert System.load(tmp_path / "out").model.nmesh == 1
    assert (tmp_path / "out" / "assets" / "box.obj").is_file()


def test_a_model_that_is_attached_to_another_comes_with_its_files(tmp_path: Path, walker_log: Path) -> None:
    home = tmp_path / "robot"
    mesh_file(home / "parts" / "meshes" / "hip.stl")
    part = """<mujoco><compiler meshdir="meshes"/><asset><mesh file="hip.stl"/></asset><worldbody>
      <body name="leg"><joint name="hip"/><geom type="mesh" mesh="hip"/></body></worldbody></mujoco>"""
    (home / "parts" / "leg.xml").write_text(part)
    (home / "robot.xml").write_text(
        """<mujoco><asset><model name="leg" file="parts/leg.xml"/></asset><worldbody><body>
        <attach model="leg" body="leg" prefix="FL_"/></body></worldbody></mujoco>"""
    )
    init_system(home / "robot.xml", [walker_log], tmp_path / "out")
    shutil.rmtree(home)
    assert System.load(tmp_path / "out").model.nmesh == 1


def test_nothing_in_common_is_an_error_and_leaves_nothing(tmp_path: Path, walker_log: Path) -> None:
    (tmp_path / "m.xml").write_text(
        '<mujoco><worldbody><body><joint name="j9"/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(
        ConfigError, match="nothing in the log matches this model: the model has the joints j9"
    ):
        init_system(tmp_path / "m.xml", [walker_log], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_full_folder_is_left_alone(tmp_path: Path, walker_log: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(ConfigError, match="not empty"):
        made(tmp_path, walker(), [walker_log])
    init_system(tmp_path / "robot.xml", [walker_log], tmp_path / "out", force=True)
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(("system", "log"), [("pendulum", "examples/logs/pendulum.mcap")])
def test_the_bundled_pendulum_is_found_again(system: str, log: str, tmp_path: Path) -> None:
    root = bundled_root()
    if not (root / log).is_file():
        pytest.skip(f"{log} has not been made yet")
    init_system(root / "models" / system / "scene.xml", [root / log], tmp_path / "out")
    own, bundled = System.load(tmp_path / "out"), System.load(root / "models" / system)
    names = {name.removeprefix("hinge_") for name in own.space.names}
    assert names == {*bundled.space.names, "gain_scale", "command_delay"}
    assert [signal.topic for signal in own.signals] == [signal.topic for signal in bundled.signals]


def test_the_real_push_finds_its_block(tmp_path: Path) -> None:
    bag = bundled_root().parent / "shared" / "data" / "planar_push" / "al_block_push.bag"
    if not bag.is_file():
        pytest.skip(f"{bag} is not here")
    model = """<mujoco><worldbody><geom name="table" type="plane" size="2 2 1"/>
      <body name="MetalSquare" pos="0 0 0.1"><freejoint/><geom type="box" size="0.05 0.05 0.01"/></body>
      </worldbody></mujoco>"""
    system, text, _ = made(tmp_path, model, [bag])
    assert system.signals[0].topic == "/vicon/MetalSquare/MetalSquare"
    assert "not used: /vicon/markers" in text


def foreign_model() -> mujoco.MjModel:
    body = "<body><joint name='a' axis='1 0 0'/><joint name='b' axis='0 1 0'/><geom size='1'/></body>"
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


LOW_STATE = Topic("/low_state", "unitree_legged_msgs/msg/LowState", 100.0, (), ())


def test_an_example_of_fields_is_a_signal_of_a_system_file() -> None:
    entry = yaml.safe_load("\n".join(fields_example(foreign_model(), LOW_STATE)))["states"]
    assert SignalEntry.model_validate(entry).fields["position"] == ["motorState[0].q", "motorState[1].q"]


def test_only_a_robots_own_types_may_hold_its_state() -> None:
    others = [
        Topic("/rosout", "rcl_interfaces/msg/Log", 1.0, (), ()),
        Topic("/j", "a/msg/B", 1.0, (), ("x",)),
    ]
    assert foreign([LOW_STATE, *others]) == [LOW_STATE]


def test_states_in_a_foreign_type_are_named_with_an_example(
    tmp_path: Path, walker_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def topics(logs: object, msg_path: object) -> list[Topic]:
        return [Topic("/leg_cmd", "sensor_msgs/msg/JointState", 100.0, tuple(LEGS), ("position",)), LOW_STATE]

    monkeypatch.setattr("amhe_cli.init.folder._topics", topics)
    (tmp_path / "robot.xml").write_text(walker())
    message = r"no topic gives joint positions; /low_state \(unitree_legged_msgs/msg/LowState\) needs fields:"
    with pytest.raises(ConfigError, match=message):
        init_system(tmp_path / "robot.xml", [walker_log], tmp_path / "out")


def test_a_log_of_another_robot_is_recognised_by_its_joints_not_by_foreign_types_beside_them(
    tmp_path: Path, walker_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Topic("/joint_states", "sensor_msgs/msg/JointState", 100.0, ("wheel",), ("position",))
    monkeypatch.setattr("amhe_cli.init.folder._topics", lambda logs, msg_path: [other, LOW_STATE])
    (tmp_path / "robot.xml").write_text(walker())
    with pytest.raises(ConfigError, match=r"nothing in the log matches this model: .* the log names .*wheel"):
        init_system(tmp_path / "robot.xml", [walker_log], tmp_path / "out")


def test_where_some_joints_have_no_state_a_foreign_type_is_written_as_a_comment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path, {}) as log:
        for step in range(50):
            log.joint_state("/joint_states", 10**18 + step * STEP_NS, ["FL_hip"], np.array([0.01 * step]))
    seen = Topic("/joint_states", "sensor_msgs/msg/JointState", 100.0, ("FL_hip",), ("position",))
    monkeypatch.setattr("amhe_cli.init.folder._topics", lambda logs, msg_path: [seen, LOW_STATE])
    system, text, _ = made(tmp_path, walker(), [path])
    assert "  #   topic: /low_state" in text
    assert {channel.key: channel.noise for channel in system.channels}["joints.velocity"] is None


def test_names_are_matched_with_care() -> None:
    own = {name: (name,) for name in ("left_wheel_joint", "right_wheel_joint", "arm")}
    assert matched(own, ["robot/right_wheel", "robot/left_wheel"]) == {
        "left_wheel_joint": "robot/left_wheel",
        "right_wheel_joint": "robot/right_wheel",
    }
    assert matched({"wheel": ("wheel",)}, ["left_wheel", "right_wheel"]) == {}
    assert is_command("/arm/cmd", "sensor_msgs/msg/JointState")
    assert not is_command("/recommended", "sensor_msgs/msg/JointState")
    assert names_the_same("box_link", ["mocap", "box", "pose"])
    assert not names_the_same("box_lid", ["mocap", "box", "pose"])


STRUCTURE = """
<mujoco><worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body name="base" pos="0 0 1">
    <freejoint name="base"/>
    <geom size="0.1" mass="3" contype="0" conaffinity="0"/>
    {legs}
    <body name="caster"><geom size="0.02" friction="0.01" priority="1" mass="0.1"/></body>
    <body name="payload" pos="0 0 0.2"><geom size="0.05" mass="0.5" contype="0" conaffinity="0"/></body>
  </body>
  <body name="crate" pos="1 0 1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="2"/></body>
</worldbody></mujoco>
"""


def structured() -> mujoco.MjSpec:
    legs = "".join(
        f"<body name='{side}_foot'><geom size='0.02' mass='0.2'/>"
        f"<joint name='{side}_hip' axis='0 1 0' damping='{damping}' armature='{armature // 2}'/></body>"
        for armature, (side, damping) in enumerate(
            [("FL", 200), ("FR", 200), ("RL", 200), ("RR", 15), ("X", 15)]
        )
    )
    return mujoco.MjSpec.from_string(STRUCTURE.format(legs=legs))


def guessed(spec: mujoco.MjSpec, joints: list[str]) -> dict[str, dict]:
    signals = [
        Guess("joints", {"topic": "/j", "joints": joints}, ""),
        *(Guess(body, {"topic": f"/{body}", "body": body}, "") for body in ("base", "crate")),
    ]
    return {guess.name: guess.entry for guess in guess_parameters(spec, spec.compile(), signals, False)}


def test_joints_alike_share_their_parameters_where_there_are_many() -> None:
    joints = ["FL_hip", "FR_hip", "RL_hip", "RR_hip", "X_hip"]
    found = guessed(structured(), joints)
    assert [target["joint"] for target in found["hip_damping"]["targets"]] == joints[:2]
    assert (found["hip_damping"]["nominal"], found["hip_damping"]["prior_sd"]) == (200.0, 0.5)
    assert found["X_hip_damping"]["nominal"] == 15.0
    assert found["hip_friction_loss"]["prior_sd"] == 1.0  # the model has none
    few = guessed(structured(), joints[:2])
    assert {"FL_hip_damping", "FR_hip_damping"} <= set(few)


def test_a_casters_friction_is_not_the_wheels_and_feet_are_one_parameter() -> None:
    found = guessed(structured(), ["FL_hip"])
    feet = {target["body"] for target in found["friction"]["targets"]}
    assert feet == {"world", "FL_foot", "FR_foot", "RL_foot", "RR_foot", "X_foot", "crate"}
    assert found["friction"]["nominal"] == 1.0
    assert found["caster_friction"]["targets"] == [{"body": "caster", "set": "sliding_friction"}]
    assert found["caster_friction"]["nominal"] == 0.01


def test_of_a_body_with_several_surfaces_the_one_that_it_stands_on_counts() -> None:
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" friction="0.9 0.005 0.0001"/>
        <body name="base" pos="0 0 0.1"><freejoint/><geom name="chassis" type="box" size="0.2 0.1 0.04"/>
        <geom name="caster" size="0.03" pos="0 0 -0.07" friction="0.02 0.001 0.0001"/></body>
        </worldbody></mujoco>"""
    )
    signals = [Guess("base", {"topic": "/base", "body": "base"}, "")]
    found = {guess.name: guess.entry for guess in guess_parameters(spec, spec.compile(), signals, False)}
    assert [name for name in found if "friction" in name] == ["friction"]
    assert found["friction"]["nominal"] == 0.9  # MuJoCo takes the larger one of both geoms
    assert {"geom": "caster", "set": "sliding_friction"} in found["friction"]["targets"]


def test_pairs_alike_are_one_parameter() -> None:
    feet = "".join(f"<body><freejoint/><geom name='{side}_foot' size='0.1'/></body>" for side in ("FL", "RR"))
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/>{feet}
        <body name="box"><freejoint/><geom name="box" size="0.1"/></body></worldbody>
        <contact><pair name="FL_foot_floor" geom1="FL_foot" geom2="floor"/>
          <pair name="RR_foot_floor" geom1="RR_foot" geom2="floor"/>
          <pair name="box_floor" geom1="box" geom2="floor"/></contact></mujoco>"""
    )
    found = {guess.name: guess.entry for guess in guess_parameters(spec, spec.compile(), [], False)}
    assert [t["pair"] for t in found["foot_floor_friction"]["targets"]] == ["FL_foot_floor", "RR_foot_floor"]
    assert [t["pair"] for t in found["box_floor_friction"]["targets"]] == ["box_floor"]


def test_a_payload_has_a_place_and_a_free_body_an_inertia() -> None:
    found = guessed(structured(), ["FL_hip"])
    assert found["crate_inertia_scale"]["targets"] == [{"body": "crate", "set": "inertia", "mode": "scale"}]
    assert "base_inertia_scale" not in found, "a robot's trunk carries its links"


def test_a_wrench_and_a_mocap_body_are_proposed_with_the_line_to_write() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="hand" mocap="true"/><body name="box"><freejoint/><geom size="0.1"/>
        <site name="ft"/></body></worldbody></mujoco>"""
    )
    topics = [
        Topic("/ft_sensor", "geometry_msgs/msg/WrenchStamped", 100.0, (), ("force", "torque")),
        Topic("/vrpn/pusher", "geometry_msgs/msg/PoseStamped", 100.0, (), ("position", "orientation")),
    ]
    notes = " ".join(notes_on(model, topics, []))
    assert "ft_sensor: {topic: /ft_sensor, site: ft, noise: {force: 0.5, torque: 0.05}}" in notes
    assert "ft_sensor: {topic: /ft_sensor, force_on: box}" in notes
    assert "hand: {topic: /vrpn/pusher, mocap: hand}" in notes


ARM = """<mujoco><worldbody><body name="arm"><joint name="hinge"/><geom size="0.1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""


def test_numbers_without_positions_are_no_state_of_a_joint(tmp_path: Path) -> None:
    """A battery's current, a switch and an accuracy are no joint, though the model has but one."""
    (tmp_path / "log").mkdir()
    for name, column in (
        ("battery", "current"),
        ("control_mode", "flag_force"),
        ("armed", "force_failsafe"),
        ("gps", "pos_accuracy"),
    ):
        (tmp_path / "log" / f"{name}.csv").write_text(
            f"time,{column}\n" + "".join(f"{0.01 * i:g},{i % 2}\n" for i in range(50))
        )
    with pytest.raises(ConfigError, match="nothing in the log matches this model"):
        made(tmp_path, ARM, [tmp_path / "log"])


def test_targets_do_not_drive_a_torque_motor(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(
        "time,pos,cmd_pos\n" + "".join(f"{0.01 * i:g},{0.1 * i},{0.1 * i}\n" for i in range(50))
    )
    system, text, _ = made(tmp_path, ARM, [tmp_path / "log.csv"])
    assert [signal.name for signal in system.signals] == ["joints"]
    assert "no command topic was found" in text
    assert "not used: cmd_pos\n" in text


#: A cart that a servo drives, and a pole that nothing drives.
CART = """<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
<geom size="0.1"/><body name="pole"><joint name="hinge"/>
<geom size="0.1" pos="0 0 1"/></body></body></worldbody>
<actuator><position name="servo" joint="slide"/></actuator></mujoco>"""


@pytest.mark.parametrize("efforts", ["", ",tau: slide,tau: hinge"])
def test_the_hint_about_torques_can_be_pasted(tmp_path: Path, efforts: str) -> None:
    """Columns with signs of YAML in their names; the pole is passive, and a table is no topic."""
    rows = (",".join([f"{0.01 * i:g}", *["0.1"] * (2 + efforts.count(","))]) for i in range(50))
    (tmp_path / "log.csv").write_text("\n".join(["time,pos_slide,pos_hinge" + efforts, *rows]) + "\n")
    _, _, notes = made(tmp_path, CART, [tmp_path / "log.csv"])
    hints = [note.partition("Add the signal ")[2] for note in notes if "motors' torques" in note]
    torque = {"columns": {"effort": ["tau: slide"]}, "joint_force": ["slide"]}
    assert [yaml.safe_load(hint) for hint in hints] == [{"torque": torque}] * bool(efforts)


def test_the_quantity_of_a_command_is_written_where_there_is_a_choice(tmp_path: Path) -> None:
    for name, more in (("one", ()), ("two", (np.ones(1),))):
        (tmp_path / name).mkdir()
        with LogWriter(tmp_path / "log.mcap", {}) as log:
            for step in range(50):
                stamp, angle = 10**18 + step * STEP_NS, np.array([0.01 * step])
                log.joint_state("/joint_states", stamp, ["hinge"], angle)
                log.joint_state("/cmd", stamp, ["hinge"], angle, *more)
        servo = ARM.replace("motor", "position")
        system, text, _ = made(tmp_path / name, servo, [tmp_path / "log.mcap"])
        assert ("quantity: position" in text) == bool(more)
        assert next(s for s in system.signals if s.name == "command").quantities == ("position",)


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_torques_without_commands_are_matched(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    notes = init_system(model, [log], tmp_path / "arm").sentences
    system = System.load(tmp_path / "arm", {"clips": {"held_out": 0.0}})
    assert system.match == "effort"
    assert any(note.startswith("torque: torques were measured, and nothing says") for note in notes)
    (effort,) = [c for c in system.channels if c.compared]
    assert (effort.source, len(effort.columns), system.inputs) == ("effort", 7, ())
    assert len(system.space) == 7 * 10 + 7 * 4
    # with all else at the model's values, friction still stands out: its torque changes with the direction
    found = identify(system, read_log([log], system), only=["joint3_*", "joint7_*", "link7_*"], threads=1)
    assert found.parameters["joint3_friction_loss"].estimate == pytest.approx(0.5, rel=0.2)
    assert found.parameters["joint7_torque_offset"].estimate == pytest.approx(-0.05, abs=0.02)


def test_torques_that_do_not_change_are_no_measurement(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    lines = [line.split(",") for line in log.read_text().splitlines()]
    for line in lines[1:]:
        line[-1] = "0.5"
    (tmp_path / "still.csv").write_text("\n".join(map(",".join, lines)) + "\n")
    notes = init_system(model, [tmp_path / "still.csv"], tmp_path / "arm").sentences
    assert System.load(tmp_path / "arm", warn=False).match == "motion"
    assert any("they can drive the model" in note for note in notes)


@pytest.mark.parametrize(
    "joints", ["hip_to_knee_j knee_to_foot_j", "j1 j2", "left_force_joint right_torque_joint"]
)
def test_joints_keep_words_that_columns_use_for_what_they_hold(joints: str) -> None:
    names = joints.split()
    columns = {q: tuple(f"{q}_{name}" for name in names) for q in ("position", "effort")}
    table = Topic("log", "table", 100.0, ("time", *columns["position"], *columns["effort"]), ())
    for some in (names, names[1:]):  # not by their number
        few = replace(table, entries=tuple(c for c in table.entries if c.split("_", 1)[-1] in some))
        (topic,) = topics_in(few, names, {}, alone=True)
        assert topic.columns == {q: own[-len(some) :] for q, own in columns.items()}
        assert topic.entries == tuple(some)


@pytest.mark.parametrize("column", ["command_effort_{}_motor", "{}_motor_torque_cmd", "{}_motor"])
def test_columns_of_commands_are_named_as_joints_or_as_actuators(column: str) -> None:
    joints = ["left_wheel_joint", "right_wheel_joint"]
    columns = tuple(column.format(side) for side in ("left", "right"))
    table = Topic("log", "table", 100.0, ("time", *(f"q_{joint}" for joint in joints), *columns), ())
    drives = {f"{side}_motor": (f"{side}_wheel_joint", "effort") for side in ("left", "right")}
    states, commands = topics_in(table, joints, drives, alone=True)
    assert states.entries == commands.entries == tuple(joints)
    assert commands.columns == {"effort": columns}


def renamed(text: str, **words: str) -> str:
    """A table with other words, and numbers from 0, in the names of its columns."""
    head, rows = text.split("\n", 1)
    names = [name if name == "time" else f"{words[name[:-1]]}{int(name[-1]) - 1}" for name in head.split(",")]
    return ",".join(names) + "\n" + rows


def test_rival_columns_and_numbers_from_zero_are_told_apart(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    text = renamed(log.read_text(), q="q_", dq="dq_", tau="tau_J_")
    lines = [line.split(",") for line in text.splitlines()]
    wanted = [[f"tau_J_d_{i}" for i in range(7)], *(line[-7:] for line in lines[1:])]
    currents = [[f"tau_cur_{i}" for i in range(7)], *(line[-7:] for line in lines[1:])]
    rows = (",".join([*a, *b, *c]) for a, b, c in zip(lines, wanted, currents, strict=True))
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    notes = init_system(model, [tmp_path / "log.csv"], tmp_path / "arm").sentences
    signals = {s.name: s for s in System.load(tmp_path / "arm", warn=False).signals}
    assert signals["joints"].columns["position"] == tuple(f"q_{i}" for i in range(7))
    assert signals["torque"].columns["effort"] == tuple(f"tau_J_{i}" for i in range(7))
    assert any("not used: tau_cur_0," in note and "in their place" in note for note in notes)
    assert any(note.startswith("not used: tau_J_d_0,") for note in notes)
    assert any(note.startswith("actuators servo1, ") and "are off" in note for note in notes)


def test_joints_that_stand_still_are_left_out(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    lines = [line.split(",") for line in log.read_text().splitlines()]
    for line in lines[1:]:
        line[1:4] = ["0.1", "-0.2", "0.3"]
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, lines)) + "\n")
    notes = init_system(model, [tmp_path / "log.csv"], tmp_path / "arm").sentences
    system = System.load(tmp_path / "arm", warn=False)
    (effort,) = [c for c in system.channels if c.compared]
    assert effort.columns == (3, 4, 5, 6)
    assert not [name for name in system.space.names if name.startswith(("joint1", "joint3", "link2"))]
    assert any(note.startswith("joint1, joint2, joint3 stand still") for note in notes)
    motion = system.matching("motion")  # the same torques drive the model, through motors with their zeros
    assert [one.key for one in motion.inputs] == ["torque.effort"] and motion.match == "motion"
    assert not motion.model.actuator("servo4").gainprm.any() and motion.model.actuator("servo1").gainprm[0]


def test_torques_of_a_model_with_motors_are_matched_too_unless_they_are_commands(tmp_path: Path) -> None:
    """Seven joints that integrate measured torques drift away; a table may still hold commands of motors."""
    log, text = bundled_logs()["arm_torque"], bundled_models()["arm_torque"].read_text()
    model = tmp_path / "arm.xml"
    model.write_text(re.sub(r"<general name=(\S+) joint=(\S+)[^>]*/>", r"<motor name=\1 joint=\2/>", text))
    notes = init_system(model, [log], tmp_path / "arm").sentences
    system = System.load(tmp_path / "arm", warn=False)
    assert system.match == "effort" and not system.inputs
    assert any(note.startswith("actuators servo1, ") and "are off" in note for note in notes)
    assert not any("not used" in note or "in place of its servos" in note for note in notes)
    (tmp_path / "log.csv").write_text(renamed(log.read_text(), q="q_", dq="dq_", tau="tau_cmd_"))
    init_system(model, [tmp_path / "log.csv"], tmp_path / "commanded")
    system = System.load(tmp_path / "commanded", warn=False)
    assert system.match == "motion" and [one.key for one in system.inputs] == ["command.effort"]


#: As a model has them; the motors of the robot are FR, FL, RR, RL.
LEG_NAMES = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]


@pytest.fixture
def go2(tmp_path: Path) -> tuple[Path, Path]:
    """A model of twelve joints, and a log of unitree_go/LowState with its own definition."""
    bodies = "".join(
        f"<body><joint name='{name}' axis='1 0 0'/><geom size='.1' mass='1'/></body>" for name in LEG_NAMES
    )
    model = tmp_path / "go2.xml"
    model.write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    path, package = tmp_path / "go2.mcap", "unitree_go/msg/"
    with LogWriter(path) as log:
        log.define(
            f"{package}MotorState", "uint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau_est\nuint32[2] reserve"
        )
        log.define(
            f"{package}LowState",
            "uint8[2] head\nunitree_go/MotorState[20] motor_state\nfloat32[4] foot_force",
        )
        for i in range(50):
            motors = [{"mode": 1, "q": 0.01 * i + k, "dq": 0.5} for k in range(20)]
            log.write("/lowstate", f"{package}LowState", 10**18 + i * 10**7, {"motor_state": motors})
    return model, path


def test_the_example_reads_the_log_in_the_order_of_the_motors(
    go2: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, path = go2
    with pytest.raises(
        ConfigError, match=r"fields: \{position: \['motor_state\[0\].q', 'motor_state\[1\].q'"
    ):
        init_system(model, [path], tmp_path / "out")
    (topic,) = _topics([path], None)
    entry = yaml.safe_load("\n".join(fields_example(mujoco.MjModel.from_xml_path(str(model)), topic)))[
        "states"
    ]
    assert entry["joints"][:4] == ["FR_hip_joint", "FR_thigh_joint", "FR_calf_joint", "FL_hip_joint"]
    fields = {key: tuple(paths) for key, paths in entry["fields"].items()}
    log = read_signals(path, [Signal("s", "/lowstate", tuple(fields), fields=fields)], 0.01, LogSettings())
    np.testing.assert_allclose(log["s.position"].values[7], 0.07 + np.arange(12), atol=1e-6)
    assert run(["inspect", str(path)]) == 0
    assert "fields by path of head, motor_state[0].mode, motor_state[0].q" in " ".join(
        capsys.readouterr().out.split()
    )


@pytest.mark.parametrize(
    ("paths", "found"),
    [
        ({"joints.pos": 7, "joints.vel": 7}, {"position": "joints.pos[{}]", "velocity": "joints.vel[{}]"}),
        ({"a[0].angle": None, "a[1].angle": None}, {"position": "a[{}].angle"}),
        ({"q": 2, "dq": 1}, {"position": "q[{}]"}),
        ({"temperature": 12}, {}),
    ],
)
def test_paths_by_their_names(paths: dict[str, int | None], found: dict[str, str]) -> None:
    assert joint_paths(paths, 2) == found


@pytest.mark.parametrize(
    "columns",
    ["px py pz qw qx qy qz", "cube_x cube_y cube_z cube_qx cube_qy cube_qz cube_qw"],
    ids=["bare", "named"],
)
def test_columns_of_a_pose_are_those_of_the_free_body(columns: str, tmp_path: Path) -> None:
    body = "<body name='cube'><freejoint/><geom size='.1' mass='1'/></body>"
    (tmp_path / "cube.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    time, names = np.arange(0.0, 1.0, 0.01), columns.split()
    values = {name: np.sin(time + i) for i, name in enumerate(names)}
    turn = [name for name in names if "q" in name]
    length = np.sqrt(sum(values[name] ** 2 for name in turn))
    values |= {name: values[name] / length for name in turn}
    rows = np.column_stack([time, *(values[name] for name in names)])
    log = tmp_path / "log.csv"
    np.savetxt(log, rows, delimiter=",", header="t," + ",".join(names), comments="")

    init_system(tmp_path / "cube.xml", [log], tmp_path / "cube")

    signal = yaml.safe_load((tmp_path / "cube" / "system.yaml").read_text())["signals"]["cube"]
    assert signal["body"] == "cube"
    found = [*signal["columns"]["position"], *signal["columns"]["orientation"]]
    assert [name[-1] for name in found] == list("xyzwxyz")
    assert set(found) == set(names)


def test_armatures_of_an_arm_that_points_up_are_of_the_size_of_what_it_turns_when_stretched() -> None:
    links = "".join(
        f'<body pos="0 0 {0.3 * bool(row)}"><joint axis="{axis}"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02" mass="2"/>'
        for row, axis in enumerate(("0 0 1", "0 1 0", "0 1 0"))
    )
    rail = '<body><joint type="slide"/><geom type="sphere" size="0.1" mass="90"/>'
    arm, moved = (
        mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{on}{links}{'</body>' * n}</worldbody></mujoco>")
        for on, n in (("", 3), (3 * rail, 6))
    )
    base, shoulder, elbow = largest_inertias(arm)
    np.testing.assert_allclose(largest_inertias(moved)[3:], [base, shoulder, elbow], rtol=0.3)  # other poses
    assert arm.dof_M0[0] < 0.002 < 0.2 < base <= shoulder == pytest.approx(arm.dof_M0[1])
    assert elbow == pytest.approx(base), "drives of a wrist are no lighter than the usual one"
