from dataclasses import replace

from amhe_cli.study.cells import Cell, setting_of
from amhe_cli.study.goals import Goal, goals
from amhe_cli.study.results import blank, result_of
from amhe_cli.study.summary import Groups, ablations, difference, summary
from tests.study.cells_at_play import CODE, result

TASKS, MODES = ("t1", "t4", "t5"), ("true", "baseline", "stale", "adaptive")


def groups(*results, base=()) -> Groups:
    return Groups(results, base, TASKS, MODES)


def seeds(mode: str, n: int = 3, task: str = "t4", worse: float = 1.0, **setting):
    return [result(Cell(task, mode, seed, setting_of(setting)), worse) for seed in range(n)]


def test_a_summary_has_a_row_a_group_in_the_order_of_tasks_and_modes() -> None:
    failed = result_of(blank({"cell": Cell("t4", "true", 9).plain(), "code": CODE}, "fell apart"))
    rows = summary(groups(*seeds("baseline"), *seeds("true", 2), failed, *seeds("true", task="t1")))
    assert [(row["task"], row["mode"], row["n"], row["failed"]) for row in rows] == [
        ("t1", "true", 3, 0), ("t4", "true", 2, 1), ("t4", "baseline", 3, 0)
    ]  # fmt: skip
    assert {"mean", "sd", "low", "high", "median"} == set(rows[0]["measures"]["cost"])
    assert rows[0]["measures"]["success"]["mean"] == 1.0


def test_differences_are_taken_on_the_seeds_that_both_have() -> None:
    found = groups(*seeds("true", 2), *seeds("adaptive", 5, worse=0.03))
    d = difference(found.get("t4", "adaptive"), found.get("t4", "true"), "cost")
    assert d.n == 2
    assert round(d.mean, 6) == 30.0
    assert 0.029 < d.ratio < 0.03


def test_goals_are_judged_by_the_numbers() -> None:
    judged = goals(groups(*seeds("true"), *seeds("adaptive", worse=0.1)))
    by_name = {(goal.mode, goal.measure): goal for goal in judged}
    assert by_name["true", "success"].reached
    assert by_name["true", "speed_rmse"].limit == 0.095
    assert not by_name["adaptive", "success"].reached
    assert by_name["adaptive", "goal_error_m"].reached
    assert not by_name["adaptive", "cost"].reached
    assert not by_name["adaptive", "cost"].at_least
    assert abs(by_name["adaptive", "cost"].value - 0.1) < 0.002


def test_a_goal_is_judged_by_the_value_and_not_by_the_luck_of_its_interval() -> None:
    late = Goal("t4", "adaptive", "cost", "ratio", 0.06, 0.01, 0.11, limit=0.05, n=15)
    assert not late.reached
    assert replace(late, value=0.05).reached
    assert replace(late, measure="success").reached
    assert not replace(late, value=0.04, measure="success").reached


def test_ablations_change_one_thing_and_hold_the_operating_point() -> None:
    found = groups(
        *seeds("true"),
        *seeds("true", **{"control.samples": 16}),
        *seeds("true", **{"control.samples": 4}),
        *seeds("true", **{"control.samples": 4, "control.refine": "never"}),
        *seeds("true", **{"control.refine": "never"}),
    )
    defaults = {"control.samples": 8, "control.refine": "switch"}
    refine, samples = ablations(found, defaults)
    assert (samples.path, samples.values, samples.default) == ("control.samples", (4, 8, 16), 1)
    assert (refine.values, refine.default) == (("never", "switch"), 1)


def test_an_ablation_about_another_operating_point_knows_the_defaults() -> None:
    base = setting_of({"control.samples": 16})
    found = groups(*seeds("true", **dict(base)), *seeds("true"), base=base)
    (samples,) = ablations(found, {"control.samples": 8})
    assert (samples.values, samples.default) == ((8, 16), 1)
