"""`amhe eval` from the outside: cells, files, streams, exit codes, interruption, both executors."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from amhe_cli.cli.eval import _counted
from amhe_cli.cli.main import run
from amhe_cli.cli.settings import gathered
from amhe_cli.core.errors import ConfigError
from amhe_cli.study.cells import Cell, setting_of
from amhe_cli.study.plan import EvalOptions, planned, study_of
from amhe_cli.study.run import code, run_cell
from amhe_cli.study.store import open_store
from tests.clusters import Cluster
from tests.study.cells_at_play import result
from tests.web.figures import panels

ROOT = Path(__file__).parents[2]
#: Little work: a run of five cycles.
QUICK = ["--duration", "0.1", "--set", "control.samples=5", "--set", "control.horizon=8"]
GRID = ["--tasks", "t1,t5", "--modes", "true,baseline", "--seeds", "1", "--workers", "1"]


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of one quick study; the cells failed in nothing but their task, so the exit code is 0."""
    out = tmp_path_factory.mktemp("eval") / "out"
    assert run(["eval", *GRID, *QUICK, "-q", "-o", str(out)]) == 0
    return out


def cells_of(folder: Path) -> dict[str, object]:
    """What must be the same wherever a cell was run."""
    found = {}
    for path in (folder / "cells").iterdir():
        record = json.loads(path.read_text())
        del record["seconds"], record["outcome"]["cycle_ms"]
        found[path.name] = record
    return found


def the_line(capsys) -> str:
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_study_leaves_a_file_a_cell_and_all_that_is_made_of_them(done: Path) -> None:
    assert {p.name.rsplit("-", 1)[0] for p in (done / "cells").iterdir()} == {
        "t1-true-00", "t1-baseline-00", "t5-true-00", "t5-baseline-00"
    }  # fmt: skip
    rows = json.loads((done / "summary.json").read_text())
    assert [(row["task"], row["mode"], row["n"]) for row in rows] == [
        ("t1", "true", 1), ("t1", "baseline", 1), ("t5", "true", 1), ("t5", "baseline", 1)
    ]  # fmt: skip
    assert {p.suffix for p in (done / "tables").glob("measures.*")} == {".md", ".tex", ".csv"}


def test_the_page_needs_no_network(done: Path) -> None:
    page = (done / "report.html").read_text()
    titles = {re.split("[:,]", one["title"])[0] for one in panels(page)}
    assert titles == {"T1", "T5", "true", "baseline"}
    for loading in ("<script src", "fetch(", "<link", "src=", "url(http", "@import"):
        assert loading not in page


@pytest.mark.medium
def test_what_is_done_is_not_run_again(done: Path, capsys) -> None:
    shutil.copytree(done, "out")
    gone = next(Path("out/cells").glob("t5-true*"))
    gone.unlink()
    kept = {path: path.stat().st_mtime_ns for path in Path("out/cells").iterdir()}
    assert run(["eval", *GRID, *QUICK, "-o", "out", "--resume"]) == 0
    err = capsys.readouterr().err.splitlines()
    assert err[0] == "amhe eval: 3 of 4 cells are done already"
    assert err[1].startswith("amhe eval: 1/1: t5 true, control.horizon=8, control.samples=5, seed 0: ")
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())
    assert cells_of(Path("out")) == cells_of(done)


