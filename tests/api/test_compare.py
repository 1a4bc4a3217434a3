"""`amhe compare`: systems fitted to the same logs, and scored on the same clips."""

import html
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.api.compare import _verdicts
from amhe_cli.cli.compare import _lines, _parted
from amhe_cli.cli.main import run
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.result import AtHorizon
from amhe_cli.report.comparison import comparison_table, table_text
from amhe_cli.system.friction_models import friction_models
from tests.conftest import MODELS

QUICK = {"clips": {"count": 6}, "identify": {"iterations": 3, "first_state": "never"}}
#: Comparing does not depend on what a model lacks.
pytestmark = pytest.mark.usefixtures("unexplained")


@pytest.mark.medium
def test_the_model_that_can_follow_the_logs_wins(tmp_path: Path, pendulum_log: Path) -> None:
    free = amhe.System.load("pendulum", QUICK)
    stiff = free.fixing({"damping": 0.4})
    logs = [[amhe.read_log(pendulum_log, one)] for one in (free, stiff)]
    found = amhe.compare([free, stiff], logs)
    assert found.names == ("pendulum-1", "pendulum-2")
    assert found.best == 0
    assert found.verdicts[0].startswith(
        "pendulum-1 predicts better than pendulum-2: its error is smaller by "
    )
    assert "pendulum-2" in found.table
    found.save(tmp_path / "out")
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["best"] == "pendulum-1"
    assert record["horizons"][0]["against_best"]["pendulum-2"]["lower"] > 1.0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "pendulum-1 predicts best." in page
    assert (tmp_path / "out" / "pendulum-2" / "identified.xml").is_file()


@pytest.mark.medium
def test_no_model_wins_while_a_search_has_not_ended(
    pendulum_log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    free = amhe.System.load("pendulum", QUICK)
    stiff = free.fixing({"damping": 0.4})
    logs = [[amhe.read_log(pendulum_log, one)] for one in (free, stiff)]
    found = amhe.compare([free, stiff], logs, max_time=0.05)
    other = found.names[1 - found.best]
    assert found.verdicts == (
        f"no model is called better than {other}, whose search did not end; give it more "
        "(`identify.iterations`, `max_time`)",
    )
    assert found.record()["best"] is None
    stopped = [text for text in caplog.messages if "stopped the search" in text]
    assert [text.partition(":")[0] for text in stopped] == ["pendulum-1", "pendulum-2"]
    assert found.warnings[0].startswith("pendulum-1: ") and not found.warnings[0].startswith(
        "pendulum-1: pend"
    )


def at(horizon: float, clips: int) -> AtHorizon:
    ratios = np.array([[1.0, 1 / 7.94], [7.94, 1.0]])
    return AtHorizon(
        horizon, clips == 1, clips, {("elbow", "rad"): np.array([0.01, 0.0794])}, ratios, 0.66 * ratios,
        1.6 * ratios,
    )  # fmt: skip


def test_only_a_rival_whose_search_has_ended_is_called_worse() -> None:
    judged = [
        _verdicts([at(0.1, 20)], ("arm", "other"), 0, ended) for ended in ([False, True], [True, False])
    ]
    assert judged[0][0].startswith("arm predicts better than other")
    assert judged[1][0].startswith("no model is called better than other, whose search did not end")
    (short,) = _verdicts([at(0.1, 20)], ("arm", "b", "c", "d"), 0, [True, False, False, False])
    assert short.startswith("no model is called better than b, c and d, whose")


def test_the_table_fits_a_terminal_of_80_columns_and_cuts_no_number() -> None:
    text = table_text(comparison_table(("arm", "another-arm"), [at(0.1, 20), at(2.0, 1)], 0))
    assert max(map(len, text.splitlines())) <= 80
    assert "7.94 (5.24 to 12.70)" in text and "too few clips" in text and "4.55°" in text


def test_a_shell_pattern_behind_logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "system.yaml").touch()
    (tmp_path / "run2.csv").touch()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pendulum").mkdir()  # a result of that name is no log
    given = ["pendulum", str(tmp_path / "mine"), str(tmp_path / "run2.csv")]
    assert _parted(given) == (given[:2], [tmp_path / "run2.csv"])


def test_wrong_arguments_are_one_line(pendulum_log: Path) -> None:
    system = amhe.System.load("pendulum")
    log = amhe.read_log(pendulum_log, system, end=1.0)
    with pytest.raises(amhe.AmheError, match="two or more"):
        amhe.compare([system], [[log]])
    with pytest.raises(amhe.AmheError, match="the same logs"):
        amhe.compare([system, system], [[log], []])
    own = amhe.System.load("pendulum", {"clips": {"held_out": 0.0}})
    with pytest.raises(amhe.AmheError, match="no part is held out"):
        amhe.compare([own, own], [[log], [log]])


