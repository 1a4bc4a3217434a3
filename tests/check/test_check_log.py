"""The checks of a log and of a model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.check.findings import Finding, worst_first
from amhe_cli.check.model import check_model
from amhe_cli.check.motion import JointMotion, log_findings, motions
from amhe_cli.cli.check import _recorded
from amhe_cli.cli.main import run
from amhe_cli.estimation.design.expected import Expected, expected
from amhe_cli.init.folder import proposed
from amhe_cli.system.model.files import compiled, read_spec

ROOT = Path(__file__).parents[2]
LOG = ROOT / "examples" / "logs" / "pendulum.mcap"
MODEL = str(ROOT / "models" / "pendulum" / "scene.xml")


@pytest.fixture(scope="module")
def hope() -> Expected:
    """What the pendulum's log will tell."""
    system = amhe.System.load("pendulum")
    return expected(system, [amhe.read_log(LOG, system)])


@pytest.mark.medium
def test_the_expected_sds_are_those_of_the_fit(hope: Expected) -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(LOG, system)
    before = {p.name: p for p in hope.parameters}
    after = amhe.identify(system, log, threads=1)
    ratios = [(1.0 - before[name].shrinkage) / (1.0 - p.shrinkage) for name, p in after.parameters.items()]
    off = np.exp(np.abs(np.log(ratios)))
    assert np.median(off) < 1.2 and off.max() < 1.5
    same = [before[name].verdict == one.verdict for name, one in after.parameters.items()]
    assert sum(same) >= len(same) - 1


def test_a_joint_that_stands_still_is_named() -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(LOG, system)
    (moved,) = motions(system, [log])
    assert moved.joint == "hinge" and moved.high - moved.low > 1.0 and moved.speed > 1.0
    assert moved.band is not None and 0.5 < moved.band < 50.0
    assert not list(log_findings(system, [log], [moved]))
    (found,) = log_findings(
        system, [], [JointMotion("hinge", "rad", 0.0, 0.01, 0.01, 0.0, 1.0, 0.005, 100.0)]
    )
    assert (found.kind, found.where) == ("still", "hinge")


def test_a_free_body_without_a_name_of_its_joint_has_no_joint_to_move() -> None:
    times = np.arange(0.0, 1.0, 0.002)
    poses = {"position": np.ones((len(times), 3)), "orientation": np.tile([1.0, 0, 0, 0], (len(times), 1))}
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='cube'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    free = amhe.System.from_model(
        spec,
        parameters={"mass": {"targets": [{"body": "cube", "set": "mass"}]}},
        signals={"cube": {"body": "cube", "noise": {"position": 0.001, "orientation": 0.01}}},
        warn=False,
    )
    log = amhe.Log.from_arrays({"cube": {"time": times, **poses}}, free)
    assert motions(free, [log]) == ()


