"""Work is done once, wherever it is done, and again where its worker died."""

import multiprocessing
import os
import time
from concurrent.futures import BrokenExecutor
from functools import partial
from pathlib import Path

from amhe_cli.study.executors import ATTEMPTS, gathered, local
from tests.work import (
    deadly,
    forgetful,
    reciprocal,
    slow,
    square,
)


def never() -> bool:
    return False


def test_local_processes_do_all_the_work() -> None:
    done = dict(gathered(square, {n: n for n in range(5)}, partial(local, 2), never))
    assert done == {n: n * n for n in range(5)}


def test_an_error_is_a_result_like_others() -> None:
    done = dict(gathered(reciprocal, {n: n for n in (0, 2)}, partial(local, 1), never))
    assert isinstance(done[0], ZeroDivisionError)
    assert done[2] == 0.5


def test_work_whose_process_died_is_done_again(tmp_path: Path) -> None:
    assert dict(gathered(forgetful, {"a": str(tmp_path / "a")}, partial(local, 1), never)) == {"a": "alive"}


def test_work_that_always_kills_its_process_is_given_up_and_the_rest_is_done() -> None:
    done = dict(gathered(deadly, {n: n for n in range(3)}, partial(local, 1), never))
    assert isinstance(done.pop(0), BrokenExecutor)
    assert done == {1: 1, 2: 2}
    assert ATTEMPTS == 3


def test_stopping_gives_up_what_is_running_at_once() -> None:
    begun = time.monotonic()
    came = []

    def stopped() -> bool:
        return bool(came)

    for key, value in gathered(slow, {"short": 0.0, "long": 60.0}, partial(local, 2), stopped):
        came.append((key, value))
    assert came == [("short", 0.0)]
    assert time.monotonic() - begun < 20.0


def test_leaving_a_local_pool_leaves_no_process_behind() -> None:
    with local(1) as executor:
        executor.submit(slow, 60.0)
        child = executor.submit(os.getpid)
        time.sleep(0.1)
    assert child.cancelled() or child.exception() is not None
    assert not multiprocessing.active_children()
