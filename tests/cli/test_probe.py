"""`amhe probe` from the outside: files, the chain to `amhe identify`, what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from amhe_cli.cli.main import run
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import Ending
from amhe_cli.engine.bounds import Broken
from amhe_cli.estimation.design.probe import ActuatorProbe
from amhe_cli.estimation.design.recipes import Recipe
from amhe_cli.logs import read_metadata, survey
from amhe_cli.report.numbers import percent
from amhe_cli.robots.go1.probing.motions import STEADY
from amhe_cli.robots.go1.probing.probe import PushProbe
from tests.cli.conftest import names
from tests.conftest import MODELS, PENDULUM_TRUTH

#: Little work: the plans need not be good.
QUICK = ["-q", "--threads", "1", "--config", "quick.yaml"]
QUICK_SETTINGS = "control: {samples: 5, horizon: 6, substeps: 1}\nprobe: {pairs: 0}\n"
PENDULUM = [
    *["probe", "--system", "pendulum", "--for", "3", "-q", "--threads", "1"],
    "--set",
    "probe.candidates=4",
]
#: One motion, for one value of the parameters.
ONE = ["--set", "probe.candidates=1", "--set", "probe.pairs=0"]


@pytest.fixture
def _one_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single motion is rehearsed; that the best of several is chosen is a test of its own room."""
    Path("quick.yaml").write_text(QUICK_SETTINGS)
    monkeypatch.setattr("amhe_cli.robots.go1.probing.probe.MOTIONS", (STEADY,))


def other_pendulum(path: Path) -> Path:
    """A pendulum with other parameters than the system's."""
    text = (MODELS / "pendulum" / "scene.xml").read_text()
    t = PENDULUM_TRUTH
    old = 'damping="0.02" frictionloss="0.02" armature="0.004"'
    new = f'damping="{t["damping"]}" frictionloss="{t["friction_loss"]}" armature="{t["armature"]}"'
    assert old in text and 'mass="0.4"' in text
    path.write_text(text.replace(old, new).replace('mass="0.4"', f'mass="{t["load_mass"]}"'))
    return path


@pytest.mark.medium
def test_a_plan_is_written_alone_and_expects_more_than_plain_motion_would_tell(capsys) -> None:
    assert run([*PENDULUM, "--dry-run", "-o", "plan"]) == 0
    assert names("plan") == ["plan.json"]
    plan = json.loads(Path("plan/plan.json").read_text())
    assert plan["system"] == "pendulum"
    assert sum(part["seconds"] for part in plan["sequence"]) == plan["probe_seconds"] == 3.0
    for row in plan["parameters"]:
        assert 0.0 < row["expected_sd"] < row["prior_sd"]
    assert "load_mass" in capsys.readouterr().out


@pytest.mark.medium
def test_the_probes_log_identifies_another_pendulum() -> None:
    plant = other_pendulum(Path("other.xml"))
    assert run([*PENDULUM, "--plant", str(plant), "-o", "probe"]) == 0
    assert names("probe") == ["plan.json", "probe.mcap", "report.html", "result.json"]
    assert "truth" not in read_metadata(Path("probe/probe.mcap"))
    less = ["-q", "--threads", "1"]
    assert run(["identify", "probe/probe.mcap", "-o", "found", *less]) == 0
    found = {row["name"]: row for row in json.loads(Path("found/result.json").read_text())["parameters"]}
    for name, truth in PENDULUM_TRUTH.items():
        assert found[name]["estimate"] == pytest.approx(truth, rel=0.1)
    achieved = {r["name"]: r for r in json.loads(Path("probe/result.json").read_text())["parameters"]}
    page = re.sub(r"<[^>]*>", "", Path("probe/report.html").read_text())
    assert "Probe of 3 s: multisine" in page and "sd of 4 of 4 parameters" in page
    for row in achieved.values():
        assert percent(row["expected_sd"]) in page and percent(row["achieved_sd"]) in page
    assert "joints.position" in page, "what was recorded"
    for name, row in found.items():
        assert 0.4 < achieved[name]["achieved_sd"] / (row["sd"] / row["estimate"]) < 2.5, "as identify has it"


@pytest.mark.medium
def test_a_plants_step_need_not_divide_the_commands_period() -> None:
    plant = other_pendulum(Path("other.xml"))
    text = plant.read_text()
    assert 'timestep="0.002"' in text
    plant.write_text(text.replace('timestep="0.002"', 'timestep="0.012"'))
    assert run([*PENDULUM, *ONE, "--plant", str(plant), "-o", "probe"]) == 0
    (commands,) = (t for t in survey(Path("probe/probe.mcap")).topics if "command" in t.name)
    assert commands.count == pytest.approx(250, abs=1)
    assert commands.rate == pytest.approx(83.0, rel=0.3), "a step of 12 ms takes each when it can"
    first, last = commands.first_ns["header"], commands.last_ns["header"]
    assert 1e-9 * (last - first) == pytest.approx(3.0, abs=0.04)


