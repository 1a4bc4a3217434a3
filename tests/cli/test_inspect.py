"""`amhe inspect` from the outside."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.cli.main import run


def test_it_lists_topics_and_holds_the_log_against_its_system(pendulum_log: Path, capsys) -> None:
    assert run(["inspect", str(pendulum_log)]) == 0
    out, err = capsys.readouterr()
    for text in ("/joint_states", "sensor_msgs/JointState", "250 Hz", "for system pendulum", "usable: 8 s"):
        assert text in out
    assert err == ""


def test_it_says_what_is_missing_with_the_nearest_name(pendulum_log: Path, capsys) -> None:
    arguments = ["inspect", str(pendulum_log), "--topic", "joints=/joint_state"]
    assert run(arguments) == 4, "not usable"
    assert "did you mean '/joint_states'" in capsys.readouterr().out


@pytest.mark.medium
def test_json_is_one_object(pendulum_log: Path, capsys) -> None:
    assert run(["inspect", str(pendulum_log), str(pendulum_log), "--json", "-o", "it.json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads(Path("it.json").read_text())
    assert record["command"] == "inspect"
    assert len(record["logs"]) == 2
    log = record["logs"][0]
    assert [topic["name"] for topic in log["topics"]] == ["/joint_commands", "/joint_states"]
    assert log["usable"] is True
    assert [signal["problem"] for signal in log["signals"]] == [None, None]


def test_a_part_of_the_log(pendulum_log: Path, capsys) -> None:
    assert run(["inspect", str(pendulum_log), "--from", "1", "--to", "3"]) == 0
    assert "usable: 2 s" in capsys.readouterr().out


def test_a_truncated_log_is_shown_and_its_damage_reported(pendulum_log: Path, tmp_path: Path, capsys) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(pendulum_log.read_bytes()[: pendulum_log.stat().st_size * 2 // 3])
    assert run(["inspect", str(cut), "--strict"]) == 3
    assert "damage: " in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"", b"hello", bytes(2000)])
def test_what_is_no_log_is_one_line(tmp_path: Path, capsys, content) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    assert run(["inspect", str(path)]) == 4
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1


def test_a_part_needs_a_system(tmp_path_factory, capsys) -> None:
    from tests.conftest import write_pendulum_log

    log = write_pendulum_log(tmp_path_factory.mktemp("logs") / "nameless.mcap", 0.2)
    assert run(["inspect", str(log)]) == 0
    assert "for system" not in capsys.readouterr().out
    assert run(["inspect", str(log), "--from", "0.1"]) == 2


def test_a_log_about_an_unknown_system_shows_its_topics_and_the_name(tmp_path: Path, capsys) -> None:
    from tests.conftest import write_pendulum_log

    log = write_pendulum_log(tmp_path / "log.mcap", 0.2, system="/home/me/mine")
    assert run(["inspect", str(log)]) == 0
    out, err = capsys.readouterr()
    assert "/joint_states" in out
    assert "about the system '/home/me/mine', which does not come with amhe: with --system DIR" in err
    assert run(["identify", str(log)]) == 2


ARM = """<mujoco><option timestep="0.002"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body><joint name="arm" axis="0 0 1" damping="0.01" armature="0.001"/>
<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.008" mass="0.1"/><body pos="0.2 0 0">
<joint name="pendulum" axis="1 0 0" damping="0.0005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.006" mass="0.08"/></body></body></worldbody>
<actuator><general name="motor" joint="arm" gainprm="0.1" biastype="affine" biasprm="0 0 -0.01"/></actuator>
</mujoco>"""


@pytest.mark.medium
def test_a_sign_is_named_before_a_fit_and_mended_by_one_key(tmp_path: Path, capsys) -> None:
    """A motor's voltage, and joints in columns of their own names, one with the other sign."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, rows = mujoco.MjData(model), []
    hertz = np.geomspace(0.4, 2.5, 6)
    for k in range(1000):
        u = float(np.sin(2.0 * np.pi * hertz * 0.01 * k + np.arange(6.0)).sum()) - data.qpos[0]
        rows.append([0.01 * k, data.qpos[0], -data.qpos[1], u, 25.0])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 5)
    (tmp_path / "robot.xml").write_text(ARM)
    log, system = tmp_path / "log.csv", tmp_path / "system"
    head = "time,arm,pendulum,voltage,temperature"
    np.savetxt(log, rows, delimiter=",", header=head, comments="")

    assert run(["init", str(tmp_path / "robot.xml"), str(log), "-o", str(system)]) == 0

    out = capsys.readouterr().out
    assert "columns that no signal reads: temperature" in out
    assert "the log's pendulum has the other sign: put right, " in out and "reversed: [pendulum]" in out
    text = (system / "system.yaml").read_text()
    assert "columns: {effort: [voltage]}" in text
    whole = text.replace("joints: [arm, pendulum]", "joints: [arm, pendulum]\n    reversed: [pendulum]")
    (system / "system.yaml").write_text(whole)
    assert run(["inspect", str(log), "--system", str(system)]) == 0
    assert "other sign" not in capsys.readouterr().out
