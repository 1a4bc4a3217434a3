"""A study that is stopped in any way goes on where it was."""

import errno
import os
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from amhe_cli.core import files
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.study.cells import Cell
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