@pytest.mark.medium
def test_the_next_command_names_a_system_of_ones_own(capsys) -> None:
    shutil.copytree(MODELS / "pendulum", "mine")
    own = ["mine" if word == "pendulum" else word for word in (*PENDULUM, *ONE)]
    assert run([*own, "-o", "probe"]) == 0
    assert "next: amhe identify probe/probe.mcap --system mine" in capsys.readouterr().out
    assert run(["mhe-replay", "probe/probe.mcap", "-q", "--system", "mine", "-o", "replay"]) == 0
    shutil.move("mine", "elsewhere")
    assert run(["mhe-replay", "probe/probe.mcap", "-q", "-o", "again"]) == 2
    assert "about the system 'mine', which does not come with amhe" in capsys.readouterr().err
    assert run(["inspect", "probe/probe.mcap"]) == 0
    assert "about the system 'mine', which does not come with amhe" in capsys.readouterr().err


def test_a_recipe_writes_commands_for_a_robots_own_program(capsys) -> None:
    recipe = [*PENDULUM, *ONE, "--steps", "--set", "probe.speed=6"]
    assert run([*recipe, "-o", "steps"]) == 0
    files = [f"excitation.{kind}" for kind in ("csv", "mcap", "npz")]
    assert names("steps") == [*files, "plan.json", "probe.mcap", "report.html", "result.json"]
    (commands,) = survey(Path("steps/excitation.mcap")).topics
    assert commands.name == "/joint_commands" and commands.count == 300
    assert "steps 1" in capsys.readouterr().out
    assert run(["probe", "--chirp", "-q", "-o", "none"]) == 2
    assert "a recipe drives joints as they are: give the --system of its robot" in capsys.readouterr().err


@pytest.mark.medium
def test_plain_motion_that_cannot_be_done_is_no_number(monkeypatch, capsys) -> None:
    information = ActuatorProbe._information

    def only_quick(self: ActuatorProbe, one: Recipe, draws: FloatArray) -> FloatArray | Broken:
        return Broken("no room") if one.name == "slow sine" else information(self, one, draws)

    monkeypatch.setattr(ActuatorProbe, "_information", only_quick)
    assert run([*PENDULUM, *ONE, "--dry-run", "-o", "plan"]) == 0
    (row,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("load_mass"))
    assert row.split()[-1] == "–"
    assert "plain_sd" not in json.loads(Path("plan/plan.json").read_text())["parameters"][0]


@pytest.mark.medium
@pytest.mark.usefixtures("_one_motion")
def test_a_go1_probes_a_box_and_writes_a_log_of_its_own(capsys) -> None:
    assert run(["probe", "--for", "2", "--box", "3.5", "0.5", "-o", "probe", "--json", *QUICK]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == json.loads(Path("probe/result.json").read_text())
    assert {"schema_version", "command", "version", "seconds", "warnings"} <= set(result)
    assert result["sequence"][0]["name"] == "approach"
    assert result["probe_seconds"] == 2.0
    assert {row["name"] for row in result["parameters"]} >= {"box_mass", "floor_friction"}
    metadata = read_metadata(Path("probe/probe.mcap"))
    assert (metadata["system"], metadata["task"]) == ("go1_push", "t1")
    truth = json.loads(metadata["truth"])
    assert (truth["box_mass"], truth["floor_friction"]) == pytest.approx((3.5, 0.5)), "not those of t1"
    topics = {topic.name for topic in survey(Path("probe/probe.mcap")).topics}
    assert {"/joint_states", "/joint_commands", "/odom", "/box/odom", "/amhe/plan"} <= topics


@pytest.mark.medium
@pytest.mark.usefixtures("_one_motion")
def test_a_fall_is_a_failure_that_keeps_its_log(monkeypatch, capsys) -> None:
    rehearsed = PushProbe.run

    def falls(*arguments: Any) -> Ending:
        monkeypatch.setattr("amhe_cli.robots.go1.judge.FALLEN_HEIGHT", 10.0)
        return rehearsed(*arguments)

    monkeypatch.setattr(PushProbe, "run", falls)
    assert run(["probe", "--for", "2", "--box", "5", "0.5", "-o", "probe", *QUICK]) == 1
    assert "the robot fell" in capsys.readouterr().err
    assert names("probe") == ["plan.json", "probe.mcap", "report.html", "result.json"]
    assert json.loads(Path("probe/result.json").read_text())["error"].startswith("the robot fell")
    truth = json.loads(read_metadata(Path("probe/probe.mcap"))["truth"])
    assert (truth["box_mass"], truth["floor_friction"]) == pytest.approx((5.0, 0.5)), "that of --box"


@pytest.mark.medium
def test_falls_in_every_rehearsal_are_reported_before_anything_moves(monkeypatch, capsys) -> None:
    Path("quick.yaml").write_text(QUICK_SETTINGS)
    monkeypatch.setattr("amhe_cli.robots.go1.judge.FALLEN_HEIGHT", 10.0)
    assert run(["probe", "--for", "2", "-o", "probe", *QUICK]) == 1
    assert "no rehearsal reveals anything" in capsys.readouterr().err
