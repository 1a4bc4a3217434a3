"""What is said of a run."""

from typing import Any

import pytest

from amhe_cli.report import run_words
from amhe_cli.robots.go1.tasks import find_task

RECORD: dict[str, Any] = {
    "error": None, "fell": False, "interrupted": False, "success": True, "arrived": True, "on_time": True,
    "goal_error_m": 0.02, "time_s": 14.0, "duration": 40.0, "cut_short": False, "lock_step": True,
    "cycles": 500, "deadline_misses": 100, "cycle_ms": {"p50": 19.0, "p99": 25.0}, "speed_rmse": 0.03,
    "path_rmse_m": 0.01, "cost": 1200.0, "diverged": 0, "rollouts": 4000,
    "belief": {"box_mass": 4.0}, "truth": {"box_mass": 4.0},
}  # fmt: skip


def told(**changed: Any) -> str:
    said = run_words.statements(RECORD | changed, find_task("t1"), 0.02)
    return " ".join(sentence for _, sentence in said)


def test_late_cycles_wait_in_lock_step_and_cost_periods_against_the_clock() -> None:
    assert "in lock-step the simulation waits" in told()
    assert "100 of 600 periods went on with an older plan" in told(lock_step=False)
    assert "period" not in told(cycle_ms={"p50": 10.0, "p99": 19.0})


@pytest.mark.parametrize(("lock_step", "there"), [(True, False), (False, True)])
def test_deadlines_are_those_of_the_clock(lock_step: bool, there: bool) -> None:
    names = [name for name, *_ in run_words.measures(RECORD | {"lock_step": lock_step})]
    assert ("deadlines missed" in names) is there


def test_windows_that_moved_the_belief_are_counted_and_troubles_told() -> None:
    marks = {"still": 11, "updated": 13, "jump": 1}
    estimator = {
        "updates": 25,
        "marks": marks,
        "troubles": ["at 3.0 s the estimator is late"],
        "update_ms": {"p50": 80.0},
    }
    record = RECORD | {"estimator": estimator}
    assert ("windows that moved the belief", "14 of 25", "") in run_words.measures(record)
    assert "Estimator: at 3.0 s the estimator is late." in told(estimator=estimator)


@pytest.mark.parametrize(
    ("changed", "verdict"),
    [
        ({}, ("good", "success, on time")),
        ({"on_time": False}, ("good", "success, but late")),
        ({"arrived": False}, ("good", "success: close enough to the goal, though not at it in 40 s")),
        ({"success": False}, ("bad", "not done: the box is not at its goal, or strayed from its path")),
        ({"success": False, "fell": True}, ("bad", "the robot fell")),
        ({"error": "it broke"}, ("bad", "stopped: it broke")),
    ],
)
def test_the_verdict_is_one_of_a_few(changed: dict[str, Any], verdict: tuple[str, str]) -> None:
    assert run_words.verdict(RECORD | changed) == verdict
    assert ("It took" in told(**changed)) == bool(
        (RECORD | changed)["success"] and (RECORD | changed)["arrived"]
    )
