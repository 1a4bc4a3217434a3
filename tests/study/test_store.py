"""The store of a study, and its summary."""

import errno
import json
import os
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core import files
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.study.cells import Cell, setting_of
from amhe_cli.study.goals import Goal, estimates, goals
from amhe_cli.study.results import CellResult, blank, read_result, result_of, thinned
from amhe_cli.study.store import Store, Study, conduct, open_store, start
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
from tests.study.cells_at_play import CODE, played, record, result

STUDY = Study(CODE, {"control.samples": 8}, (), 40.0, ("amhe eval",), "2026-01-01T00:00:00+00:00", {})


@contextmanager
def threads():
    """One after the other, in this process."""
    with ThreadPoolExecutor(1) as executor:
        yield executor


def run(store: Store, cells: list[Cell], stopped=lambda: False) -> list[str]:
    came: list[str] = []
    conduct(store, cells, played, threads, stopped, lambda result: came.append(result.cell.title))
    return came


def cells(*seeds: int) -> list[Cell]:
    return [Cell("t4", "true", seed) for seed in seeds]


def test_only_what_is_missing_is_run_again(tmp_path: Path) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0, 2))
    again = start(tmp_path, STUDY, resume=True, force=False)
    assert again.missing(cells(0, 2, 3)) == cells(3)
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "cells").iterdir()}
    run(again, again.missing(cells(0, 2, 3)))
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    assert [result.cell.seed for result in again.results()] == [0, 2, 3]


def test_a_failed_cell_is_recorded_does_not_stop_the_rest_and_is_tried_again(tmp_path: Path) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0, 1, 2))
    reasons = {result.cell.seed: result.reason for result in store.results()}
    assert reasons == {0: None, 1: "SimulationError: the plant diverged", 2: None}
    assert store.missing(cells(0, 1, 2)) == cells(1)


def test_what_would_stop_every_cell_stops_the_study(tmp_path: Path) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    with pytest.raises(ConfigError, match="install the same"):
        run(store, cells(0, 7, 2))
    assert {result.cell.seed for result in store.results()} >= {0}


def test_an_error_of_the_executor_is_the_cells_reason(tmp_path: Path) -> None:
    class Broken(Executor):
        def submit(self, fn, /, *args, **kwargs):
            with ThreadPoolExecutor(1) as executor:
                return executor.submit(lambda: 1 / 0)

    @contextmanager
    def pool():
        yield Broken()

    store = start(tmp_path, STUDY, resume=False, force=False)
    conduct(store, cells(0), played, pool, lambda: False, lambda result: None)
    assert [result.reason for result in store.results()] == ["ZeroDivisionError: division by zero"]


def test_a_full_disk_stops_cleanly_and_the_study_goes_on_later(tmp_path: Path, monkeypatch) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0))

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", full)
        with pytest.raises(AmheError, match="No space left on device.*resume=True"):
            run(store, cells(2, 3))
    assert [path.suffix for path in (tmp_path / "cells").iterdir()] == [".json"]
    again = start(tmp_path, STUDY, resume=True, force=False)
    run(again, again.missing(cells(0, 2, 3)))
    assert [result.cell.seed for result in again.results()] == [0, 2, 3]


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match="not empty.*resume=True"):
        start(tmp_path, STUDY, resume=False, force=False)
    with pytest.raises(ConfigError, match=r"holds no study\.json"):
        start(tmp_path, STUDY, resume=True, force=False)
    with pytest.raises(ConfigError, match="is a file"):
        start(tmp_path / "mine.txt", STUDY, resume=True, force=False)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (
            replace(STUDY, code=CODE | {"sources": "ffffffffffff"}),
            "cells of sources 0123456789ab.*ffffffffffff",
        ),
        (replace(STUDY, code=CODE | {"mujoco": "5.0.0"}), "mujoco 4.0.0, and this is 5.0.0"),
        (replace(STUDY, setting=(("control.samples", 16),)), "other settings"),
        (replace(STUDY, duration=10.0), "`duration`"),
    ],
)
def test_cells_that_cannot_be_compared_are_not_mixed(tmp_path: Path, other: Study, message: str) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0))
    with pytest.raises(ConfigError, match=f"{message}.*`report`") as caught:
        start(tmp_path, other, resume=True, force=False)
    assert "\n" not in str(caught.value)
    assert len(store.results()) == 1
    assert start(tmp_path, other, resume=False, force=True).results() == []


def test_a_seed_is_not_run_under_a_second_belief(tmp_path: Path) -> None:
    first, second = (Cell("t4", "adaptive", 0, belief=text) for text in ("mass: 2", "mass: 3"))
    run(start(tmp_path, STUDY, resume=False, force=False), [first])
    known = (tmp_path / "study.json").read_text()
    with pytest.raises(ConfigError, match="t4 adaptive, seed 0 with another `belief`"):
        start(tmp_path, STUDY, resume=True, force=False, cells=[second])
    assert (tmp_path / "study.json").read_text() == known
    for one in (first, replace(second, seed=2), replace(second, mode="true", belief=None)):
        start(tmp_path, STUDY, resume=True, force=False, cells=[one])


