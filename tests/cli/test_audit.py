"""`amhe audit` from the outside: logs with torques, logs with commands, two files, a result."""

import json
import re
from html import unescape
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.audit.suspects import Explanation
from amhe_cli.cli import progress
from amhe_cli.cli.main import run
from amhe_cli.engine.inverse import forces_along
from amhe_cli.estimation.uncertainty import misfit
from amhe_cli.system.model.files import compiled, read_spec

ROOT = Path(__file__).parents[2]
ARM = """<mujoco><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.4" frictionloss="0.2" armature="0.02"/>
<inertial pos="0.15 0 0" mass="{upper}" diaginertia="0.001 0.012 0.012"/>
<body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="{damping}" frictionloss="0.1"/>
<inertial pos="0.12 0 0" mass="0.8" diaginertia="0.0005 0.006 0.006"/></body></body></worldbody>
<actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator></mujoco>"""


def spoilt(folder: Path, arm: str = ARM) -> tuple[Path, Path]:
    """A file whose upper mass and elbow damping are wrong, and a log of the robot with its torques."""
    truth = mujoco.MjModel.from_xml_string(arm.format(upper=1.2, damping=0.3))
    rng, t = np.random.default_rng(0), np.arange(0.0, 20.0, 0.01)
    w = 2.0 * np.pi * np.array([0.15, 0.4, 0.9])[:, None, None]
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 1, 2))
    moved = [
        (0.6 * (w / w[0]) ** -0.7 * w**k * np.sin(w * t[:, None] + phase + k * np.pi / 2)).sum(axis=0)
        for k in range(3)
    ]
    tau = forces_along(truth, *moved).needed + truth.dof_frictionloss * np.sign(moved[1])
    noisy = [moved[0] + 2e-4 * rng.standard_normal(tau.shape), tau + 0.05 * rng.standard_normal(tau.shape)]
    model, log = folder / "vendor.xml", folder / "log.csv"
    model.write_text(ARM.format(upper=3.6, damping=3.0))
    names = [f"{kind}_{joint}" for kind in ("position", "effort") for joint in ("shoulder", "elbow")]
    np.savetxt(
        log,
        np.column_stack((t, *noisy)),
        delimiter=",",
        header=",".join(("time", *names)),
        comments="",
        fmt="%.6g",
    )
    return model, log


