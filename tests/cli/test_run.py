"""`amhe run` from the outside: files, streams, exit codes, interruption."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path

import pytest
from mcap.writer import Writer

from amhe_cli.cli import options
from amhe_cli.cli.main import run
from amhe_cli.logs import read_metadata, survey
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.run import MODES
from amhe_cli.robots.go1.tasks import LONGEST, TASKS
from tests.cli.conftest import BELIEF, names
from tests.web.figures import panels

ROOT = Path(__file__).parents[2]

#: Little work: the plans need not be good.
QUICK = ["--duration", "0.6", "-q", "--set", "control.samples=5", "--set", "control.horizon=8"]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of one quick run; what it printed lies beside it."""
    out = tmp_path_factory.mktemp("run") / "out"
    options = ["--mode", "true", "--seed", "3", "-o", str(out), "--threads", "1", "--json", *QUICK]
    with redirect_stdout(StringIO()) as printed:
        assert run(["run", "--task", "t1", *options]) == 0
    out.with_suffix(".json").write_text(printed.getvalue())
    return out


def test_the_choices_of_the_options_are_those_of_the_library() -> None:
    assert tuple(TASKS) == options.TASKS
    assert MODES == options.MODES
    assert LONGEST == options.LONGEST


def test_result_json_has_the_keys_of_every_command_and_its_own(done: Path) -> None:
    record = json.loads((done / "result.json").read_text())
    assert json.loads(done.with_suffix(".json").read_text()) == record
    assert {"schema_version", "command", "version", "seconds", "warnings"} <= set(record)
    assert {"task", "mode", "target", "seed", "success", "arrived", "on_time", "fell", "goal_error_m"} <= set(
        record
    )
    assert {"cost", "time_s", "speed_rmse", "path_rmse_m", "deadline_misses", "diverged"} <= set(record)
    assert {"p50", "p99"} == set(record["cycle_ms"])
    assert (record["task"], record["mode"], record["target"], record["seed"]) == ("t1", "true", "sim", 3)
    assert record["belief"] == record["truth"]
    assert record["truth"]["box_mass"] == pytest.approx(4.0)
    assert record["cycles"] == 30
    assert record["success"] is record["fell"] is record["interrupted"] is False


@pytest.mark.medium
def test_an_adaptive_run_tells_of_its_estimator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    more = ["--duration", "1.3", "--set", "mhe.update_period=0.3", "--set", "mhe.samples=6"]
    assert run(["run", "--task", "t1", "-o", "out", *QUICK, *more]) == 0
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["mode"] == "adaptive"
    assert record["estimator"]["updates"] == 3  # windows end at 0.52, 0.82 and 1.12 s
    assert set(record["estimator"]["sd"]) == set(record["belief"])
    assert record["estimator"]["troubles"] == []
    assert "/amhe/estimate" in {t.name for t in survey(tmp_path / "out" / "log.mcap").topics}
    assert "90 % interval" in (tmp_path / "out" / "report.html").read_text()


def test_the_log_says_what_it_is_of(done: Path) -> None:
    metadata = read_metadata(done / "log.mcap")
    assert (metadata["system"], metadata["task"], metadata["mode"], metadata["seed"]) == (
        "go1_push",
        "t1",
        "true",
        "3",
    )
    assert json.loads(metadata["truth"])["floor_friction"] == pytest.approx(0.6)


def test_the_report_is_one_page_that_needs_no_network(done: Path) -> None:
    page = (done / "report.html").read_text()
    assert "T1: single-goal push" in page
    assert len(panels(page)) == 7
    for loading in ("<script src", "fetch(", "<link", "src=", "url(http", "@import"):
        assert loading not in page


@pytest.mark.medium
def test_a_belief_of_a_file_is_believed_the_table_is_on_stdout_and_progress_on_stderr(capsys) -> None:
    Path("belief.yaml").write_text(BELIEF.format(system="go1_push", mass=5.5))
    arguments = ["run", "--task", "t1", "--mode", "baseline", "--belief", "belief.yaml"]
    assert run([*arguments, *(word for word in QUICK if word != "-q")]) == 0
    out, err = capsys.readouterr()
    assert "stopped after 0.6 s, before the task was done" in out
    assert "report: amhe-out/run-" in out
    assert "m from the goal" in err
    assert not Path("MUJOCO_LOG.TXT").exists()
    (result,) = Path("amhe-out").glob("run-*/result.json")
    assert json.loads(result.read_text())["belief"]["box_mass"] == 5.5