@pytest.mark.medium
def test_the_command_says_what_to_expect(
    hope: Expected, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("amhe_cli.estimation.design.expected.expected", lambda *_: hope)
    arguments = ["check", MODEL, str(LOG), "--system", "pendulum", "--json"]
    assert run([*arguments, "--require", "load_mass<5%"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert {one["name"] for one in record["expected"]} == {
        "load_mass",
        "damping",
        "friction_loss",
        "armature",
    }
    assert record["motion"][0]["joint"] == "hinge" and record["fit_cpu_seconds"] > 0.0
    assert run([*arguments, "--require", "load_*<0.01%"]) == 3
    assert "load_mass is expected to" in json.loads(capsys.readouterr().out)["not_reached"][0]


@pytest.mark.medium
def test_numbers_of_bodies_stand_for_their_coordinates(capsys: pytest.CaptureFixture[str]) -> None:
    """What is required and what is said are kilograms and metres; the least known comes first."""
    arguments = ["check", "example:arm_torque", "example:arm_torque", "--json", "--require"]
    assert run([*arguments, "link7_inertia.mass<1%"]) == 3
    captured = capsys.readouterr()
    record = json.loads(captured.out)
    (missed,) = record["not_reached"]
    assert missed.startswith("link7_inertia.mass is expected to be known to ") and "/tmp" not in captured.err
    names = [one["name"] for one in record["expected"]]
    assert "link7_inertia.com_z" in names and "link7_inertia.alpha" not in names
    assert record["expected"][-1]["verdict"] == "identified" != record["expected"][0]["verdict"]
    assert all(one["cure"] for one in record["expected"] if one["verdict"] != "identified")
    assert run([*arguments, "link7_mass<5%"]) == 2
    assert "did you mean 'link7_inertia.mass'?" in capsys.readouterr().err


SERVO = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="rod" pos="0 0 0.2">
<joint name="hinge" axis="0 1 0" range="-3 3" damping="0.1" armature="0.01" frictionloss="0.01"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" forcerange="-1 1"/></actuator></mujoco>"""


@pytest.mark.medium
def test_what_is_wrong_with_a_recording_stands_in_the_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rod that its servo presses on the floor with all its force, with a silence of a fifth of the log; the
    same in a second log is said once."""
    times = np.arange(0.0, 12.0, 0.01)
    position = 0.3 + 0.42 * np.sin(1.5 * times)
    rows = np.column_stack((times, position, position + 0.2))[(times < 5.0) | (times > 7.5)]
    model, logs, head = tmp_path / "rod.xml", [], "time,position_hinge,command_position_servo"
    model.write_text(SERVO)
    for name, part in {"log.csv": rows, "other.csv": rows[:800]}.items():
        np.savetxt(tmp_path / name, part, fmt="%.6g", delimiter=",", header=head, comments="")
        logs.append(str(tmp_path / name))
    assert run(["check", str(model), *logs, "--json"]) == 0
    captured = capsys.readouterr()
    findings = json.loads(captured.out)["findings"]
    found = {one["kind"]: one for one in findings}
    assert [one["kind"] for one in findings].count("saturated") == 1
    assert {"gaps", "saturated", "contact"} <= found.keys()
    assert found["saturated"]["where"] == "servo" and "100 %" in found["saturated"]["what"]
    assert found["contact"]["where"] == "rod, world"
    assert all(one["cure"] for one in found.values())


def test_a_joint_that_moves_through_more_than_its_range_is_a_doubt() -> None:
    moved = JointMotion(
        "elbow", "rad", -1.1, 1.1, 25.2, 1.0, None, 0.001, 100.0
    )  # a range in degrees, read as radians
    (found,) = log_findings(amhe.System.load("pendulum"), [], [moved])
    assert (found.kind, found.what) == ("range", "it moves through 25 times its range")
    assert "degrees taken for radians" in found.cure
    at_its_stops = replace(moved, share=1.02)  # by their give, and by noise
    assert not log_findings(amhe.System.load("pendulum"), [], [at_its_stops])


def test_a_recording_slower_than_its_motion_is_a_doubt() -> None:
    moved = JointMotion("elbow", "rad", -1.1, 1.1, 0.5, 1.0, 1.1, 0.001, 4.0)
    (found,) = log_findings(amhe.System.load("pendulum"), [], [moved])
    assert (found.kind, found.what) == ("slow", "it moves at up to 1.1 Hz, and has 4 samples a second")
    assert not log_findings(amhe.System.load("pendulum"), [], [replace(moved, rate=50.0)])


@pytest.mark.parametrize(
    ("change", "kind", "where", "says"),
    [
        (lambda rows: rows * [1, 1, -1, 1, 1, 1, 1], "recording", "shoulder", "reversed: [shoulder]"),
        (lambda rows: rows[:, [0, 2, 1, 3, 4, 5, 6]], "recording", "yaw, shoulder", "names exchanged"),
        (lambda rows: rows[:, :4], "recording", "log", "command_position_NAME"),
        (lambda rows: rows[:, [0, 1, 2, 4, 5, 6]], "unmeasured", "elbow", "log it"),
    ],
)
def test_what_is_wrong_with_a_log_comes_first(
    change: Any, kind: str, where: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Signs, order, commands and joints of an arm's log; what a fit would say of it is not asked here."""
    source = ROOT / "examples" / "logs" / "arm.csv"
    names = np.array(source.read_text().split("\n", 1)[0].split(","))
    rows = np.loadtxt(source, delimiter=",", skiprows=1, max_rows=800)
    numbers = change(np.vstack((np.arange(len(names)), rows)))
    # a column that is only scaled or moved keeps its name
    kept = names if numbers.shape[1] == len(names) else names[numbers[0].astype(int)]
    np.savetxt(tmp_path / "log.csv", numbers[1:], delimiter=",", header=",".join(kept), comments="")
    nothing = Expected((), (), (), {}, 0.0)
    monkeypatch.setattr("amhe_cli.estimation.design.expected.expected", lambda *_: nothing)
    assert run(["check", "example:arm", str(tmp_path / "log.csv"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["findings"]
    assert (found[0]["kind"], found[0]["where"]) == (kind, where) and says in found[0]["cure"]


def test_advice_to_log_commands_rests_on_the_system_and_on_no_words() -> None:
    system = amhe.System.load("pendulum")
    (found,) = _recorded(system, [], ["run.csv: no command in the log"])
    assert "command_position_NAME" not in found.cure
    first, *_ = _recorded(replace(system, inputs=()), [], [])
    assert first.what.startswith("servo: ") and "command_position_NAME" in first.cure


@pytest.mark.medium
def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, text in (
        (["--require", "load_mass<5%"], "give a LOG"),
        ([str(LOG), "--require", "load_mass=5"], "NAME<5%"),
    ):
        assert run(["check", MODEL, *arguments]) == 2
        assert text in capsys.readouterr().err


MODELS = [*sorted((ROOT / "models").glob("*/scene.xml")), ROOT / "examples" / "logs" / "arm.xml"]
SO101 = ROOT / "examples" / "systems" / "so101" / "scene.xml"
JOINT = 'axis="0 1 0" range="-90 90" damping=".1" armature=".01" frictionloss=".1"'
ARM = """<body name="{side}_arm" pos="0 {y} 1"><joint name="{side}_arm" {joint}/>
    <inertial pos="0 0 -.15" mass="0.5" diaginertia=".004 .004 .0003"/>
    <geom type="box" size=".03 .03 .15" pos="0 0 -.15"/>
    <body name="{side}_hand" pos="0 0 -.3"><joint name="{side}_hand" {joint}/>
      <inertial pos="0 0 -.1" mass="0.2" diaginertia=".0007 .0007 .0001"/>
      <geom type="box" size=".02 .02 .1" pos="0 0 -.1"/></body></body>"""
SERVOS = """<position name="{side}_arm" joint="{side}_arm" kp="50" forcerange="-9 9"/>
    <position name="{side}_hand" joint="{side}_hand" kp="20" forcerange="-4 4"/>"""
SIDES = {"left": ".2", "right": "-.2"}
BODIES = "".join(ARM.format(side=side, y=y, joint=JOINT) for side, y in SIDES.items())
ROBOT = '<mujoco><option timestep="0.002"/><worldbody>' + BODIES + "</worldbody><actuator>"
ROBOT += "".join(SERVOS.format(side=side) for side in SIDES) + "</actuator></mujoco>"
SECOND = '<position name="b" joint="right_hand" kp="9"/></actuator>'
RIGHT_HAND = '<inertial pos="0 0 -.1" mass="0.2" diaginertia=".0007 .0007 .0001"/>'
#: What is spoilt in the right hand, or for all -> the kind of finding, and whose it is.
SPOILT = {
    "mass in grams": ((RIGHT_HAND, RIGHT_HAND.replace("0.2", "200")), "dense", "right_hand"),
    "mass next to nothing": ((RIGHT_HAND, RIGHT_HAND.replace("0.2", "0.0008")), "thin", "right_hand"),
    "twice the mass": ((RIGHT_HAND, RIGHT_HAND.replace("0.2", "0.4")), "twins", "right_hand"),
    "centre in millimetres": ((RIGHT_HAND, RIGHT_HAND.replace("-.1", "-100")), "centre", "right_hand"),
    "inertia of another unit": (
        (RIGHT_HAND, RIGHT_HAND.replace(".0007 .0007", ".7 .7")), "inertia", "right_hand",
    ),
    "inertia of a point": (
        (RIGHT_HAND, RIGHT_HAND.replace(".0007 .0007 .0001", "7e-9 7e-9 1e-9")), "inertia", "right_hand",
    ),
    "no armature": ((' armature=".01"', ""), "drive", "right_hand"),
    "gain in counts": (('kp="20"', 'kp="20000"'), "stiff", "right_hand"),
    "limit of the motor": (('forcerange="-9 9"', 'forcerange="-.1 .1"'), "weak", "right_arm"),
    "friction that no drive overcomes": (('frictionloss=".1"', 'frictionloss="10"'), "weak", "right_arm"),
    "targets in degrees": (('kp="20" ', 'kp="20" ctrlrange="-90 90" '), "range", "right_hand"),
    "range in radians taken for degrees": (('range="-90 90"', 'range="-1.57 1.57"'), "range", "right_arm"),
    "axes of another frame": (
        (RIGHT_HAND, RIGHT_HAND.replace(".0007 .0007 .0001", ".0001 .0007 .0007")), "axes", "right_hand",
    ),
    "a limit that never acts": (('forcerange="-9 9"', 'forcerange="-1e4 1e4"'), "loose", "right_arm"),
    "targets that hardly move it": (('kp="20" ', 'kp="20" ctrlrange="-.02 .02" '), "range", "right_hand"),
    "gear of nothing": (('kp="20"', 'gear="0" kp="20"'), "idle", "right_hand"),
    "driven twice": (("</actuator>", SECOND), "twice", "right_hand"),
    "overlap": (("0 -.2 1", "0 .21 1"), "overlap", "right_arm"),
}  # fmt: skip


def test_a_sound_robot_has_no_findings() -> None:
    assert check_model(mujoco.MjModel.from_xml_string(ROBOT)) == ()


#: What is put into the right hand, and is no doubt about a robot.
HARMLESS = {
    "a light part of a heavy link": '<body><inertial pos="9 0 0" mass="0.001" diaginertia="1 1 1"/></body>',
    "a shape that is not where the joint is": '<body name="x" pos="0 0.5 0"><joint name="x" damping="1" '
    'armature="1" frictionloss="1"/><inertial pos="0 0 0" mass="0.6" diaginertia=".004 .004 .004"/>'
    '<geom type="box" size=".03 .03 .03" pos="0 .2 0"/></body>',
    "a joint that turns for ever": '<body pos="0 0 -.3"><joint name="x" range="-1e6 1e6" damping="1" '
    'armature="1" frictionloss="1"/><geom size=".02" mass="0.1"/></body>',
}


@pytest.mark.parametrize("what", HARMLESS)
def test_what_robots_have_is_no_finding(what: str) -> None:
    at = ROBOT.rindex(RIGHT_HAND)
    assert check_model(mujoco.MjModel.from_xml_string(ROBOT[:at] + HARMLESS[what] + ROBOT[at:])) == ()


def test_a_model_without_joints_has_no_findings() -> None:
    assert check_model(mujoco.MjModel.from_xml_string("<mujoco/>")) == ()


def test_of_many_findings_of_a_kind_the_worst_are_said_and_the_others_named() -> None:
    found = worst_first([Finding("thin", f"b{i}", f"it is {i}", 1.0 + i, "") for i in range(9)])
    assert [one.where for one in found] == ["b8", "b7", "b6", "b5, b4, b3, b2, b1, b0"]
    assert found[-1].what == "likewise; the worst: it is 5"


@pytest.mark.parametrize("what", SPOILT)
def test_what_is_spoilt_is_found(what: str) -> None:
    (old, new), kind, where = SPOILT[what]
    assert old in ROBOT
    at = ROBOT.rindex(old) if old == RIGHT_HAND else 0  # of the two hands the right one
    model = mujoco.MjModel.from_xml_string(ROBOT[:at] + ROBOT[at:].replace(old, new))
    found = check_model(model)
    assert any(one.kind == kind and where in one.where for one in found), found
    assert all(one.size >= 1.0 and one.cure for one in found)
    assert [one.size for one in found] == sorted((one.size for one in found), reverse=True)


@pytest.mark.parametrize("path", MODELS, ids=lambda path: path.parent.name)
def test_bundled_models_are_sound(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(path), "--strict"]) == 0
    assert "every number is one that a robot can have" in capsys.readouterr().out


def test_the_makers_gains_of_a_real_arm_are_doubted(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", str(SO101), "--strict", "--json"]) == 3
    record = json.loads(capsys.readouterr().out)
    assert [one["kind"] for one in record["findings"]] == ["stiff"]
    assert "0.19 degrees of error already take all of the force" in record["findings"][0]["what"]


IMPOSSIBLE = """<mujoco><worldbody><body name="arm"><inertial pos="0 0 0" mass="1" {}/>
<joint name="j" damping=".1" armature=".1" frictionloss=".1"/></body></worldbody>
<actuator><motor name="j" joint="j"/></actuator></mujoco>"""
LINK = """<link name="{}"><inertial><mass value="{}"/>
<inertia ixx="1e-3" iyy="1e-3" izz="{}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size=".1 .1 .1"/></geometry></collision></link>"""
JOINT = """<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<origin xyz="0 0 .3"/><limit lower="-1" upper="1" effort="5" velocity="2"/></joint>"""
FILES = {
    "principal.xml": IMPOSSIBLE.format('diaginertia="1e-3 1e-3 9e-3"'),
    "whole.xml": IMPOSSIBLE.format('fullinertia="1e-3 5e-3 5e-3 0 0 4e-3"'),
    "arm.urdf": f'<robot name="r">{LINK.format("base", 1, 1e-3)}{LINK.format("arm", 1, 9e-3)}{JOINT}</robot>',
}


@pytest.mark.parametrize("name", FILES)
def test_an_inertia_that_mujoco_refuses_is_a_finding(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = tmp_path / name, tmp_path / "log.csv"
    file.write_text(FILES[name])
    times = np.arange(0.0, 3.0, 0.01)
    table, head = np.column_stack((times, np.sin(times), np.sin(times))), "time,position_j,command_effort_j"
    np.savetxt(log, table, delimiter=",", header=head, comments="")
    nothing = Expected((), (), (), {}, 0.0)
    monkeypatch.setattr("amhe_cli.estimation.design.expected.expected", lambda *_: nothing)
    for logs in ([], [str(log)]):
        assert run(["check", str(file), *logs, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["findings"]
        assert [one["what"] for one in found if one["kind"] == "file" and "inertia" in one["what"]] == [
            "no body has the inertia of arm; the nearest possible one is used"
        ], "the log's system is read from it, too"
    # audits and identifications of a bare model begin with this, too
    moments = compiled(proposed(file, [log]).spec).body("arm").inertia
    second = np.sort(0.5 * moments.sum() - moments)
    assert second == pytest.approx([1e-6, 4.5e-3, 4.5e-3], rel=1e-3), "no more changed than needed"


def test_a_flat_body_is_possible_whatever_the_rounding_of_its_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "flat.xml"
    file.write_text(IMPOSSIBLE.format('diaginertia="0.1 0.7 0.8"'))
    assert compiled(read_spec(file)).body("arm").inertia == pytest.approx([0.1, 0.7, 0.8], rel=1e-4)
    assert not caplog.text


def test_a_urdf_is_checked_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.urdf").write_text(FILES["arm.urdf"].replace('value="1"', 'value="42.9"'))
    assert run(["check", str(tmp_path / "arm.urdf")]) == 0
    assert "42.9 kg in a box of 100 x 100 x 100 mm: denser than lead" in capsys.readouterr().out
