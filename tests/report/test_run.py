"""Reports of a run and of a watch."""

from __future__ import annotations

import re
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from amhe_cli.core.shown import Floor
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.logs.live.messages import LiveTopic
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.report import watch
from amhe_cli.report.run import TaskFacts, measure_table, print_run, run_page, statements, verdict
from amhe_cli.report.watch import STALE, WatchReport, blocks
from amhe_cli.system.system import System
from tests.web.figures import panels

RECORD: dict[str, Any] = {
    "error": None, "trip": None,
    "fell": False, "interrupted": False, "success": True, "arrived": True, "on_time": True,
    "goal_error_m": 0.02, "time_s": 14.0, "duration": 40.0, "cut_short": False, "lock_step": True,
    "cycles": 500, "deadline_misses": 100, "cycle_ms": {"p50": 19.0, "p99": 25.0}, "speed_rmse": 0.03,
    "path_rmse_m": 0.01, "cost": 1200.0, "diverged": 0, "rollouts": 4000, "least_rollouts": 4,
    "belief": {"box_mass": 4.0}, "truth": {"box_mass": 4.0},
}  # fmt: skip


FLOOR = Floor(np.array([[0.6, 0.0], [3.0, 0.0]]), 0.0, (0.3, 0.5), other_floor=1.5)
TASK = TaskFacts("a push", FLOOR, ["from x = 1.5 m on the floor friction is 0.8"], 15.0, 0.15, {}, 0.02)


def stated(**changed: Any) -> str:
    return " ".join(statement.text for statement in statements(RECORD | changed, TASK))


def test_late_cycles_wait_in_lock_step_and_cost_periods_against_the_clock() -> None:
    assert "The simulation waits for each plan (lock-step)" in stated()
    assert "100 of 600 periods went on with an older plan" in stated(lock_step=False)
    assert "period" not in stated(cycle_ms={"p50": 10.0, "p99": 19.0})


@pytest.mark.parametrize(("lock_step", "there"), [(True, False), (False, True)])
def test_deadlines_are_those_of_the_clock(lock_step: bool, there: bool) -> None:
    names = [name for name, *_ in measure_table(RECORD | {"lock_step": lock_step}).rows]
    assert ("missed deadlines" in names) is there


def test_used_windows_are_counted_and_troubles_are_stated() -> None:
    marks = {"still": 11, "updated": 13, "jump": 1}
    estimator = {
        "updates": 25,
        "marks": marks,
        "troubles": ["at 3.0 s the estimator is late"],
        "update_ms": {"p50": 80.0},
    }
    record = RECORD | {"estimator": estimator}
    assert ("windows used by the estimator", "14 of 25", "") in measure_table(record).rows
    assert "Estimator: at 3.0 s the estimator is late." in stated(estimator=estimator)


@pytest.mark.parametrize(
    ("marks", "end"), [({"still": 3}, "; no window has changed it yet."), ({"updated": 1}, ".")]
)
def test_the_last_belief_has_its_sd_and_says_whether_a_window_has_changed_it(
    marks: dict[str, int], end: str
) -> None:
    learnt = {"marks": marks, "troubles": [], "sd": {"box_mass": 0.456}}
    assert f"box_mass 3 ± 0.46 (4){end}" in stated(
        estimator=learnt, belief={"box_mass": 3.0}, truth={"box_mass": 4.0}
    )


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, ("good", "success, on time")),
        ({"on_time": False}, ("good", "success, but late")),
        ({"arrived": False}, ("good", "success: the box is close enough to its goal after 40 s")),
        ({"success": False}, ("bad", "failed: the box is not at its goal, or it strayed from its path")),
        ({"success": False, "fell": True}, ("bad", "the robot fell")),
        ({"error": "it broke"}, ("bad", "stopped by an error: it broke")),
    ],
)
def test_the_verdict_is_one_of_a_few(changed: dict[str, Any], expected: tuple[str, str]) -> None:
    assert verdict(RECORD | changed) == expected
    assert ("The run took" in stated(**changed)) == bool(
        (RECORD | changed)["success"] and (RECORD | changed)["arrived"]
    )


def test_what_is_printed_names_a_trip_and_a_truth_only_where_there_is_one(tmp_path: Path, capsys) -> None:
    trip = {"task": "t1", "mode": "baseline"} | {"error": "no plan", "trip": "plan_lost", "truth": {}}
    print_run(RECORD | trip, TASK, tmp_path, Console(width=200))
    out = capsys.readouterr().out
    assert "stopped by trip plan_lost\n" in out
    assert "Belief at the end: " in out
    print_run(trip | RECORD, TASK, tmp_path, Console(width=200))
    assert "Belief (truth) at the end: " in capsys.readouterr().out


PROVENANCE = {
    "created": "2030-01-02T03:04:05+00:00", "command": "amhe run --task t4", "seed": 0,
    "versions": {"amhe": "0.1.0", "mujoco": "4.0.0"}, "inputs": {}, "system_files": {},
}  # fmt: skip


