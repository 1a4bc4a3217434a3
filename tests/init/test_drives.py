"""Unknowns of drives (`amhe init --actuators`), and the library of drives (`--drive`)."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.cli.main import run
from amhe_cli.core.belief import belief_of
from amhe_cli.core.bundled import bundled_logs, bundled_models
from amhe_cli.core.errors import ConfigError
from amhe_cli.init.drive_library import LibraryDrive, drive, library
from amhe_cli.init.folder import init_system
from amhe_cli.init.model import overlaps
from amhe_cli.system.export.randomisation import randomisation
from amhe_cli.system.export.trainings import MJLAB_TOOL
from amhe_cli.system.system import System

JOINTS = ("left_hip", "left_knee", "right_hip", "right_knee")
MOTOR = '<motor name="right_knee" joint="right_knee"/>'
ROOT = '<body name="trunk" pos="0 0 1">{0}<geom size="0.1" mass="5"/>'


def leg(side: str, damping: float = 0.2) -> str:
    return f"""
      <body name="{side}_thigh"><joint name="{side}_hip" axis="0 1 0" armature="0.02" damping="0.3"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.5"/>
        <body name="{side}_shank" pos="0 0 -0.2"><joint name="{side}_knee" axis="0 1 0" damping="{damping}"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2"/></body></body>"""


def robot(free: str = "", right: float = 0.2) -> str:
    servos = "".join(f'<position name="{joint}" joint="{joint}" kp="20" kv="0.5"/>' for joint in JOINTS)
    trunk = ROOT.format(free) + leg("left") + leg("right", right)
    return f"<mujoco><worldbody>{trunk}</body></worldbody><actuator>{servos}</actuator></mujoco>"


def made(
    folder: Path,
    model: str,
    group: bool = False,
    backlash: Sequence[str] = (),
    gains: bool = False,
    elastic: Sequence[str] = (),
) -> tuple[System, list[str]]:
    folder.mkdir(exist_ok=True)
    (folder / "robot.xml").write_text(model)
    names = [f"{kind}_{joint}" for kind in ("position", "command_position") for joint in JOINTS]
    rows = [",".join(["time", *names]), *(",".join([f"{0.01 * i:g}", *["0.1"] * 8]) for i in range(50))]
    (folder / "log.csv").write_text("\n".join(rows) + "\n")
    notes = init_system(
        folder / "robot.xml",
        [folder / "log.csv"],
        folder / "out",
        actuators=True,
        group=group,
        gains=gains,
        backlash=backlash,
        elastic=elastic,
    ).sentences
    return System.load(folder / "out"), notes


def test_every_joint_has_four_unknowns_and_all_have_one_delay(tmp_path: Path) -> None:
    system, notes = made(tmp_path, robot())
    kinds = ("damping", "friction_loss", "armature", "offset")
    expected = {f"{joint}_{kind}" for joint in JOINTS for kind in kinds} | {"command_delay"}
    assert set(system.space.names) == expected and len(expected) == 4 * 4 + 1
    nominal = system.space.named(system.space.nominal)
    assert nominal["left_hip_armature"] == 0.02 and nominal["left_knee_armature"] > 0.0
    assert not any("free joint" in note for note in notes)


def test_gains_are_fixed_and_it_is_said(tmp_path: Path) -> None:
    system, notes = made(tmp_path, robot())
    assert system.fixed == {"gain_scale": 1.0}
    assert any(note.startswith("gain_scale: fixed: the log shows only the ratio") for note in notes)


def test_equal_drives_share_all_but_the_zero_of_their_encoders(tmp_path: Path) -> None:
    system, _ = made(tmp_path, robot(), group=True)
    kinds = ("damping", "friction_loss", "armature")
    shared = {f"{name}_{kind}" for name in ("hip", "knee") for kind in kinds}
    assert set(system.space.names) == shared | {f"{joint}_offset" for joint in JOINTS} | {"command_delay"}
    assert system.sets["hip_damping"] == "dof_damping of left_hip; dof_damping of right_hip"


