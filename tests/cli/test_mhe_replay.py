"""`amhe mhe-replay` from the outside: files, streams, exit codes, interruption."""

import csv
import json
import re
import signal
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from amhe_cli.cli.main import amhe, run
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.settings import LogSettings, MheSettings
from amhe_cli.core.signals import Signal
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.estimation.online.replay import paced
from amhe_cli.logs import read_metadata, read_signals, survey
from amhe_cli.system.system import System
from tests.conftest import PENDULUM_TRUTH, write_pendulum_log
from tests.web.figures import panels

LOGS = bundled_root() / "examples" / "logs"
PENDULUM = str(LOGS / "pendulum.mcap")
NAMES = ("box_mass", "box_inertia_scale", "floor_friction")


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output of three seconds of the bundled log of a Go1."""
    out = tmp_path_factory.mktemp("replay") / "out"
    assert run(["mhe-replay", "--to", "3", "-q", "-o", str(out)]) == 0
    return out


def record(folder: str | Path) -> dict:
    return json.loads((Path(folder) / "result.json").read_text())


def table(folder: str | Path) -> list[dict[str, str]]:
    with (Path(folder) / "estimates.csv").open() as file:
        return list(csv.DictReader(file))


def column(folder: str | Path, name: str) -> np.ndarray:
    return np.array([float(row[name] or "nan") for row in table(folder)])


# -- files ----------------------------------------------------------------------------------------------


def test_it_writes_its_four_files(pushed: Path) -> None:
    names = sorted(path.name for path in pushed.iterdir())
    assert names == ["estimates.csv", "estimates.mcap", "report.html", "result.json"]


def test_result_json_has_the_keys_of_every_command_and_its_own(pushed: Path) -> None:
    result = record(pushed)
    assert {"schema_version", "command", "version", "seconds", "warnings"} <= set(result)
    assert (result["command"], result["system"], result["method"]) == ("mhe-replay", "go1_push", "linearised")
    assert [p["name"] for p in result["parameters"]] == list(NAMES)
    assert {"estimate", "sd", "lower", "upper", "unit", "truth"} <= set(result["parameters"][0])
    assert result["windows"] == len(table(pushed)) == 26
    assert result["updated"] + result["still"] + result["gaps"] + result["lost"] == result["windows"]
    assert result["rollouts"] == {"count": 9 * 26, "diverged": 0}
    assert 0.0 < result["update_ms"]["p50"] <= result["update_ms"]["p99"]
    assert result["real_time_factor"] > 0.0


def test_the_table_has_a_row_for_each_window(pushed: Path) -> None:
    header = list(table(pushed)[0])
    triples = [cell for name in NAMES for cell in (name, f"{name}_sd", f"{name}_true")]
    assert header == ["time", *triples, "misfit", "updated", "update_ms", "mark", "excitation"]
    np.testing.assert_allclose(column(pushed, "time"), 0.4 + 0.1 * np.arange(26), atol=1e-9)
    np.testing.assert_array_equal(column(pushed, "floor_friction_true"), 0.4)
    assert all((row["updated"] == "1") == (row["mark"] in ("updated", "jump")) for row in table(pushed))


def test_a_push_is_learnt_from_and_a_walk_towards_the_box_is_not(pushed: Path) -> None:
    """The belief waits, and grows less sure, until there is something to learn."""
    updated, sd = column(pushed, "updated") == 1.0, column(pushed, "box_mass_sd")
    begin = int(np.argmax(updated))
    assert 7 <= begin <= 14
    np.testing.assert_array_equal(column(pushed, "box_mass")[:begin], 3.0)
    assert (np.diff(sd[:begin]) > 0.0).all()
    assert sd[-1] < 0.5 * sd[0]
    last = {p["name"]: p for p in record(pushed)["parameters"]}
    assert last["box_mass"]["lower"] < last["box_mass"]["truth"] == 4.0 < last["box_mass"]["upper"]


def test_the_log_of_estimates_is_read_back_by_ours(pushed: Path) -> None:
    path = pushed / "estimates.mcap"
    assert not survey(path).problems
    assert read_metadata(path)["system"] == "go1_push"
    topics = {topic.name: topic for topic in survey(path).topics}
    assert {"/amhe/params", "/amhe/estimate", "/amhe/truth", "/diagnostics"} <= set(topics)
    assert topics["/amhe/estimate"].type == "amhe_msgs/msg/Estimate"
    params = Signal("params", "/amhe/params", ("position",))
    log = read_signals(path, [params], 0.1, LogSettings())["params.position"]
    assert log.columns == NAMES
    for i, name in enumerate(NAMES):
        np.testing.assert_allclose(log.values[:, i], column(pushed, name), rtol=1e-8)


def test_the_log_predicts_the_measured_topics(pushed: Path) -> None:
    """Within a few times the sensors' noise, at the measurements' own times."""
    for topic, quantity, within in (
        ("/box/odom", "position", 0.01),
        ("/odom", "position", 0.01),
        ("/odom", "linear_velocity", 0.4),
        ("/joint_states", "position", 0.06),
    ):
        wanted = Signal("it", f"/amhe/pred{topic}", (quantity,))
        predicted = read_signals(pushed / "estimates.mcap", [wanted], 0.01, LogSettings())
        measured = read_signals(
            LOGS / "t4.mcap", [Signal("it", topic, (quantity,))], 0.01, LogSettings(), end=2.9
        )
        late = round((predicted.start_ns - measured.start_ns) / 1e7)
        ours, theirs = predicted[f"it.{quantity}"], measured[f"it.{quantity}"]
        assert ours.columns == theirs.columns
        count = len(ours.values)
        assert count > 250
        error = np.abs(ours.values - theirs.values[late : late + count])
        assert np.median(error) < 0.25 * within
        assert np.quantile(error, 0.98) < within


def test_the_report_is_one_page_that_needs_no_network(pushed: Path) -> None:
    page = (pushed / "report.html").read_text()
    titles = [panel["title"] for panel in panels(page)]
    assert {"box_mass", "misfit before the update, in noise sd", "box.position x"} <= set(titles)
    links = re.findall(r"""(?:src|href)=["']([^"']+)""", page)
    assert all(link.startswith("#") for link in links), links
    for loading in ("<script src", "fetch(", "<link", "url(http", "@import"):
        assert loading not in page
    assert len(page) < 1_000_000
    assert "box_inertia_scale 30</td>" in page, "settings by name are words"


# -- options --------------------------------------------------------------------------------------------


def test_the_options_tell_the_defaults_of_the_library_and_of_go1_push() -> None:
    options = {p.name: p for p in amhe.commands["mhe-replay"].params}
    general, go1 = MheSettings(), System.load("go1_push").settings.mhe
    methods = get_args(MheSettings.model_fields["method"].annotation)
    assert tuple(options["method"].type.choices) == methods  # type: ignore[attr-defined]
    for name in ("method", "learning_rate"):
        assert f"[default: {getattr(general, name)}]" in options[name].help  # type: ignore[attr-defined]
    for name in ("window", "update_period"):
        text = f"[default: {getattr(general, name)}; of go1_push {getattr(go1, name)}"
        assert text in options[name].help  # type: ignore[attr-defined]
    for name, count in (("samples", "sample_count"), ("iterations", "iteration_count")):
        ours, papers = (getattr(MheSettings(method=m), count) for m in ("linearised", "logrank"))
        text = f"[default: {ours} for linearised, {papers} for logrank"
        assert text in options[name].help  # type: ignore[attr-defined]
    assert go1.iteration_count == 1


@pytest.mark.medium
def test_options_become_settings_and_overrule_set(capsys) -> None:
    options = ["--window", "0.4", "--set", "mhe.window=1", "--samples", "12", "--iterations", "2"]
    options += ["--learning-rate", "0.3", "--prior-weight", "damping=2", "--prior-weight", "load_mass=0"]
    options += ["--method", "logrank", "--update-period", "0.5", "--to", "1.5"]
    assert run(["mhe-replay", PENDULUM, "-o", "out", "--json", "-q", *options]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result == record("out")
    assert result["method"] == "logrank"
    assert result["settings"] == {
        "window": 0.4, "update_period": 0.5, "learning_rate": 0.3, "samples": 12, "iterations": 2,
        "prior_weight": {"damping": 2.0, "load_mass": 0.0},
    }  # fmt: skip
    assert result["windows"] == 3


@pytest.mark.medium
def test_an_option_that_does_nothing_is_reported(capsys) -> None:
    assert run(["mhe-replay", PENDULUM, "--to", "1", "-o", "out", "--learning-rate", "0.3", "--strict"]) == 3
    assert "mhe.learning_rate does nothing with the method linearised" in capsys.readouterr().err


@pytest.mark.medium
def test_a_seed_gives_the_same_estimates_whatever_the_threads() -> None:
    tables = []
    for threads in ("1", "2"):
        options = ["--to", "1", "-q", "--seed", "5", "--threads", threads, "-o", threads]
        assert run(["mhe-replay", PENDULUM, *options]) == 0
        tables.append([{k: v for k, v in row.items() if k != "update_ms"} for row in table(threads)])
    assert tables[0] == tables[1]


def test_the_size_of_the_box_is_estimated_if_it_is_asked_for() -> None:
    assert run(["mhe-replay", "--to", "0.6", "-q", "-o", "out", "--unknowns", "box,box_size"]) == 0
    assert [p["name"] for p in record("out")["parameters"]] == [*NAMES, "face_overlap", "floor_overlap"]


def test_times_count_from_the_logs_start_and_truth_may_be_stated_once() -> None:
    assert run(["mhe-replay", PENDULUM, "--from", "4", "--to", "5", "-q", "-o", "out"]) == 0
    np.testing.assert_allclose(column("out", "time"), [4.5, 4.7, 4.9], atol=1e-9)
    np.testing.assert_array_equal(column("out", "load_mass_true"), 0.55)  # of the log's metadata


def test_a_belief_is_started_from_and_a_log_that_says_nothing_moves_nothing(capsys) -> None:
    parameter = "- {{name: {}, unit: '-', scale: log, estimate: {}}}\n"
    values = {"load_mass": 0.5, "damping": 0.04, "friction_loss": 0.03, "armature": 0.005}
    rows = (0.0001 * np.eye(4)).tolist()
    Path("belief.yaml").write_text(
        "schema_version: 1\nsystem: pendulum\nparameters:\n"
        + "".join(parameter.format(*item) for item in values.items())
        + f"covariance: {rows}\n"
    )
    options = ["--belief", "belief.yaml", "--set", "mhe.excitation=1e9", "--to", "1", "-q", "-o", "out"]
    assert run(["mhe-replay", PENDULUM, *options]) == 0
    assert {p["name"]: p["start"] for p in record("out")["parameters"]} == pytest.approx(values)
    assert column("out", "load_mass_sd")[0] == pytest.approx(0.2 * 0.5, rel=0.1)  # not 1 %: it is floored
    assert "no window was used" in capsys.readouterr().err
    assert record("out")["still"] == record("out")["windows"]


# -- input that is not as it should be ------------------------------------------------------------------


def test_of_a_log_shorter_than_the_window_all_is_used_and_that_is_reported(capsys) -> None:
    arguments = ["mhe-replay", PENDULUM, "--window", "20", "--to", "1", "-q", "-o", "out", "--strict"]
    assert run(arguments) == 3
    assert "hold no window of 20 s" in capsys.readouterr().err
    assert record("out")["windows"] == record("out")["updated"] == 1


@pytest.mark.medium
def test_gaps_are_marked_counted_and_warned_of_once(capsys, tmp_path: Path) -> None:
    log = write_pendulum_log(tmp_path / "log.mcap", 4.0, silent=(1.55, 2.15), system="pendulum")
    assert run(["mhe-replay", str(log), "-q", "-o", "out", "--set", "mhe.update_period=0.1"]) == 0
    marks = [row["mark"] for row in table("out")]
    gaps = [i for i, mark in enumerate(marks) if mark == "gap"]
    assert record("out")["gaps"] == len(gaps) >= 4
    starts = column("out", "time")[gaps] - 0.5
    assert ((starts > 1.5) & (starts < 2.2)).all()
    np.testing.assert_array_equal(column("out", "load_mass")[gaps], column("out", "load_mass")[gaps[0] - 1])
    assert capsys.readouterr().err.count("a signal or an input is missing") == 1
    assert "a signal or an input is missing" in Path("out/report.html").read_text()
    assert column("out", "load_mass")[-1] == pytest.approx(PENDULUM_TRUTH["load_mass"], rel=0.1)


def test_a_log_of_gaps_alone_is_replayed_to_its_end(capsys, tmp_path: Path) -> None:
    log = write_pendulum_log(tmp_path / "log.mcap", 1.2, silent=(0.003, 1.19), system="pendulum")
    assert run(["mhe-replay", str(log), "-q", "-o", "out", "--from", "0.1", "--strict"]) == 3
    assert record("out")["gaps"] == record("out")["windows"] > 2
    assert record("out")["update_ms"] == {"p50": None, "p99": None}
    assert "no window was used" in capsys.readouterr().err


@pytest.mark.medium
def test_an_update_that_takes_longer_than_its_period_is_reported_with_the_number(capsys) -> None:
    arguments = ["mhe-replay", PENDULUM, "--update-period", "0.002", "--to", "0.52", "-q", "-o", "out"]
    assert run([*arguments, "--strict"]) == 3
    took = record("out")["update_ms"]["p50"]
    warning = f"an update takes {took:.0f} ms, but the update period is 2 ms"
    assert warning in capsys.readouterr().err
    assert any(warning in text for text in record("out")["warnings"])


def test_an_interrupted_replay_keeps_what_there_is(monkeypatch, capsys) -> None:
    update, seen = MovingHorizon.update, []

    def interrupted(*arguments, **more):
        seen.append(None)
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)
        return update(*arguments, **more)

    monkeypatch.setattr(MovingHorizon, "update", interrupted)
    assert run(["mhe-replay", PENDULUM, "-q", "-o", "out"]) == 130
    assert record("out")["interrupted"] is True
    assert record("out")["windows"] == len(table("out")) == 3
    assert not survey(Path("out/estimates.mcap")).problems
    assert "interrupted" in capsys.readouterr().out


def test_a_longer_window_has_a_longer_update_period_unless_that_is_given(capsys) -> None:
    own = System.load("pendulum").settings.mhe
    for window, period in ((0.4, 0.2), (0.75, 0.3), (1.0, 0.4)):
        system = paced(System.load("pendulum", {"mhe": {"window": window}}), own)
        assert system.settings.mhe.update_period == pytest.approx(period)
    idle = ["--to", "1.5", "--set", "mhe.excitation=1e9", "--window", "1.0", "--force", "-o", "out"]
    assert run(["mhe-replay", PENDULUM, *idle]) == 0
    assert "windows of 1 s, updates every 0.4 s" in capsys.readouterr().out
    assert run(["mhe-replay", PENDULUM, *idle, "--update-period", "0.25"]) == 0
    assert record("out")["settings"]["update_period"] == 0.25
