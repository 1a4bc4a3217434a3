"""Executors: local processes, or a cluster of dask workers, behind `concurrent.futures.Executor`.

Nothing here knows what the work is, and nothing heavy is imported: a fresh process begins with this file.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import TypeVar

from amhe_cli.core.errors import AmheError, ConfigError

logger = logging.getLogger(__name__)

K = TypeVar("K")
T = TypeVar("T")
R = TypeVar("R")
#: Opens an executor; leaving it stops what still runs there.
Pool = Callable[[], AbstractContextManager[Executor]]

#: How often work is tried if the process that does it dies.
ATTEMPTS = 3
#: Longest time in which a scheduler must answer [s].
PATIENCE = 10.0
#: Time between two checks whether to stop [s].
_GLANCE = 0.2


def pool_of(workers: int, cluster: str | None) -> Pool:
    """The local pool, or that of a scheduler's address where one is given."""
    return (lambda: local(workers)) if cluster is None else (lambda: remote(cluster))


def executor_of(workers: int | None, cluster: str | None) -> AbstractContextManager[Executor | None]:
    """The requested executor, open; None where none was requested."""
    return nullcontext() if workers is None and cluster is None else pool_of(workers or 1, cluster)()


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


@contextmanager
def remote(address: str) -> Iterator[Executor]:
    """The workers of a dask scheduler; the work of one that dies is done by another.

    Args:
        address: Its address, such as tcp://host:8786 or tls://host:8786.

    Raises:
        ConfigError: The extra is not installed, or the address is none.
        AmheError: No scheduler answers at the address.
    """
    try:
        from distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError:
        raise ConfigError("`cluster` needs the extra: pip install 'amhe[cluster]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # relevant errors return with the futures
    try:
        get_address_host_port(address)  # a client refuses an address only after 20 s, and noisily
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except ValueError as error:
        raise ConfigError(f"`cluster` {address}: {error}; write tcp://HOST:8786") from None
    except TypeError:  # a TLS address without certificates
        raise ConfigError(
            f"`cluster` {address}: dask's configuration names no certificates for TLS (docs/scaling.md)"
        ) from None
    except (OSError, AssertionError):  # AssertionError: dask's own thread did not start in 10 s
        raise AmheError(
            f"no scheduler answers at {address} within {PATIENCE:g} s: start one with `dask scheduler`, "
            f"and workers with `dask worker {address} --nthreads 1`"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            logger.warning(
                "the scheduler has no workers yet, and this waits for some: `dask worker %s --nthreads 1`",
                address,
            )
        executor = client.get_executor(pure=False)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)


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

    Raises:
        AmheError: The cluster is gone.
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
    try:
        error = future.exception()
    except CancelledError:  # not cancelled by us: we never read a future that we cancelled
        raise AmheError(
            "the scheduler is gone; what is done is kept: start it again with `resume=True`"
        ) from None
    if error is not None and not isinstance(error, Exception):
        raise error
    return error