def test_friction_models_stand_in_place_of_the_systems_own() -> None:
    """As `init --drive` writes it: numbers of the gear, which give way, and of the firmware, which stay."""
    own = {"bounds": [-0.2, 1.0], "nominal": 0.1, "prior_sd": 0.1}
    numbers = {
        "share": own | {"targets": [{"joint": "hinge", "set": "load_friction"}]},
        "punch": own | {"targets": [{"actuator": "servo", "set": "punch"}]},
    }
    names = {
        name: set(one.space.names)
        for name, one in friction_models(
            amhe.System.load("pendulum", {"parameters": numbers}, warn=False)
        ).items()
    }
    assert all("punch" in some and "share" not in some for some in names.values())
    assert names["M3"] - names["M1"] == {"load_friction"}


@pytest.mark.medium
def test_no_friction_model_is_enough_before_the_searches_have_ended(
    pendulum_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    two = [friction_models(amhe.System.load("pendulum", QUICK))[name] for name in ("M1", "M3")]
    monkeypatch.setattr("amhe_cli.cli.compare._with_frictions", lambda _: two)
    given = ["compare", "--friction", "pendulum", "--logs", str(pendulum_log), "--max-time=0.1"]
    assert run([*given, "--threads=1", "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "whose search did not end" in out and "system.yaml" not in out
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    assert record["best"] is None and "lines" not in record


def test_the_lines_of_constant_friction_take_the_systems_own_away() -> None:
    share = {"bounds": [-0.2, 1.0], "targets": [{"joint": "hinge", "set": "load_friction"}]}
    own = amhe.System.load("pendulum", {"parameters": {"share": share}}, warn=False)
    plain = amhe.System.load("pendulum", warn=False)
    assert _lines(plain, "M1") == ["M1: constant friction"]
    assert _lines(own, "M1") == ["M1: constant friction; take share out of the parameters of system.yaml"]
    assert _lines(own, "M3")[0].endswith("; in the parameters of system.yaml, in place of share:")


@pytest.mark.slow
def test_the_smallest_friction_model_that_explains_a_geared_joint_wins(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its lines can be pasted into system.yaml, and the result is a file like all others."""
    truth = friction_models(amhe.System.load("pendulum", QUICK))["M3"]
    rng = np.random.default_rng(4)
    time = np.arange(0.0, 4.0, truth.dt)
    command = (
        0.7 * np.sin(1.3 * time + 2.0 * np.sin(0.7 * time))[:, None] + 0.2 * np.sin(11.0 * time)[:, None]
    )
    theta = truth.space.nominal.copy()
    theta[list(truth.space.names).index("load_friction")] = 0.25
    engine = open_engine(truth, threads=1)
    zeros = np.zeros((1, 1))
    motion = engine.rollout(theta[None], zeros, zeros, command[None], np.array([len(time)])).qpos[0]
    log = tmp_path / "log.csv"
    rows = np.column_stack((time, motion + rng.normal(0.0, 0.002, motion.shape), command))[::5]
    np.savetxt(log, rows, delimiter=",", header="time,hinge,target", comments="")
    folder = tmp_path / "servo"
    shutil.copytree(MODELS / "pendulum", folder)
    text = (folder / "system.yaml").read_text().partition("\nsignals:")[0]
    signals = (
        "\nsignals:\n  joints: {columns: {position: [hinge]}, joints: [hinge], noise: {position: 0.002}}\n"
        "  command: {columns: {position: [target]}, actuators: [servo]}\n"
    )
    (folder / "system.yaml").write_text(text + signals)
    quick = [
        "--set=clips.count=4",
        "--set=clips.length=[0.3,1.0]",
        "--set=identify.iterations=4",
        "--set=identify.first_state=never",
        "--set=identify.assumed=0",  # which of them predicts best does not depend on it
    ]
    out = tmp_path / "out"
    given = ["compare", "--friction", str(folder), "--logs", str(log), "-o", str(out), "--threads=1", *quick]
    assert run(given) == 0
    record = json.loads((out / "result.json").read_text())
    assert [one["name"] for one in record["systems"]] == ["M1", "M2", "M3", "M4", "M5", "M6"]
    assert record["best"] == "M3"
    lines = capsys.readouterr().out.split("add to the parameters of system.yaml:\n")[1].splitlines()[0]
    assert lines == record["lines"][1] and lines.strip() in html.unescape((out / "report.html").read_text())
    again = text.replace("parameters:\n", f"parameters:\n{lines}\n") + signals
    (folder / "system.yaml").write_text(again)
    system = amhe.System.load(folder)
    assert "load_friction" in system.space.names
    names = {name: list(one.space.names) for name, one in friction_models(system).items()}
    assert "load_friction" not in names["M1"]  # its own are taken away
    assert "load_friction" in names["M3"]
    assert "load_friction_motor" in names["M5"]
