"""Work in processes of this machine, behind `concurrent.futures.Executor`.

Nothing here knows what the work is, and nothing heavy is imported: a fresh process begins with this file.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from typing import TypeVar

K = TypeVar("K")
T = TypeVar("T")
R = TypeVar("R")
#: Opens an executor; leaving it stops what still runs there.
Pool = Callable[[], AbstractContextManager[Executor]]

#: How often work is tried if the process that does it dies.
ATTEMPTS = 3
#: Time between two checks whether to stop [s].
_GLANCE = 0.2


@contextmanager
def local(workers: int) -> Iterator[Executor]:
    """Fresh processes on this machine."""
    others = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin)
    try:
        yield executor
    finally:
        for process in set(multiprocessing.active_children()) - others:
            process.terminate()
        executor.shutdown(cancel_futures=True)


def _begin() -> None:
    """Set up a worker: it leaves Ctrl-C to its parent, and ends when its parent has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()

    def follow() -> None:
        if parent:
            parent.join()
            os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def gathered(
    function: Callable[[T], R], items: Mapping[K, T], pool: Pool, stopped: Callable[[], bool]
) -> Iterator[tuple[K, R | Exception]]:
    """Do all the work, and yield each result as it arrives; work is repeated if its process dies.

    Args:
        function: Function to call; importable by name, as it is sent to other processes.
        items: Arguments of the function, by key.
        pool: Executor that does the work.
        stopped: Called now and then; returns whether to give up what is running.

    Yields:
        A key, and what the function returned or raised; `BrokenExecutor` of work under which the process
        died `ATTEMPTS` times.
    """
    left, deaths = dict(items), Counter[K]()
    while left and not stopped():
        # what was running when a process died runs alone from then on: only the work that kills it is given
        # up
        turn = [key for key in left if not deaths[key]] or [next(iter(left))]
        with pool() as executor:
            futures = {executor.submit(function, left[key]): key for key in turn}
            for future, running in _finished(futures, stopped):
                key, error = futures[future], _error(future)
                if isinstance(error, BrokenExecutor):
                    deaths.update([futures[other] for other in running] or turn)
                    break
                del left[key]
                yield key, error or future.result()
        for key in [key for key in left if deaths[key] >= ATTEMPTS]:
            del left[key]
            yield key, BrokenExecutor(f"its process died {ATTEMPTS} times")


def _finished(
    futures: Iterable[Future[R]], stopped: Callable[[], bool]
) -> Iterator[tuple[Future[R], list[Future[R]]]]:
    """Yield futures as they end, each with those that were running at the check before."""
    waiting, running = set(futures), list[Future[R]]()
    while waiting and not stopped():
        done, waiting = wait(waiting, _GLANCE, FIRST_COMPLETED)
        # results before errors: an error may end the loop
        for future in sorted(done, key=lambda future: _error(future) is not None):
            yield future, running
        running = [future for future in waiting if future.running()]


def _error(future: Future[R]) -> Exception | None:
    error = future.exception()
    if error is not None and not isinstance(error, Exception):
        raise error
    return error
