"""Torque logs: what `amhe init` proposes, and that it finds what the model lacks."""

from pathlib import Path

import pytest

from amhe_cli.api.identify import identify
from amhe_cli.core.bundled import bundled_logs, bundled_models
from amhe_cli.init.folder import init_system
from amhe_cli.logs import read_log
from amhe_cli.system.system import System


def test_torques_without_commands_are_matched(tmp_path: Path) -> None:
    model, log = bundled_models()["arm_torque"], bundled_logs()["arm_torque"]
    notes = init_system(model, [log], tmp_path / "arm")
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
    notes = init_system(model, [tmp_path / "still.csv"], tmp_path / "arm")
    assert System.load(tmp_path / "arm", warn=False).match == "motion"
    assert any("they can drive the model" in note for note in notes)
