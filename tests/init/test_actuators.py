"""`amhe init --actuators`: the unknowns of every drive, from a model and a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import pytest

from amhe_cli.core.bundled import bundled_logs, bundled_models
from amhe_cli.core.errors import ConfigError
from amhe_cli.init.folder import init_system
from amhe_cli.init.model import overlaps
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
