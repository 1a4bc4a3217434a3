"""Torque logs: what `amhe init` proposes, and that it finds what the model lacks."""

import re
from pathlib import Path

import pytest

from amhe_cli.api.identify import identify
from amhe_cli.core.bundled import bundled_logs, bundled_models
from amhe_cli.init.folder import init_system
from amhe_cli.logs import read_log
from amhe_cli.system.system import System


def test_torques_without_commands_are_matched(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    notes = init_system(model, [log], tmp_path / "arm").sentences
    system = System.load(tmp_path / "arm", {"identify": {"profile_points": 0}, "clips": {"held_out": 0.0}})
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