@pytest.mark.medium
def test_the_report_is_made_again_of_the_cells_alone(done: Path, capsys) -> None:
    Path("out").mkdir()
    shutil.copytree(done / "cells", "out/cells")
    shutil.copy(done / "study.json", "out/study.json")
    assert run(["eval", "--report", "out", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["command"], printed["cells"], printed["failed"]) == ("eval", 4, {})
    assert printed["summary"] == json.loads((done / "summary.json").read_text())
    for path in ("report.html", "summary.json", "tables/measures.csv", "tables/table2.md"):
        assert (Path("out") / path).read_bytes() == (done / path).read_bytes()


@pytest.fixture
def certificates(tmp_path: Path) -> dict[str, str]:
    """An authority and a certificate that it signed, made as docs/scaling.md says, by dask's names."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    commands = [
        line
        for line in (ROOT / "docs" / "scaling.md").read_text().splitlines()
        if line.startswith("openssl ")
    ]
    assert len(commands) == 3
    for command in commands:
        subprocess.run(command.split(), cwd=tmp_path, check=True, capture_output=True)
    return {"ca-file": "ca.pem", "cert": "me.pem", "key": "me.key"}


@pytest.mark.slow
def test_a_cluster_behind_tls_gives_the_same_cells_as_this_machine(
    done: Path, tmp_path: Path, certificates: dict[str, str], capsys
) -> None:
    pytest.importorskip("distributed")
    import dask

    options = tuple(word for name, file in certificates.items() for word in (f"--tls-{name}", file))
    command = ["eval", *GRID, *QUICK, "-q", "--cluster"]
    with Cluster(tmp_path, options, "tls") as cluster:
        assert cluster.address.startswith("tls://")
        cluster.worker()
        assert run([*command, cluster.address, "-o", "a"]) == 2
        assert "names no certificates for TLS" in capsys.readouterr().err
        plain = cluster.address.replace("tls:", "tcp:")
        assert run([*command, plain, "-o", "b"]) == 1, "no way in without TLS"
        ours = {"ca-file": "ca.pem", "client.cert": "me.pem", "client.key": "me.key"}
        with dask.config.set({f"distributed.comm.tls.{name}": file for name, file in ours.items()}):  # pyright: ignore[reportPrivateImportUsage]
            assert run([*command, cluster.address, "-o", "out"]) == 0
    assert cells_of(Path("out")) == cells_of(done)


@pytest.mark.medium
def test_ctrl_c_keeps_what_is_done_and_a_study_goes_on(done: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "amhe_cli", "eval", *GRID, *QUICK, "-o", "out"]
    process = subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 60.0
    while not any(Path("out/cells").glob("*.json")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60.0)
    assert process.returncode == 130
    assert "go on with --resume" in err.splitlines()[-1]
    assert 1 <= len(list(Path("out/cells").iterdir())) < 4
    assert Path("out/report.html").exists()
    assert run(["eval", *GRID, *QUICK, "-q", "-o", "out", "--resume"]) == 0
    assert cells_of(Path("out")) == cells_of(done)


@pytest.mark.medium
def test_a_cell_that_breaks_is_recorded_and_the_command_fails(monkeypatch, capsys) -> None:
    monkeypatch.setattr("amhe_cli.study.run.run_cell", breaking)
    assert run(["eval", *GRID, *QUICK, "-q", "-o", "out"]) == 1
    err = capsys.readouterr().err
    where = "t5 baseline, control.horizon=8, control.samples=5, seed 0"
    assert err.splitlines() == [f"amhe eval: error: {where}: SimulationError: it broke"]
    assert len(list(Path("out/cells").iterdir())) == 4


def breaking(request):
    """A plant that breaks in one cell."""
    from amhe_cli.study.results import blank
    from tests.study.cells_at_play import record

    cell = request["cell"]
    broken = (cell["task"], cell["mode"]) == ("t5", "baseline")
    return blank(request, "SimulationError: it broke") if broken else record(request)


def test_each_result_is_shown_with_the_time_left() -> None:
    shown = _counted(4)
    shown(result(Cell("t4", "baseline", 0)))
    state, count, total = shown(result(Cell("t4", "true", 2)))
    assert re.fullmatch(r"2/4: .*t4.*: success, 0\.022 m from the goal, 14\.1 s; about 0 min left", state)
    assert (count, total) == (2, 4)


def test_where_no_scheduler_answers_the_command_fails_in_one_line(monkeypatch, capsys) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("amhe_cli.study.executors.PATIENCE", 0.5)
    assert run(["eval", *GRID, "-q", "-o", "out", "--cluster", "tcp://127.0.0.1:9"]) == 1
    assert "no scheduler answers at tcp://127.0.0.1:9" in the_line(capsys)
    assert run(["eval", *GRID, "-q", "-o", "other", "--cluster", "nonsense://here:1"]) == 2
    assert "nonsense" in the_line(capsys)


def test_a_worker_of_other_code_refuses_to_run() -> None:
    request = {"cell": Cell("t1", "true", 0).plain(), "code": code() | {"sources": "ffffffffffff"}}
    with pytest.raises(ConfigError, match="a worker runs sources .* ffffffffffff: install the same"):
        run_cell(request)


def test_the_environment_of_a_worker_changes_nothing(monkeypatch, done: Path) -> None:
    stored = next(r for r in open_store(done).results() if (r.cell.task, r.cell.mode) == ("t1", "true"))
    monkeypatch.setenv("AMHE_CONTROL__TEMPERATURE", "3.0")
    again = run_cell({"cell": stored.cell.plain(), "code": code()})
    assert again["outcome"]["cost"] == stored.outcome["cost"]


def test_the_users_environment_and_options_are_the_operating_point() -> None:
    given = gathered(None, {"AMHE_CONTROL__SAMPLES": "16"}, ["control.horizon=16", "control.loops=2.0"]).all
    options = EvalOptions(["t1"], ["true"], 1, settings=given)
    study = study_of(options, "amhe eval", "", {})
    assert study.setting == setting_of({"control.samples": 16, "control.loops": 2})
    assert {cell.setting for cell in planned(options, study)} == {study.setting}


def test_a_study_goes_seed_by_seed_and_leaves_out_what_does_not_exist() -> None:
    beliefs = {"t4": ROOT / "docs" / "results" / "beliefs" / "t4.yaml"}
    options = EvalOptions(["t1", "t4"], ["baseline", "stale"], 2, beliefs=beliefs)
    cells = planned(options, study_of(options, "", "", {}))
    assert [(c.task, c.mode, c.seed) for c in cells] == [
        ("t1", "baseline", 0), ("t4", "baseline", 0), ("t4", "stale", 0),
        ("t1", "baseline", 1), ("t4", "baseline", 1), ("t4", "stale", 1),
    ]  # fmt: skip
    assert {(c.task, c.mode) for c in cells if c.belief} == {("t4", "baseline")}, "stale has its own"


def test_an_ablated_value_that_is_the_operating_point_is_the_same_cell() -> None:
    options = EvalOptions(
        ["t4"], [], 2, ablations=["control.samples=8,16", "control.sigma_range=[0.2,1.0]", "samples=8,32"]
    )
    cells = planned(options, study_of(options, "", "", {}))
    settings = [
        (), (("control.samples", 16),), (("control.sigma_range", (0.2, 1.0)),), (("mhe.samples", 32),)
    ]  # fmt: skip
    assert list(dict.fromkeys(cell.setting for cell in cells)) == settings
    assert len(cells) == len(set(cells)) == 8
    assert {cell.mode for cell in cells} == {"adaptive"}


def test_a_setting_that_does_nothing_is_not_ablated() -> None:
    options = EvalOptions(["t4"], [], 1, ablations=["alpha=0.3,0.5"])
    with pytest.raises(ConfigError, match=r"learning_rate: it does nothing .* linearised; set mhe.method=l"):
        list(planned(options, study_of(options, "", "", {})))


@pytest.mark.medium
def test_the_papers_seven_have_their_own_symbols_and_a_value_at_the_operating_point() -> None:
    symbols = ["L_MHE=9", "B=9", "dt_update=0.9", "H=0.9", "alpha=0.9", "w_mass=0.9", "w_friction=0.9"]
    options = EvalOptions(["t4"], [], 1, ablations=symbols, settings={"mhe": {"method": "logrank"}})
    study = study_of(options, "", "", {})
    changed = [set(cell.setting) - set(study.setting) for cell in planned(options, study)]
    paths = [path for change in changed for path, _ in change]
    assert paths == [
        "mhe.iterations", "mhe.samples", "mhe.update_period", "mhe.window", "mhe.learning_rate",
        "mhe.prior_weight.box_mass", "mhe.prior_weight.floor_friction",
    ]  # fmt: skip
    assert study.setting == (("mhe.method", "logrank"),)
    assert (study.defaults["mhe.samples"], study.defaults["mhe.iterations"]) == (32, 4)
    assert all(study.defaults[path] is not None for path in paths)