@pytest.fixture(scope="module")
def audited(tmp_path_factory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("audit")
    model, log = spoilt(folder)
    assert run(["audit", str(model), str(log), "-o", str(folder / "out"), "--threads", "1", "-q"]) == 0
    return folder / "out", json.loads((folder / "out" / "audit.json").read_text())


@pytest.mark.medium
def test_spoilt_numbers_are_contradicted_and_right_ones_are_not(audited) -> None:
    _, record = audited
    wrong = {line["parameter"]: line for line in record["numbers"] if line["verdict"] == "contradicted"}
    assert record["match"] == "effort"
    assert set(wrong) == {"upper_mass", "elbow_damping"}
    for name, truth in (("upper_mass", 1.2), ("elbow_damping", 0.3)):
        assert abs(wrong[name]["log"] - truth) < 3.0 * wrong[name]["sd"]
    verdicts = {line["parameter"]: line["verdict"] for line in record["numbers"]}
    assert verdicts["lower_mass"] == verdicts["shoulder_damping"] == "agrees"
    assert verdicts["upper_center_of_mass_y"] == "cannot tell"  # along the axis
    assert [line["cure"] for line in record["numbers"] if line["verdict"] == "cannot tell"].count("") == 0
    zeros = {one["name"]: one for one in record["beside"]}
    assert set(zeros) == {"shoulder_torque_offset", "elbow_torque_offset"}
    assert all(abs(one["estimate"]) < 3.0 * one["sd"] < one["prior_sd"] for one in zeros.values())


@pytest.mark.medium
def test_what_there_is_when_the_time_is_over_is_written(tmp_path: Path, capsys, monkeypatch) -> None:
    """The first search has no time to end: nothing is judged, and files and terminal say why."""
    monkeypatch.setattr(progress, "PLAIN_PERIOD", 0.0)
    model, log = spoilt(tmp_path)
    out = tmp_path / "out"
    assert run(["audit", str(model), str(log), "-o", str(out), "--max-time", "0.01", "--threads", "1"]) == 0
    said, record = capsys.readouterr(), json.loads((out / "audit.json").read_text())
    why = "the search did not end (it had 0.01 s), and its values are the best so far"
    assert {(line["verdict"], line["cure"]) for line in record["numbers"]} == {("cannot tell", why)}
    assert record["unsearched"] == why and not record["interrupted"] and said.out.count(f"\n{why}\n") == 1
    assert said.err.count("--max-time of 0.01 s stopped the search") == 1
    assert why[1:] in unescape((out / "report.html").read_text())


@pytest.mark.medium
def test_ctrl_c_keeps_the_verdicts_that_rest_on_no_other_search(tmp_path: Path, capsys, monkeypatch) -> None:
    """It comes while something else than a mass is looked for; a damping is wrong whatever else is."""

    def rival(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Explanation, "rival", rival)
    monkeypatch.setattr(progress, "PLAIN_PERIOD", 0.0)
    model, log = spoilt(tmp_path)
    out = tmp_path / "out"
    assert run(["audit", str(model), str(log), "-o", str(out), "--threads", "1"]) == 130
    said, record = capsys.readouterr(), json.loads((out / "audit.json").read_text())
    lines = {line["parameter"]: line for line in record["numbers"]}
    why = "what else explains the logs was not searched for to the end (it was interrupted)"
    assert lines["elbow_damping"]["verdict"] == "contradicted"
    assert (lines["upper_mass"]["verdict"], lines["upper_mass"]["cure"]) == ("cannot tell", why)
    assert record["interrupted"] and record["unsearched"] == why and f"\n{why}\n" in said.out
    assert (out / "report.html").is_file()
    model = mujoco.MjModel.from_xml_path(str(out / "robot.audited.xml"))
    assert model.joint("elbow").damping[0] < 1.0 and model.body("upper").mass[0] == 3.6
    steps = [int(one) for one in re.findall(r"amhe audit: step (\d+): ", said.err)]
    assert len(steps) > 5 and steps == list(range(1, len(steps) + 1))


def test_the_written_file_has_the_numbers_of_the_log(audited) -> None:
    folder, record = audited
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.audited.xml"))
    said = {line["parameter"]: line["log"] for line in record["numbers"]}
    assert model.body("upper").mass[0] == pytest.approx(said["upper_mass"], rel=1e-4)
    assert model.joint("elbow").damping[0] == pytest.approx(said["elbow_damping"], rel=1e-4)
    assert model.body("lower").mass[0] == 0.8
    assert model.joint("elbow").armature[0] == 0.0
    text = (folder / "robot.audited.xml").read_text()
    assert "mass 3.6 -> " in text and "by amhe audit of log.csv" in text
    assert (folder / "report.html").is_file()


URDF = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0.15 0 0"/><mass value="3.6"/>{upper}</inertial></link>
<link name="lower"><inertial><origin xyz="0.12 0 0"/><mass value="0.8"/>{lower}</inertial></link>
<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<dynamics damping="0.4" friction="0.2"/></joint>
<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<origin xyz="0.3 0 0"/><dynamics damping="3.0" friction="0.1"/></joint></robot>"""


@pytest.mark.medium
def test_a_urdf_keeps_its_text_but_for_what_was_contradicted(tmp_path: Path, capsys) -> None:
    _, log = spoilt(tmp_path, ARM.replace(' armature="0.02"', ""))  # a URDF says nothing of armatures
    inertia = '<inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/>'
    bodies = {"upper": (0.001, 0.012, 0.012), "lower": (0.0005, 0.006, 0.006)}
    file, out = tmp_path / "vendor.urdf", tmp_path / "out"
    file.write_text(URDF.format(**{name: inertia.format(*values) for name, values in bodies.items()}))
    assert run(["audit", str(file), str(log), "-o", str(out), "-q", "--threads", "1", "--json"]) == 0
    lines = {one["parameter"]: one for one in json.loads(capsys.readouterr().out)["numbers"]}
    assert lines["upper_mass"]["verdict"] == lines["elbow_damping"]["verdict"] == "contradicted"
    text = (out / "robot.audited.urdf").read_text()
    assert "mass 3.6 -> 1." in text and "damping 3 -> 0.3" in text and "by amhe audit of log.csv" in text
    model = compiled(read_spec(out / "robot.audited.urdf"), "urdf")
    for name, value, truth in (
        ("upper_mass", model.body("upper").mass[0], 1.2),
        ("elbow_damping", model.joint("elbow").damping[0], 0.3),
    ):
        assert value == pytest.approx(lines[name]["log"], rel=1e-4)
        assert abs(value - truth) < 3.0 * lines[name]["sd"]
    assert model.body("lower").mass[0] == 0.8


@pytest.mark.medium
def test_a_log_that_no_value_explains(tmp_path: Path, capsys, monkeypatch) -> None:
    """Nothing is judged: page and terminal have the same reason, setting and offsets, and JSON no junk."""
    model, log = spoilt(tmp_path)
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    monkeypatch.setattr(misfit, "NOISY", np.inf)  # however much is missed, noise is offered
    rows[:, 3:] += 3.0 * np.sin(7.3 * rows[:, :1])
    head, out = log.read_text().split("\n")[0], tmp_path / "out"
    np.savetxt(log, rows, fmt="%.6g", delimiter=",", header=head, comments="")
    assert run(["audit", str(model), str(log), "-o", str(out), "-q", "--threads", "1"]) == 0
    said, page = capsys.readouterr().out, unescape((out / "report.html").read_text())
    assert "0 contradicted, 0 agree" in said
    assert "These logs contradict no number of the file, and confirm none." in page
    assert not re.search(r"<tbody>\s*</tbody>", page)
    advice, plain = re.findall(r"--set signals\.torque\.noise\.effort=\S+", said), re.sub("<[^>]+>", "", page)
    assert advice and all(one in plain for one in advice)
    for offset in ("shoulder_torque_offset", "elbow_torque_offset"):
        assert offset in said and offset in page
    numbers = json.loads((out / "audit.json").read_text())["numbers"]
    (along,) = [one for one in numbers if one["parameter"] == "upper_center_of_mass_y"]
    assert along["log"] is along["sd"] is None
    assert all(one["sd"] is None or one["sd"] < max(abs(one["file"]), abs(one["log"])) for one in numbers)


@pytest.mark.medium
def test_names_choose_what_is_written(tmp_path: Path) -> None:
    model, log = spoilt(tmp_path)
    out = tmp_path / "out"
    assert (
        run(["audit", str(model), str(log), "-o", str(out), "--write", "elbow_*", "-q", "--threads", "1"])
        == 0
    )
    written = mujoco.MjModel.from_xml_path(str(out / "robot.audited.xml"))
    assert written.body("upper").mass[0] == 3.6
    assert written.joint("elbow").frictionloss[0] == pytest.approx(0.1, abs=0.02)


@pytest.mark.medium
def test_torque_sensors_that_are_not_at_zero_and_a_tool(tmp_path: Path, capsys) -> None:
    """The bundled arm: the true mass of link 7 with its tool is 1.5 kg, its centre at 0.133 m."""
    arguments = ["audit", "example:arm_torque", "example:arm_torque", "-o", str(tmp_path / "out"), "-q"]
    assert run([*arguments, "--threads", "1", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    lines = {line["parameter"]: line for line in record["numbers"]}
    assert lines["link7_mass"]["verdict"] == lines["joint7_friction_loss"]["verdict"] == "contradicted"
    for name, truth in (("link7_mass", 1.5), ("link7_center_of_mass_z", 0.1333)):
        assert abs(lines[name]["log"] - truth) < 2.0 * lines[name]["sd"] < 0.3 * truth
    frictions = [lines[f"joint{k}_damping"]["log"] for k in range(1, 8)]
    assert np.allclose(frictions, [0.6, 0.8, 0.5, 0.7, 0.3, 0.2, 0.15], rtol=0.1)


def test_two_files(tmp_path: Path, capsys) -> None:
    model, _ = spoilt(tmp_path)
    other = tmp_path / "mine.xml"
    other.write_text(ARM.format(upper=1.2, damping=3.0))
    assert run(["audit", str(model), str(other)]) == 0
    shown = capsys.readouterr().out
    assert "upper" in shown and "0.33" in shown and "numbers that differ: 1;" in shown
    assert run(["audit", str(model), str(other), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [(d["of"], d["what"]) for d in record["differences"]] == [("upper", "mass")]


@pytest.mark.medium
def test_a_command_that_counts_from_another_zero(tmp_path: Path, capsys) -> None:
    """Without it no value would explain the log: what is off is constant, and 40 times the noise."""
    text = """<mujoco><option timestep="0.002"/><worldbody><body name="arm">
    <joint name="hinge" axis="0 1 0" damping="0.1" armature="0.01" frictionloss="0.02"/>
    <inertial pos="0 0 -.2" mass="0.5" diaginertia="2e-3 2e-3 1e-4"/></body></worldbody>
    <actuator><position name="servo" joint="hinge" kp="6" kv="0.2"/></actuator></mujoco>"""
    (tmp_path / "arm.xml").write_text(text)
    model, rng = mujoco.MjModel.from_xml_string(text), np.random.default_rng(3)
    data, rows, phase = mujoco.MjData(model), list[tuple[float, float, float]](), rng.uniform(0.0, 6.0, 6)
    for k in range(1200):
        command = 0.4 * np.sin(2.0 * np.pi * np.geomspace(0.2, 2.0, 6) * 0.01 * k + phase).sum()
        rows.append((0.01 * k, data.qpos[0] + rng.normal(0.0, 5e-4), command - 0.02))
        data.ctrl[0] = command
        mujoco.mj_step(model, data, 5)
    np.savetxt(
        tmp_path / "log.csv", rows, delimiter=",", header="time,position_hinge,command_hinge", comments=""
    )
    files = [str(tmp_path / name) for name in ("arm.xml", "log.csv")]
    assert run(["audit", *files, "-o", str(tmp_path / "out"), "--json", "--threads", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    (zero,) = [one for one in found["beside"] if one["name"] == "servo_command_offset"]
    assert zero["estimate"] == pytest.approx(-0.02, abs=4.0 * zero["sd"]) and zero["sd"] < 0.005
    assert {line["verdict"] for line in found["numbers"]} == {"agrees", "cannot tell"}


@pytest.mark.medium
def test_a_result_against_a_file(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    scene = ROOT / "models" / "pendulum" / "scene.xml"
    folder = tmp_path / "found"
    assert run(["identify", str(pendulum_log), "-o", str(folder), "-q", "--threads", "1"]) == 0
    capsys.readouterr()
    vendor = tmp_path / "vendor.xml"
    spec = mujoco.MjSpec.from_file(str(scene))
    for body in spec.bodies:
        for geom in body.geoms:
            geom.mass *= 5.0
        body.mass *= 5.0
    for joint in spec.joints:
        joint.armature = 0.0  # the file leaves it out
        joint.damping = 5.0 * np.array(joint.damping)
    vendor.write_text(spec.to_xml())
    assert run(["audit", str(folder), "--against", str(vendor), "--json"]) == 0
    lines = json.loads(capsys.readouterr().out)["numbers"]
    assert "contradicted" in {line["verdict"] for line in lines if line["what"] == "mass"}
    (drag,) = [line for line in lines if line["what"] == "damping"]
    assert drag["verdict"] == "contradicted" and drag["t"] < -2.7  # as shares of the file, 0.8 / 0.3 at most
    (left_out,) = [line for line in lines if line["what"] == "armature"]
    assert left_out["file"] == 0.0 and 0.1 < left_out["t"] < 10.0  # a zero is not exact


def test_other_arguments_are_refused(tmp_path: Path, capsys) -> None:
    model, log = spoilt(tmp_path)
    assert run(["audit", str(model)]) == 2
    assert "RESULT --against FILE" in capsys.readouterr().err
    assert run(["audit", "example:arm", "example:arm", "--set", "clips.no_such=8"]) == 2
    assert "no key 'no_such'" in capsys.readouterr().err
    for what, model_and_log in (("effort", ("example:arm",) * 2), ("motion", (str(model), str(log)))):
        assert run(["audit", *model_and_log, "--match", what]) == 2
        assert f"--match {what}: these logs can only be compared by " in capsys.readouterr().err


SERVO = """<mujoco><option timestep='0.002'/><worldbody><body name='arm'>
<joint name='elbow' axis='0 1 0' damping='0.2' armature='0.01'/>
<inertial pos='0.2 0 0' mass='0.5' diaginertia='0.001 0.004 0.004'/></body></worldbody>
<actuator><position name='elbow' joint='elbow' kp='12' kv='0.1'/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("steps", [False, True], ids=["waves", "steps"])
def test_the_load_that_a_servo_reports_is_no_torque(steps: bool, tmp_path: Path, capsys) -> None:
    """Where no value explains what a log has as torques, the motion under its commands is compared."""
    rng, model, times = np.random.default_rng(0), mujoco.MjModel.from_xml_string(SERVO), np.arange(0, 5, 0.01)
    data, targets = mujoco.MjData(model), 0.5 * np.sin(3.0 * times) + 0.3 * np.sin(9.0 * times)
    load, rows = 3.0 * np.sin(3.7 * times), []
    for time, target, said in zip(times, targets, np.sign(load) if steps else load, strict=True):
        rows.append((time, data.qpos[0] + 3e-4 * rng.standard_normal(), said, target))
        data.ctrl[0] = target
        mujoco.mj_step(model, data, 5)
    file, log, out = tmp_path / "arm.xml", tmp_path / "log.csv", tmp_path / "out"
    file.write_text(SERVO)
    head = "time,position_elbow,effort_elbow,command_position_elbow"
    np.savetxt(log, np.array(rows), fmt="%.6g", delimiter=",", header=head, comments="")
    assert run(["audit", str(file), str(log), "-o", str(out), "-q", "--threads", "1"]) == 0
    assert "the motion under the commands is compared instead" in capsys.readouterr().err
    record = json.loads((out / "audit.json").read_text())
    assert record["match"] == "motion"
    assert "contradicted" not in {line["verdict"] for line in record["numbers"]}
