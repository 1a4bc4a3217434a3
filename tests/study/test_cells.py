"""Cells of a study, and what runs them."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from pathlib import Path

import pytest

import amhe_cli
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.study.cells import Cell, cell_of, setting_of, words
from amhe_cli.study.executors import ATTEMPTS, gathered, local, pool_of, remote
from amhe_cli.study.run import source_files
from tests.clusters import Cluster, deadly, forgetful, process_id_after, reciprocal, slow, square
from tests.study.cells_at_play import CODE


def test_all_that_decides_a_cell_is_in_its_name() -> None:
    cell = Cell("t4", "baseline", 3, setting_of({"control.samples": 16}), "belief: 1", 40.0)
    others = [
        Cell("t1", "baseline", 3, cell.setting, cell.belief),
        Cell("t4", "true", 3, cell.setting, cell.belief),
        Cell("t4", "baseline", 4, cell.setting, cell.belief),
        Cell("t4", "baseline", 3, (), cell.belief),
        Cell("t4", "baseline", 3, cell.setting, None),
        Cell("t4", "baseline", 3, cell.setting, cell.belief, 20.0),
    ]
    names = {cell.file_name(CODE), *(other.file_name(CODE) for other in others)}
    names |= {cell.file_name(CODE | {name: "other"}) for name in CODE}
    assert len(names) == 1 + len(others) + len(CODE)
    assert cell.file_name(CODE).startswith("t4-baseline-03-")


def test_a_cell_survives_json() -> None:
    import json

    cell = Cell("t4", "true", 0, setting_of({"control.sigma_range": [0.2, 1.0], "control.refine": "never"}))
    again = cell_of(json.loads(json.dumps(cell.plain())))
    assert again == cell
    assert again.file_name(CODE) == cell.file_name(CODE)
    assert hash(again) == hash(cell)
    assert words(cell.setting) == 'control.refine="never", control.sigma_range=[0.2, 1.0]'
    known = {"parameters.motor_gain.held": 0.98, "parameters.motor_gain.held_sd": 0.01, "plant": "dry"}
    assert words(setting_of(known)) == 'plant="dry", a known robot'


PACKAGE = Path(amhe_cli.__file__).parent
#: Runs a short cell in a fresh process, and prints our modules that were loaded by then.
RUN = """
import sys
from amhe_cli.study.run import code
from amhe_cli.study.run import run_cell
setting = {"control.samples": 5, "control.horizon": 8, "mhe.update_period": 0.06}
cell = {"task": "t4", "mode": "adaptive", "seed": 0, "setting": setting, "belief": None, "duration": 0.2}
assert run_cell({"cell": cell, "code": code()})["reason"] is None
print(*(module.__file__ for name, module in sys.modules.items() if name.startswith("amhe_cli.")))
"""


@pytest.mark.medium
def test_every_module_that_runs_in_a_cell_is_covered() -> None:
    loaded = subprocess.run([sys.executable, "-c", RUN], capture_output=True, text=True, check=True).stdout
    files = {Path(file).relative_to(PACKAGE).as_posix() for file in loaded.split()}
    assert {"robots/go1/judge.py", "study/results.py", "matching/cost.py"} <= files
    assert files - set(source_files(PACKAGE)) == set()


def test_the_hash_changes_with_a_source() -> None:
    files = source_files(PACKAGE)
    assert not [name for name in files if name.startswith(("cli/", "report/")) or "goals" in name]
    assert len(files["matching/cost.py"]) == 64


def never() -> bool:
    return False


def test_local_processes_do_all_the_work() -> None:
    done = dict(gathered(square, {n: n for n in range(5)}, pool_of(2, None), never))
    assert done == {n: n * n for n in range(5)}


def test_an_error_is_a_result_like_others() -> None:
    done = dict(gathered(reciprocal, {n: n for n in (0, 2)}, pool_of(1, None), never))
    assert isinstance(done[0], ZeroDivisionError)
    assert done[2] == 0.5


def test_work_whose_process_died_is_done_again(tmp_path: Path) -> None:
    assert dict(gathered(forgetful, {"a": str(tmp_path / "a")}, pool_of(1, None), never)) == {"a": "alive"}


def test_work_that_always_kills_its_process_is_given_up_and_the_rest_is_done() -> None:
    done = dict(gathered(deadly, {n: n for n in range(3)}, pool_of(1, None), never))
    assert isinstance(done.pop(0), BrokenExecutor)
    assert done == {1: 1, 2: 2}
    assert ATTEMPTS == 3


@pytest.mark.flaky(reruns=2)
def test_stopping_gives_up_what_is_running_at_once() -> None:
    begun = time.monotonic()
    came = []

    def stopped() -> bool:
        return bool(came)

    for key, value in gathered(slow, {"short": 0.0, "long": 60.0}, pool_of(2, None), stopped):
        came.append((key, value))
    assert came == [("short", 0.0)]
    assert time.monotonic() - begun < 20.0


@pytest.mark.flaky(reruns=2)
def test_leaving_a_local_pool_leaves_no_process_behind() -> None:
    with local(1) as executor:
        executor.submit(slow, 60.0)
        child = executor.submit(os.getpid)
        time.sleep(0.1)
    assert child.cancelled() or child.exception() is not None
    assert not multiprocessing.active_children()


@pytest.mark.flaky(reruns=2)
@pytest.mark.parametrize("address", ["localhost", "tcp://", "nonsense://127.0.0.1:1"])
def test_an_address_that_is_none_is_refused_in_one_line(address: str) -> None:
    pytest.importorskip("distributed")
    begun = threading.active_count()
    with pytest.raises(AmheError) as caught, remote(address):
        pass
    assert "\n" not in str(caught.value)
    assert threading.active_count() == begun, "a client that was begun ends in a traceback"


@pytest.mark.flaky(reruns=2)
def test_where_nobody_answers_it_is_reported_soon_and_how_to_start_one(monkeypatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("amhe_cli.study.executors.PATIENCE", 1.0)
    begun = time.monotonic()
    with pytest.raises(AmheError, match="no scheduler answers at tcp://127.0.0.1:9.*dask worker"):
        dict(gathered(square, {1: 1}, pool_of(1, "tcp://127.0.0.1:9"), never))
    assert time.monotonic() - begun < 8.0


def test_without_the_extra_its_name_is_reported(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match=re.escape("amhe[cluster]")), remote("tcp://127.0.0.1:8786"):
        pass


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    with Cluster(tmp_path) as cluster:
        yield cluster


@pytest.mark.flaky(reruns=2)
@pytest.mark.medium
def test_cells_of_a_killed_worker_are_run_by_another(cluster: Cluster, tmp_path: Path) -> None:
    workers = [cluster.worker(), cluster.worker()]
    started = tmp_path / "started.txt"
    items = {n: (str(started), 1.0) for n in range(4)}
    killed = False

    def stopped() -> bool:
        nonlocal killed
        running = started.read_text().split() if started.exists() else []
        if str(workers[0].pid) in running and not killed:
            workers[0].send_signal(signal.SIGKILL)
            killed = True
        return False

    done = dict(gathered(process_id_after, items, pool_of(1, cluster.address), stopped))
    assert killed
    assert done == dict.fromkeys(range(4), workers[1].pid)
    assert str(workers[0].pid) in started.read_text().split()


@pytest.mark.flaky(reruns=2)
@pytest.mark.medium
def test_a_scheduler_that_goes_away_stops_the_work_with_one_line(cluster: Cluster) -> None:
    cluster.worker()
    items = {n: 0.2 if n == 0 else 60.0 for n in range(3)}
    with pytest.raises(AmheError, match="resume=True"):
        for _ in gathered(slow, items, pool_of(1, cluster.address), never):
            cluster.close()


@pytest.mark.flaky(reruns=2)
@pytest.mark.medium
def test_a_scheduler_without_workers_is_reported_and_can_be_left(cluster: Cluster, caplog) -> None:
    begun = time.monotonic()

    def stopped() -> bool:
        return time.monotonic() - begun > 1.0

    assert not list(gathered(slow, {1: 60.0}, pool_of(1, cluster.address), stopped))
    assert f"dask worker {cluster.address}" in caplog.text
    assert time.monotonic() - begun < 15.0