def test_drives_of_other_numbers_are_not_equal(tmp_path: Path) -> None:
    system, _ = made(tmp_path, robot(right=0.4), group=True)
    assert {"hip_damping", "left_knee_damping", "right_knee_damping"} <= set(system.space.names)


def test_a_group_of_drives_that_differ_says_so(tmp_path: Path) -> None:
    two = robot(right=0.4).replace(
        'right_hip" axis="0 1 0" armature="0.02"', 'right_hip" axis="0 1 0" armature="0.03"'
    )
    system, notes = made(tmp_path, two, group=True)
    assert "left_hip_damping" in system.space.names
    assert any(note.startswith("`group`: no two drives are alike") for note in notes)


def test_a_mass_stands_ready_as_a_comment(tmp_path: Path) -> None:
    system, _ = made(tmp_path, robot())
    assert not any(name.endswith("mass") for name in system.space.names)
    path = tmp_path / "out" / "system.yaml"
    lines = path.read_text().splitlines()
    at = lines.index("  # To make a mass unknown, too, uncomment it:")
    end = next(i for i in range(at + 1, len(lines)) if not lines[i].startswith("  # "))
    lines[at + 1 : end] = ["  " + line[4:] for line in lines[at + 1 : end]]
    path.write_text("\n".join(lines) + "\n")
    assert {"left_shank_mass", "right_shank_mass"} <= set(System.load(tmp_path / "out").space.names)


@pytest.mark.parametrize(("height", "count"), [(0.15, 1), (0.3, 0)])
def test_parts_inside_each_other_are_named(height: float, count: int) -> None:
    arm = f"""<mujoco><worldbody><geom type="plane" size="1 1 1"/>
      <body name="base" pos="0 0 0.05"><geom size="0.1"/>
        <body name="turret" pos="0 0 {height}"><joint axis="0 0 1"/><geom size="0.1"/></body></body>
    </worldbody></mujoco>"""
    notes = overlaps(mujoco.MjModel.from_xml_string(arm))  # the base in the floor moves nothing
    assert len(notes) == count
    assert all("base and turret overlap by 50 mm" in note and "<exclude body1=" in note for note in notes)


def test_a_base_that_floats_is_warned_of(tmp_path: Path) -> None:
    _, notes = made(tmp_path, robot("<freejoint/>"))
    (note,) = [note for note in notes if note.startswith("the base is not fixed")]
    assert "body trunk has a free joint" in note


def test_a_group_without_its_drives_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`group` is for the drives of `actuators`"):
        init_system(tmp_path / "robot.xml", [tmp_path / "log.csv"], tmp_path / "out", group=True)


def test_chosen_joints_get_a_gap_of_unknown_width(tmp_path: Path) -> None:
    system, notes = made(tmp_path, robot(), backlash=["*_knee"])
    assert {"left_knee_backlash", "right_knee_backlash"} <= set(system.space.names)
    assert "left_hip_backlash" not in system.space.names
    assert system.sets["left_knee_armature"] == "dof_armature of left_knee_drive"
    assert system.sets["left_hip_armature"] == "dof_armature of left_hip"
    assert any("write joints: {left_knee_drive: left_knee}" in note for note in notes)


def test_chosen_drives_are_elastic(tmp_path: Path) -> None:
    system, _ = made(tmp_path, robot(), backlash=["*_hip"], elastic=["*_knee"])
    assert system.sets["left_knee_drive_stiffness"] == "tendon_stiffness of left_knee_elastic"
    assert system.sets["left_hip_backlash"].startswith("tendon_range[1] of left_hip_backlash")
    assert system.space.parameters[system.space.names.index("left_knee_drive_stiffness")].unit == "N m/rad"
    with pytest.raises(ConfigError, match="no elastic drive; `amhe init --elastic left_hip` writes one"):
        System.from_model(
            system.original,
            parameters={"k": {"targets": [{"joint": "left_hip", "set": "drive_stiffness"}]}},
            signals={"joints": {"joints": ["left_hip"], "noise": {"position": 0.01}}},
        )


def test_a_gap_of_a_joint_that_is_not_driven_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="`backlash`: no joint that is measured and driven 'tail'"):
        made(tmp_path, robot(), backlash=["tail"])


