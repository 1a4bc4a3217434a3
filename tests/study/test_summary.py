"""Errors and intervals of online estimates, on runs that are made up."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.study.cells import Cell, setting_of
from amhe_cli.study.goals import Goal, estimates, goals
from amhe_cli.study.results import CellResult, blank, result_of
from amhe_cli.study.summary import (
    Group,
    Groups,
    ablations,
    bootstrap,
    difference,
    paired,
    rate,
    spread,
    summary,
    wilson,
)
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


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def mean(x: np.ndarray) -> np.ndarray:
    return x[..., 0].mean(axis=-1)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(15, 15, 0.796, 1.0), (0, 15, 0.0, 0.204), (13, 15, 0.621, 0.963), (5, 10, 0.237, 0.763)],
)
def test_wilson_has_the_published_values(successes: int, n: int, low: float, high: float) -> None:
    assert wilson(successes, n) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_stays_within_0_and_1_and_holds_the_share(pair: tuple[int, int]) -> None:
    low, high = wilson(*pair)
    assert 0.0 <= low <= pair[0] / pair[1] + 1e-12
    assert pair[0] / pair[1] - 1e-12 <= high <= 1.0


def test_the_bootstrap_of_a_mean_is_that_of_the_normal_theory() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, (200, 1))
    low, high = bootstrap(values, mean, rng())
    half = 1.96 * values.std(ddof=1) / np.sqrt(200)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.03)


def test_its_interval_covers_as_often_as_it_says() -> None:
    draws = np.random.default_rng(2)
    hits = 0
    for _ in range(120):
        low, high = bootstrap(draws.normal(size=(15, 1)), mean, draws)
        hits += low <= 0.0 <= high
    assert 0.88 <= hits / 120 <= 0.99


def test_a_spread_leaves_missing_values_out() -> None:
    found = spread(np.array([1.0, np.nan, 3.0]), rng())
    assert (found.n, found.mean, found.sd, found.median) == (2, 2.0, pytest.approx(np.sqrt(2.0)), 2.0)
    assert np.isnan(spread(np.array([]), rng()).mean)
    assert np.isnan(spread(np.array([1.0]), rng()).low)


def test_a_rate_is_a_share_with_the_papers_sd() -> None:
    found = rate(np.array([1.0] * 13 + [0.0] * 2))
    assert (found.n, found.mean, found.sd) == (
        15,
        pytest.approx(0.867, abs=1e-3),
        pytest.approx(0.352, abs=1e-3),
    )


def test_pairs_take_out_what_seeds_have_in_common() -> None:
    common = np.random.default_rng(3).normal(10.0, 5.0, 15)
    found = paired(common + 0.1, common, rng())
    assert (found.n, found.mean) == (15, pytest.approx(0.1))
    assert (found.low, found.high) == (pytest.approx(0.1), pytest.approx(0.1))
    assert found.ratio == pytest.approx(0.1 / common.mean())


def test_a_pair_that_lacks_one_value_does_not_count() -> None:
    assert paired(np.array([1.0, np.nan, 2.0]), np.array([1.0, 1.0, 1.0]), rng()).n == 2
    assert paired(np.array([]), np.array([]), rng()).n == 0


TIME = np.round(0.2 * np.arange(1, 61), 2)


def run(seed: int, mass: float, sd: float, changes: bool = True) -> CellResult:
    """Friction is right, and so is the mass up to 6.2 s, where it changes; then `mass` is believed."""
    after = changes * (TIME > 6.1)
    trace = {
        "time": TIME,
        "truth/box_mass": 4.0 + 2.0 * after,
        "truth/floor_friction": np.full(60, 0.4),
        "belief/box_mass": np.where(TIME > 6.1, mass, 4.0),
        "belief/floor_friction": np.full(60, 0.4),
        "belief_sd/box_mass": np.where(TIME > 6.1, sd, np.nan),
        "belief_sd/floor_friction": np.full(60, 0.01),
    }
    return CellResult(Cell("t3", "adaptive", seed), {}, None, {}, trace, 1.0)


def of(*results: CellResult):
    found = estimates(Group("t3", "adaptive", (), results, 0))
    assert found
    return found


def test_errors_count_from_a_while_after_the_change() -> None:
    found = of(run(0, mass=5.4, sd=0.1))
    assert (found.mass, found.friction, found.product) == pytest.approx((0.1, 0.0, 0.1))
    assert (found.mass_held, found.friction_held, found.resolved) == (0.0, 1.0, 1.0), "10 % is near enough"


def test_an_error_is_held_by_an_interval_that_is_wide_enough() -> None:
    far, wide = run(0, mass=4.5, sd=0.1), run(1, mass=4.5, sd=0.9)
    assert of(far).resolved == 0.0
    assert of(wide).mass_held == of(wide).resolved == 1.0
    assert (of(far, wide).mass_held, of(far, wide).resolved, of(far, wide).n) == (0.5, 0.5, 2)


def test_where_nothing_changes_it_counts_from_the_start() -> None:
    found = of(run(0, mass=4.4, sd=1.0, changes=False))
    late = TIME >= 3.0
    assert found.mass == pytest.approx(0.1 * np.sqrt((TIME[late] > 6.1).mean()), rel=1e-6)


def test_without_an_estimator_there_is_nothing_to_judge() -> None:
    known = run(0, 6.0, 0.1)
    trace = {name: values for name, values in known.trace.items() if "sd" not in name}
    bare = CellResult(known.cell, {}, None, {}, trace, 1.0)
    assert estimates(Group("t3", "true", (), (bare,), 0)) is None