def test_a_fall_is_a_failure_that_keeps_its_log(monkeypatch, capsys) -> None:
    monkeypatch.setattr("amhe_cli.robots.go1.judge.FALLEN_HEIGHT", 10.0)
    assert run(["run", "--task", "t1", "-o", "out", *QUICK]) == 1
    out, err = capsys.readouterr()
    assert "the robot fell" in out
    assert err.splitlines() == ["amhe run: error: the robot fell; the log is kept in out"]
    record = json.loads(Path("out/result.json").read_text())
    assert record["fell"] is True
    assert record["cycles"] == 1
    assert not survey(Path("out/log.mcap")).problems


@pytest.mark.parametrize("cycles", [0, 5])
def test_a_plant_that_diverges_is_a_failure_that_keeps_its_log(monkeypatch, capsys, cycles: int) -> None:
    advance = Plant.advance

    def diverging(plant: Plant, *arguments):
        if plant.time >= 0.02 * cycles - 1e-6:
            plant._data.qvel[:] = 1e12
        return advance(plant, *arguments)

    monkeypatch.setattr(Plant, "advance", diverging)
    assert run(["run", "--task", "t1", "-o", "out", *QUICK]) == 1
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    assert "the plant diverged" in err
    assert names("out") == ["log.mcap", "report.html", "result.json"]
    record = json.loads(Path("out/result.json").read_text())
    assert "the plant diverged" in record["error"]
    assert record["cycles"] == cycles
    assert not survey(Path("out/log.mcap")).problems


@pytest.mark.medium
def test_a_fault_of_the_page_costs_no_log_and_is_one_line(monkeypatch, capsys) -> None:
    def broken(*arguments: object) -> str:
        raise RuntimeError("no page")

    monkeypatch.setattr("amhe_cli.report.run.run_page", broken)
    assert run(["run", "--task", "t1", "-o", "out", *QUICK]) == 1
    assert names("out") == ["log.mcap", "result.json"]
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "no page" in line]
    assert line.startswith("amhe run: error: report.html could not be made (RuntimeError: no page)")


@pytest.mark.medium
@pytest.mark.usefixtures("hangs_up")
def test_an_interrupted_run_keeps_what_it_has() -> None:
    command = [sys.executable, "-m", "amhe_cli", "run", "--task", "t1", "-o", "out", "--threads", "1"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, text=True, env=environment, stdout=pipe, stderr=pipe) as process:
        assert process.stderr is not None
        assert "from the goal" in process.stderr.readline()
        time.sleep(1.0)
        process.send_signal(signal.SIGHUP)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 143, err
    assert "interrupted" in out
    assert json.loads(Path("out/result.json").read_text())["interrupted"] is True
    assert run(["inspect", "out/log.mcap", "--strict"]) == 0


@pytest.mark.medium
def test_an_estimator_that_is_late_is_warned_of(capsys) -> None:
    few = ["--duration", "0.9", "--threads", "1", *QUICK, "-o", "late", "--strict"]
    often = ["--set", "mhe.update_period=0.05", "--set", "mhe.latency=0.12"]
    assert run(["run", "--task", "t1", "--mode", "adaptive", *few, *often]) == 3
    warnings = json.loads(Path("late/result.json").read_text())["warnings"]
    assert any("the estimator is late" in text for text in warnings)
    assert "the estimator is late" in capsys.readouterr().err


@pytest.mark.parametrize(("size", "messages"), [(20_000, 0), (40_000, 10)], ids=["at once", "later"])
def test_a_full_disk_ends_a_run_and_keeps_its_log(monkeypatch, capsys, size: int, messages: int) -> None:
    """All but the last chunk, which is of 3 s or so of a run; here they are smaller."""
    monkeypatch.setattr("amhe_cli.logs.messages.writer.Writer", partial(Writer, chunk_size=20_000))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        assert run(["run", "--task", "t1", "--mode", "true", "-o", "out", "--threads", "1", *QUICK]) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    err = capsys.readouterr().err
    assert err.endswith("/out/log.mcap: File too large\n")
    assert names("out") == ["log.mcap"]
    assert sum(topic.count for topic in survey(Path("out/log.mcap")).topics) >= messages


@pytest.mark.medium
def test_the_advice_of_a_limit_is_an_option_of_the_command(capsys) -> None:
    Path("belief.yaml").write_text(BELIEF.format(system="pendulum", mass=5.5))
    arguments = ["--task", "t1", "--mode", "baseline", "--belief", "belief.yaml", "-q"]
    assert run(["run", *arguments, "--limit", "yaml_values=50"]) == 2
    assert "(--limit yaml_values=200 raises it)" in capsys.readouterr().err
    assert run(["run", *arguments, "--limit", "yaml_values=2000"]) == 2
    assert "beyond the limit" not in capsys.readouterr().err
