"""What a log will tell is said before it is fitted, and holds against the fit."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.check.motion import motions, still
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
    for name, one in after.parameters.items():
        ratio = (1.0 - before[name].shrinkage) / (1.0 - one.shrinkage)
        assert 1 / 1.5 < ratio < 1.5, name
    same = [before[name].verdict == one.verdict for name, one in after.parameters.items()]
    assert sum(same) >= len(same) - 1


def test_a_joint_that_stands_still_is_named() -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(LOG, system)
    (moved,) = motions(system, [log])
    assert moved.joint == "hinge" and moved.high - moved.low > 1.0 and moved.speed > 1.0
    assert not list(still([moved]))
    (found,) = still([type(moved)("hinge", 0.0, 0.01, 0.01, 0.0, 0.005)])
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


def test_mistakes_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, text in (
        (["--require", "load_mass<5%"], "give a LOG"),
        ([str(LOG), "--require", "load_mass=5"], "NAME<5%"),
    ):
        assert run(["check", MODEL, *arguments]) == 2
        assert text in capsys.readouterr().err