def page(columns: dict[str, np.ndarray]) -> str:
    common = {"command": "run", "version": "0.1.0", "seconds": 1.0, "warnings": []}
    about = {"task": "t4", "mode": "true", "target": "sim", "seed": 0, "cost_terms": {"yaw": 1.0}}
    return run_page(TASK, columns, RECORD | common | about, PROVENANCE)


def test_a_run_without_a_cycle_has_a_page_without_figures() -> None:
    html = page({})
    assert not panels(html)
    assert "T4: a push" in html
    assert "distance of the box from its goal" in html


@pytest.mark.medium
def test_the_page_draws_path_motion_and_belief() -> None:
    names = (
        "time trunk_x trunk_y box_x box_y box_yaw foot_x foot_y speed command to_goal left plan_ms "
        "effective_samples belief/box_mass truth/box_mass"
    )
    html = page({name: np.linspace(0.1, 1.0, 50) for name in names.split()})
    titles = ["y [m]", "forward speed of the robot", "box from the goal", "box left of its path", "box_mass"]
    assert [panel["title"] for panel in panels(html)] == titles
    assert {line.get("name") for line in panels(html)[4]["lines"]} == {"true", "believed"}
    robot = page({name: np.linspace(0.1, 1.0, 50) for name in names.split() if "truth" not in name})
    assert {line.get("name") for line in panels(robot)[4]["lines"]} == {"believed"}
    assert "from x = 1.5 m on the floor friction is 0.8" in html


@pytest.fixture(scope="module")
def estimate():
    system = System.load("pendulum")
    return MovingHorizon(system, open_engine(system), np.random.default_rng(0))._estimate(
        1.0, "updated", None, 0.0
    )


@pytest.fixture
def report(tmp_path: Path):
    arrivals = deque(round(k * 1e9 / 99.6) for k in range(11))
    topics = {
        name: LiveTopic(name, silent=name == "/gone", lag=0.003, dropped=2, count=10, arrivals=arrivals)
        for name in ('/a"b', "/gone")
    }
    source: Any = SimpleNamespace(about="a test", now=0.5, topics=topics, stamp_ns=lambda at: round(1e9 * at))
    alarms = {"load_mass > 0": lambda one: one.theta[0] > 0.0}
    sent: list[str] = []
    made = WatchReport(
        tmp_path / "out",
        System.load("pendulum"),
        source,
        {"command": "x"},
        [lambda topic, *_: sent.append(topic)],
        alarms,
    )
    with made:
        yield SimpleNamespace(report=made, source=source, sent=sent)


def test_the_level_says_what_is_the_matter(report, estimate, monkeypatch) -> None:
    made = report.report
    assert made.take(None) == "" and made.status() == (OK, "waiting for the first window")
    assert made.take("a topic is gone") == "a topic is gone" and made.status()[0] == WARN
    made.take("the estimator is late: the last good belief stays")
    assert made.status()[0] == WARN
    made.take("the estimator died")
    assert made.status() == (ERROR, "the estimator died")
    monkeypatch.setattr(watch, "_RECENT", 0.0)
    made.take(estimate)
    assert made.status() == (WARN, "alarm: load_mass > 0")
    monkeypatch.setattr(watch, "_STALE", 0.0)
    assert made.status() == (STALE, "no new samples")


def test_estimates_are_sent_on_and_shown(report, estimate) -> None:
    report.report.take(estimate)
    assert report.sent == ["/amhe/params", "/amhe/covariance"]
    console = Console(record=True, width=110)
    console.print(report.report.drawn())
    text = console.export_text()
    assert "pendulum on a test" in text and "load_mass" in text and "stopped" in text and "100 Hz" in text


def test_numbers_for_prometheus_are_well_formed(report, estimate) -> None:
    report.report.take(estimate)
    lines = report.report.metrics().splitlines()
    assert all(re.fullmatch(r'amhe_\w+\{(\w+="([^"\\]|\\.)*",?)*\} \S+', line) for line in lines)
    assert 'amhe_topic_dropped_total{topic="/a\\"b"} 2' in lines
    assert 'amhe_parameter_estimate{name="load_mass",unit="kg"} 0.4' in lines


def test_the_numbers_of_a_file_are_held_against_each_estimate_once(report, estimate, monkeypatch) -> None:
    monkeypatch.setattr(watch, "_DIAGNOSED", 0.0)
    held: list[object] = []
    made = report.report
    made._audit = lambda belief: held.append(belief) or []
    for event in (None, estimate, None, None, replace(estimate, time=2.0), None):
        made.take(event)
    assert len(held) == 2


def test_blocks_are_as_high_as_the_values() -> None:
    assert blocks([0.0, 1.0, 0.5]) == "▁█▅"
    assert blocks([3.0, 3.0]) == "▁▁"
