"""What a log will tell is said before it is fitted, and holds against the fit."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.check.motion import log_findings, motions
from amhe_cli.cli.main import run
from amhe_cli.estimation.design.expected import expected

ROOT = Path(__file__).parents[2]
LOG = ROOT / "examples" / "logs" / "pendulum.mcap"
MODEL = str(ROOT / "models" / "pendulum" / "scene.xml")


@pytest.mark.medium
def test_the_expected_sds_are_those_of_the_fit() -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(LOG, system)
    before = {p.name: p for p in expected(system, [log]).parameters}
    after = amhe.identify(system, log, threads=1)
    ratios = [(1.0 - before[name].shrinkage) / (1.0 - p.shrinkage) for name, p in after.parameters.items()]
    off = np.exp(np.abs(np.log(ratios)))
    assert np.median(off) < 1.5 and off.max() < 2.0
    same = [before[name].verdict == one.verdict for name, one in after.parameters.items()]
    assert sum(same) >= len(same) - 1


def test_a_joint_that_stands_still_is_named() -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(LOG, system)
    (moved,) = motions(system, [log])
    assert moved.joint == "hinge" and moved.high - moved.low > 1.0 and moved.speed > 1.0
    assert moved.band is not None and 0.5 < moved.band < 50.0
    assert not list(log_findings(system, [log], [moved]))
    (found,) = log_findings(system, [], [type(moved)("hinge", "rad", 0.0, 0.01, 0.01, 0.0, 1.0, 0.005)])
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


def test_the_command_says_what_to_expect(capsys: pytest.CaptureFixture[str]) -> None:
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


SERVO = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body name="rod" pos="0 0 0.2">
<joint name="hinge" axis="0 1 0" range="-3 3" damping="0.1" armature="0.01" frictionloss="0.01"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="20" forcerange="-1 1"/></actuator></mujoco>"""


def test_what_is_wrong_with_a_recording_stands_in_the_list(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A rod that its servo presses on the floor with all its force, with a silence of a fifth of the log."""
    times = np.arange(0.0, 12.0, 0.01)
    position = 0.3 + 0.42 * np.sin(1.5 * times)
    rows = np.column_stack((times, position, position + 0.2))[(times < 5.0) | (times > 7.5)]
    model, log = tmp_path / "rod.xml", tmp_path / "log.csv"
    model.write_text(SERVO)
    np.savetxt(
        log, rows, fmt="%.6g", delimiter=",", header="time,position_hinge,command_position_servo", comments=""
    )
    assert run(["check", str(model), str(log), "--json"]) == 0
    captured = capsys.readouterr()
    found = {one["kind"]: one for one in json.loads(captured.out)["findings"]}
    assert {"gaps", "saturated", "contact"} <= found.keys()
    assert found["saturated"]["where"] == "servo" and "100%" in found["saturated"]["what"]
    assert found["contact"]["where"] == "rod, world"
    assert all(one["cure"] for one in found.values())


def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, text in (
        (["--require", "load_mass<5%"], "give a LOG"),
        ([str(LOG), "--require", "load_mass=5"], "NAME<5%"),
    ):
        assert run(["check", MODEL, *arguments]) == 2
        assert text in capsys.readouterr().err