def test_a_column_that_names_a_command_and_a_joint_is_that_joints_target(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(robot())
    names = [f"{joint}_{kind}" for kind in ("pos", "cmd") for joint in JOINTS]
    rows = [",".join(["time", *names]), *(",".join([f"{0.01 * i:g}", *["0.1"] * 8]) for i in range(50))]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    init_system(tmp_path / "robot.xml", [tmp_path / "log.csv"], tmp_path / "out", actuators=True)
    (command,) = [one for one in System.load(tmp_path / "out").signals if one.name == "command"]
    assert command.columns == {"position": tuple(f"{joint}_cmd" for joint in JOINTS)}


def test_a_column_that_is_named_as_an_actuator_is_its_command(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body><joint name="arm" axis="0 0 1"/><geom size="0.1" mass="1"/>
        <body pos="0.2 0 0"><joint name="pendulum"/><geom size="0.02" pos="0 0 -0.2"/></body></body>
        </worldbody><actuator><motor name="motor" joint="arm"/></actuator></mujoco>"""
    )
    rows = "".join(f"{0.01 * i:g},{0.1 * np.sin(0.2 * i):g},0.1,{0.2 * np.cos(i):g}\n" for i in range(200))
    (tmp_path / "log.csv").write_text("time,arm,pendulum,motor\n" + rows)
    init_system(tmp_path / "robot.xml", [tmp_path / "log.csv"], tmp_path / "out", actuators=True)
    signals = {one.name: one for one in System.load(tmp_path / "out", warn=False).signals}
    assert signals["command"].columns == {"effort": ("motor",)}
    assert signals["joints"].columns["position"] == ("arm", "pendulum")


def test_gravity_shows_no_zero_of_a_joint_that_turns_about_the_vertical(tmp_path: Path) -> None:
    log = bundled_logs()["arm"]
    guessed = init_system(bundled_models()["arm"], [log], tmp_path / "out", actuators=True).sentences
    offsets = {text.partition(":")[0]: text for text in guessed if "_offset: zero" in text}
    assert "nothing shows it" in offsets["yaw_offset"]
    assert offsets["shoulder_offset"].endswith("gravity shows it")


def test_efforts_that_are_not_compared_are_named(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(robot())
    kinds = ("position", "command_position", "tau")
    names = [f"{kind}_{joint}" for kind in kinds for joint in JOINTS]
    rows = [",".join(["time", *names]), *(",".join([f"{0.01 * i:g}", *["0.1"] * 12]) for i in range(50))]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    notes = init_system(
        tmp_path / "robot.xml", [tmp_path / "log.csv"], tmp_path / "out", actuators=True
    ).sentences
    (note,) = [note for note in notes if note.startswith("not compared: the efforts tau_left_hip")]
    assert "joint: NAME" in note


def test_gains_limits_and_filters_of_drives_are_free_if_asked(tmp_path: Path) -> None:
    """Each servo has those numbers that the model gives it; its joint has a gear, a motor's has none."""
    model = robot().replace('kp="20" kv="0.5"', 'kp="20" kv="0.5" forcerange="-3 3"', 1)
    model = model.replace('joint="left_knee" kp="20"', 'joint="left_knee" timeconst="0.02" kp="20"')
    model = model.replace('<position name="right_knee" joint="right_knee" kp="20" kv="0.5"/>', MOTOR)
    system, _ = made(tmp_path, model, gains=True)
    free = {
        name
        for name in system.space.names
        if name.split("_", 2)[-1] in ("gain", "kv", "force_limit", "filter")
    }
    of_hips = {f"{side}_hip_{word}" for side in ("left", "right") for word in ("gain", "kv")}
    assert free == of_hips | {"left_hip_force_limit", "left_knee_gain", "left_knee_kv", "left_knee_filter"}
    assert system.space.named(system.space.nominal)["left_knee_filter"] == pytest.approx(0.02)
    assert system.settings.identify.geared == ["left_hip", "left_knee", "right_hip"]
    assert "gain_scale" not in system.sets
    with pytest.raises(ConfigError, match="`gains` is for the drives"):
        init_system(tmp_path / "robot.xml", [tmp_path / "log.csv"], tmp_path / "more", gains=True)


ARM = """<mujoco><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0"/>
    <geom type="sphere" size=".03" pos="0 0 -.2" mass=".5"/>
    <body name="lower" pos="0 0 -.2"><joint name="elbow" axis="0 1 0"/>
      <geom type="sphere" size=".03" pos="0 0 -.2" mass=".2"/></body></body></worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="5"/>
    <position name="elbow" joint="elbow" kp="5" forcerange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize("one", library().values(), ids=list(library()))
def test_every_drive_has_a_source_and_numbers_that_a_drive_can_have(one: LibraryDrive) -> None:
    assert one.title and one.source and 0.05 <= one.torque_sd <= 1.0
    servo = one.servo(gain_p=1.0 if one.gains else None)
    numbers = [one.gear, one.volts, one.no_load_speed, servo.kp, servo.kv, servo.limit, servo.armature]
    assert all(number is None or 0.0 < number < 1000.0 for number in numbers)
    assert (one.gains == "counts") == (one.duty_per_count is not None)
    assert (one.armature is None) == (one.armature_sd is None)
    if one.no_load_speed is not None and one.stall_torque is not None:
        assert servo.kv and servo.limit  # at no load the back-EMF takes all of full duty
        assert servo.kv * one.no_load_speed == pytest.approx(servo.limit / (one.max_duty or 1.0))


def test_counts_become_newton_metres() -> None:
    xl330 = drive("dynamixel:xl330-m288").servo(volts=7.4, gain_p=100)
    assert xl330.kp == pytest.approx(100 * 4096 / (2 * np.pi) / (256 * 885) * 7.4 * 0.52 / 5.0, rel=1e-3)
    at_12 = drive("feetech:sts3215", volts=12.0)
    assert at_12.name == "feetech:sts3215-12v"
    soft, stiff = (at_12.servo(12.0, gain).kp for gain in (16, 32))
    assert soft and stiff == pytest.approx(2.0 * soft)
    assert drive("robstride:03").servo(gain_p=40.0).kp == 40.0
    with pytest.raises(ConfigError, match="no public measurement"):
        drive("feetech:sts3250").servo(gain_p=16)
    with pytest.raises(ConfigError, match="did you mean|there is"):
        drive("feetech:sts3216")


def theta_of(system: amhe.System, **values: float) -> np.ndarray:
    return np.array([values.get(p.name, p.nominal) for p in system.space.parameters])


def made_of(tmp_path: Path, *options: str, gains: str = "", extra: tuple[str, ...] = ()) -> amhe.System:
    times = np.arange(0.0, 2.0, 0.01)
    columns = {"time": times}
    for joint in ("shoulder", "elbow"):
        columns |= {f"pos_{joint}": np.sin(times), f"cmd_pos_{joint}": np.sin(times)}
    columns |= {name: np.full(times.size, 16.0) for name in (*([gains] if gains else []), *extra)}
    table = np.column_stack(list(columns.values()))
    np.savetxt(tmp_path / "arm.csv", table, delimiter=",", header=",".join(columns), comments="")
    (tmp_path / "arm.xml").write_text(ARM)
    paths = [str(tmp_path / name) for name in ("arm.xml", "arm.csv")]
    assert run(["init", *paths, "-o", str(tmp_path / "arm"), "--force", "-q", *options]) == 0
    return amhe.System.load(tmp_path / "arm")


@pytest.mark.medium
def test_an_export_has_the_back_emf_and_says_what_is_lost(tmp_path: Path) -> None:
    system = made_of(tmp_path, "--drive", "elbow=feetech:sts3215", "--gain-p", "16")
    servo = drive("feetech:sts3215").servo(gain_p=16)
    size = len(system.space)
    text = randomisation(system, belief_of(system, np.zeros(size), 1e-6 * np.eye(size)), MJLAB_TOOL)
    (elbow,) = (line for line in text.splitlines() if 'target_names_expr=("elbow",)' in line)
    numbers = {key: float(value) for key, value in re.findall(r"(\w+)=([\d.]+)", elbow)}
    assert numbers["stiffness"] == pytest.approx(servo.kp, rel=1e-2)
    assert numbers["damping"] == pytest.approx(servo.kv, rel=1e-2)
    assert "# firmware of servos: punch" in text


@pytest.mark.medium
@pytest.mark.parametrize("gains", ["", "P_Coefficient"])
def test_a_drive_takes_the_place_of_the_guesses(gains: str, tmp_path: Path, capsys) -> None:
    given = () if gains else ("--gain-p", "16")
    options = ("--actuators", "--drive", "elbow=feetech:sts3215", "--volts", "7.4", *given)
    system = made_of(tmp_path, *options, gains=gains)
    servo = drive("feetech:sts3215").servo(7.4, 16)
    prior = {p.name: (p.nominal, p.prior_sd) for p in system.space.parameters}
    assert prior["elbow_gain"] == pytest.approx((servo.kp, 0.1), rel=5e-3)
    assert prior["elbow_torque_scale"] == (1.0, 0.15)
    assert prior["elbow_back_emf"] == pytest.approx((servo.kv, 0.15), rel=5e-3)
    assert prior["elbow_punch"] == (0.016, 0.02) and prior["elbow_supply_sag"] == (0.1, 0.15)
    assert system.model.actuator("elbow").forcerange == pytest.approx([-servo.limit, servo.limit], rel=1e-3)
    at_08 = system.edits.apply(system.model, theta_of(system, elbow_torque_scale=0.8))
    for field in ("forcerange", "gainprm"):  # one torque per volt is in all that the servo gives
        scaled, own = (getattr(model.actuator("elbow"), field) for model in (at_08, system.model))
        assert scaled == pytest.approx(0.8 * own)
    assert prior["elbow_armature"] == pytest.approx((0.024, 0.3))
    assert prior["shoulder_armature"][1] == 1.0  # a guess, as before
    assert "shoulder_torque_scale" not in prior
    sd = prior["elbow_stribeck_friction"][1]
    assert sd == float(f"{sd:.3g}"), "numbers that people read"
    said = capsys.readouterr().out
    assert ("the drives' gain is 16, by the log's column P_Coefficient" in said) == bool(gains)


def test_a_log_has_the_supply_of_a_drive_and_says_whether_it_is_on(tmp_path: Path, capsys) -> None:
    columns = ("elbow_voltage", "elbow_torque_enable")
    system = made_of(tmp_path, "--actuators", "--drive", "elbow=feetech:sts3215", extra=columns)
    assert [driving.key for driving in system.inputs][1:] == [
        "elbow_voltage.voltage",
        "elbow_enabled.enabled",
    ]
    said = " ".join(capsys.readouterr().out.split())
    assert "not compared: the efforts" not in said  # torque_enable is none
    assert "its noise is what models of such gears miss" in (tmp_path / "arm" / "system.yaml").read_text()
    (position,) = [one for one in system.channels if one.compared]
    assert position.noise == pytest.approx(0.006)
    assert system.fixed["elbow_supply"] == 7.4
    assert "elbow_supply_sag" not in system.space.names  # the voltage has sagged already


@pytest.mark.medium
def test_mistakes_are_one_line(tmp_path: Path, capsys) -> None:
    made_of(tmp_path)
    paths = [str(tmp_path / name) for name in ("arm.xml", "arm.csv")]
    for options, text in (
        (("--drive", "wrist=feetech:sts3215"), "no driven joint 'wrist'"),
        (("--drive", "elbow=feetech:x"), "no drive 'feetech:x'"),
        (("--volts", "12"), "--volts and --gain-p belong to --drive"),
    ):
        assert run(["init", *paths, "-o", str(tmp_path / "other"), *options]) == 2
        assert text in capsys.readouterr().err


def test_the_command_lists_them(capsys) -> None:
    assert run(["drives"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in library())
    assert run(["drives", "dynamixel:mx-64", "--volts", "15", "--gain-p", "8", "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)["drives"]
    assert one["servo"]["kp"] == pytest.approx(8 * 0.158 * 15 * 6.0 / 12.0)
    assert run(["drives", "feetech", "--volts", "12"]) == 2
