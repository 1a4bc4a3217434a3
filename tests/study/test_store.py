"""A study that is stopped in any way goes on where it was."""

import errno
import json
import os
import zipfile
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core import files
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.study.cells import Cell
from amhe_cli.study.results import read_result, result_of, thinned
from amhe_cli.study.store import Store, Study, conduct, open_store, start
from tests.study.cells_at_play import CODE, played, record

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


def test_a_packed_study_reads_and_goes_on_as_a_folder_of_files(tmp_path: Path) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0, 1, 2))
    before = [(result.cell, result.reason, result.outcome) for result in store.results()]
    store.pack()
    assert {path.name for path in tmp_path.iterdir()} == {"study.json", "cells.zip"}
    assert [(result.cell, result.reason, result.outcome) for result in store.results()] == before
    packed = (tmp_path / "cells.zip").read_bytes()
    store.pack()
    assert (tmp_path / "cells.zip").read_bytes() == packed
    again = start(tmp_path, STUDY, resume=True, force=False)
    assert again.missing(cells(0, 1, 2, 3)) == cells(1, 3)
    run(again, cells(3))
    again.write(cells(1)[0], record({"cell": cells(1)[0].plain(), "code": CODE}))  # failed before
    assert again.missing(cells(0, 1, 2, 3)) == []
    assert [result.cell.seed for result in again.results()] == [0, 1, 2, 3]
    assert start(tmp_path, STUDY, resume=False, force=True).results() == []


def test_a_packed_file_that_is_cut_is_refused_by_its_name(tmp_path: Path) -> None:
    store = start(tmp_path, STUDY, resume=False, force=False)
    run(store, cells(0, 2))
    store.pack()
    packed = tmp_path / "cells.zip"
    packed.write_bytes(packed.read_bytes()[:-30])
    with pytest.raises(AmheError, match=r"cells\.zip: cannot be read"):
        store.results()


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


def test_a_packed_file_that_is_none_is_not_to_be_deleted(tmp_path) -> None:
    with zipfile.ZipFile(tmp_path / "cells.zip", "w") as archive:
        archive.writestr("t1-true-00-0.json", '{"cell": ')
    (packed,) = zipfile.Path(tmp_path / "cells.zip").iterdir()
    with pytest.raises(AmheError, match="cells.zip/t1-true-00-0.json: is no result.*; restore the archive"):
        read_result(packed)