def test_a_study_remembers_its_commands_and_its_first_day(tmp_path: Path) -> None:
    start(tmp_path, STUDY, resume=True, force=False)
    later = replace(STUDY, commands=("amhe eval --ablate samples=4",), made="2027-01-01T00:00:00+00:00")
    start(tmp_path, later, resume=True, force=False)
    study = open_store(tmp_path).study
    assert study.commands == ("amhe eval", "amhe eval --ablate samples=4")
    assert (study.made, study.defaults, study.setting) == (STUDY.made, STUDY.defaults, ())


def columns(cycles: int) -> dict[str, np.ndarray]:
    time = 0.02 * np.arange(1, cycles + 1)
    names = ("trunk_x", "trunk_y", "trunk_yaw", "box_x", "box_y", "box_yaw", "command")
    flat = {name: np.zeros(cycles) for name in names}
    return flat | {
        "time": time,
        "box_x": 0.6 + 0.2 * time,
        "speed": 0.2 + 0.1 * (-1.0) ** np.arange(cycles),
        "running_cost": np.arange(float(cycles)),
        "belief/box_mass": np.linspace(4.0, 5.0, cycles),
        "plan_ms": np.full(cycles, 17.0),
    }


def test_a_trace_keeps_the_last_row_and_says_what_never_changes_once() -> None:
    trace = thinned(columns(33), 0.02)
    assert trace["time"] == [0.2, 0.4, 0.6, 0.66]
    assert trace["box_x"] == [0.64, 0.68, 0.72, 0.732]
    assert trace["trunk_y"] == 0
    assert "plan_ms" not in trace
    assert len(trace["belief/box_mass"]) == 4


def test_what_nobody_knows_yet_is_null_and_comes_back_as_nan() -> None:
    sd = np.where(np.arange(30) < 15, np.nan, 0.12345)
    trace = thinned(columns(30) | {"belief_sd/box_mass": sd}, 0.02)
    assert trace["belief_sd/box_mass"] == [None, 0.1234, 0.1234]
    plain = record({"cell": Cell("t1", "true", 0).plain(), "code": CODE}) | {"trace": trace}
    again = result_of(json.loads(json.dumps(plain, allow_nan=False))).trace["belief_sd/box_mass"]
    assert np.isnan(again[0])
    assert again[1] == 0.1234


def test_what_swings_within_a_row_is_averaged_and_sums_stay() -> None:
    trace = thinned(columns(40), 0.02)
    assert trace["speed"] == pytest.approx(0.2)
    assert 10 * sum(trace["running_cost"]) == pytest.approx(sum(range(40)))


def test_a_whole_episode_is_small() -> None:
    noisy = {
        name: values + np.random.default_rng(0).normal(0, 1, 2000) for name, values in columns(2000).items()
    }
    assert len(json.dumps(thinned(noisy, 0.02), separators=(",", ":"))) < 20_000


def test_a_result_has_all_rows_of_every_column() -> None:
    result = result_of(record({"cell": Cell("t1", "true", 0).plain(), "code": CODE}))
    assert {values.shape for values in result.trace.values()} == {(60,)}
    assert result.measure("success") == 1.0


def test_a_number_that_does_not_exist_is_nan_but_a_key_of_other_code_is_an_error() -> None:
    plain = record({"cell": Cell("t1", "true", 0).plain(), "code": CODE})
    result = result_of(plain | {"outcome": plain["outcome"] | {"path_rmse_m": None}})
    assert np.isnan(result.measure("path_rmse_m"))
    with pytest.raises(AmheError, match="t1 true, seed 0: its result has no goal_error; other code"):
        result.measure("goal_error")


def test_a_file_that_is_none_is_refused_by_its_name(tmp_path) -> None:
    path = tmp_path / "t1-true-00-0.json"
    path.write_text('{"cell": ')
    with pytest.raises(AmheError, match="t1-true-00-0.json: is no result.*delete the file.*resume=True"):
        read_result(path)


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


def run_of_cells(seed: int, mass: float, sd: float, changes: bool = True) -> CellResult:
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
    found = of(run_of_cells(0, mass=5.4, sd=0.1))
    assert (found.mass, found.friction, found.product) == pytest.approx((0.1, 0.0, 0.1))
    assert (found.mass_held, found.friction_held, found.resolved) == (0.0, 1.0, 1.0), "10 % is near enough"


def test_an_error_is_held_by_an_interval_that_is_wide_enough() -> None:
    far, wide = run_of_cells(0, mass=4.5, sd=0.1), run_of_cells(1, mass=4.5, sd=0.9)
    assert of(far).resolved == 0.0
    assert of(wide).mass_held == of(wide).resolved == 1.0
    assert (of(far, wide).mass_held, of(far, wide).resolved, of(far, wide).n) == (0.5, 0.5, 2)


def test_where_nothing_changes_it_counts_from_the_start() -> None:
    found = of(run_of_cells(0, mass=4.4, sd=1.0, changes=False))
    late = TIME >= 3.0
    assert found.mass == pytest.approx(0.1 * np.sqrt((TIME[late] > 6.1).mean()), rel=1e-6)


def test_without_an_estimator_there_is_nothing_to_judge() -> None:
    known = run_of_cells(0, 6.0, 0.1)
    trace = {name: values for name, values in known.trace.items() if "sd" not in name}
    bare = CellResult(known.cell, {}, None, {}, trace, 1.0)
    assert estimates(Group("t3", "true", (), (bare,), 0)) is None
