"""`amhe run` from the outside: files, streams, exit codes, interruption."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from amhe_cli.cli import run as command
from amhe_cli.cli.main import run
from amhe_cli.control.tasks import TASKS
from amhe_cli.logs import read_metadata
from amhe_cli.run_assembly import MODES

ROOT = Path(__file__).parents[2]

#: Little work: the plans need not be good.
QUICK = ["--duration", "0.6", "-q", "--set", "control.samples=4", "--set", "control.horizon=8"]


def names(folder: str | Path) -> list[str]:
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands write below the folder that they are run in."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of one quick run."""
    out = tmp_path_factory.mktemp("run") / "out"
    assert run(["run", "--task", "t1", "--seed", "3", "-o", str(out), "--threads", "1", *QUICK]) == 0
    return out


def test_the_choices_of_the_options_are_those_of_the_library() -> None:
    assert tuple(TASKS) == command.TASKS
    assert MODES == command.MODES


def test_result_json_has_the_keys_of_every_command_and_its_own(done: Path) -> None:
    record = json.loads((done / "result.json").read_text())
    assert {"schema_version", "command", "version", "seconds", "warnings"} <= set(record)
    assert {"task", "mode", "target", "seed", "success", "on_time", "fell", "goal_error_m"} <= set(record)
    assert {"cost", "time_s", "speed_rmse", "path_rmse_m", "deadline_misses", "diverged"} <= set(record)
    assert {"p50", "p99"} == set(record["cycle_ms"])
    assert (record["task"], record["mode"], record["target"], record["seed"]) == ("t1", "true", "sim", 3)
    assert record["belief"] == record["truth"]
    assert record["truth"]["box_mass"] == pytest.approx(4.0)
    assert record["cycles"] == 30
    assert record["success"] is record["fell"] is record["interrupted"] is False


def test_the_log_says_what_it_is_of(done: Path) -> None:
    said = read_metadata(done / "log.mcap")
    assert (said["system"], said["task"], said["mode"], said["seed"]) == ("go1_push", "t1", "true", "3")
    assert json.loads(said["truth"])["floor_friction"] == pytest.approx(0.6)


def test_json_on_stdout_is_result_json(capsys) -> None:
    arguments = ["run", "--task", "t5", "--mode", "baseline", "-o", "out", "--json", *QUICK]
    assert run(arguments) == 0
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads(Path("out/result.json").read_text())
    assert record["belief"]["box_mass"] == 2.0


def test_the_table_is_on_stdout_and_progress_on_stderr(capsys) -> None:
    assert run(["run", "--task", "t1", *(word for word in QUICK if word != "-q")]) == 0
    out, err = capsys.readouterr()
    assert "not done in the 0.6 s" in out
    assert "report: amhe-out/run-" in out
    assert "m from the goal" in err
    assert not Path("MUJOCO_LOG.TXT").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--task", "t9"], "t9"),
        ([], "--task"),
        (["--task", "t1", "--mode", "stale"], "no stale belief"),
        (["--task", "t1", "--target", "go1"], "go1"),
        (["--task", "t1", "--duration", "0"], "duration"),
        (["--task", "t1", "--belief", "nowhere.yaml"], "nowhere.yaml"),
        (["--task", "t1", "--mode", "baseline", "--belief", "rubbish"], "rubbish"),
        (["--task", "t1", "--plant", "rubbish"], "rubbish"),
        (["--task", "t1", "--plant", "pendulum.xml"], "joint"),
        (["--task", "t1", "--set", "control.horizn=4"], "did you mean 'horizon'"),
        (["--task", "t1", "--set", "control.samples=1"], "control.samples"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(capsys, arguments, said) -> None:
    Path("rubbish").write_text("{]")
    Path("pendulum.xml").write_text((ROOT / "models/pendulum/scene.xml").read_text())
    assert run(["run", *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert len(err.splitlines()) == 1
    assert names(".") == ["pendulum.xml", "rubbish"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_keeps_what_it_has(number: int, code: int) -> None:
    command = [sys.executable, "-m", "amhe_cli", "run", "--task", "t1", "-o", "out", "--threads", "1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, env=environment, **pipes) as process:
        assert process.stderr is not None
        assert "from the goal" in process.stderr.readline()
        time.sleep(1.0)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    assert process.returncode == code, err
    assert "interrupted" in out
    assert json.loads(Path("out/result.json").read_text())["interrupted"] is True
    assert run(["inspect", "out/log.mcap", "--strict"]) == 0
