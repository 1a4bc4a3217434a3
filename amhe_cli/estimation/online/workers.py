"""Processes for the estimator beside a running system: in lock-step with it, or a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Protocol, TypeAlias

from amhe_cli.core.belief import Belief
from amhe_cli.core.log import Window
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon

#: Makes the estimator, from a belief to go on from or (None) from that of the run's start; it can be pickled,
#: since it may run in another process.
Factory: TypeAlias = Callable[[Belief | None], MovingHorizon]
#: The estimator gives way to the controller where there are fewer cores than work.
_NICE = 10
#: An update that takes longer than this hangs [s].
PATIENCE = 2.0
#: After so many deaths and hangs in a row no other estimator is started.
_MOST_FAILURES = 5


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that went wrong with the estimator; the last good belief stays in force.

    Args:
        time: Time at which it was noticed [s].
        text: What happened, in words.
    """

    time: float
    text: str


#: Results of the estimator.
News: TypeAlias = Estimate | Trouble


class Worker(Protocol):
    """Runs the estimator, one update at a time."""

    @property
    def ready(self) -> bool:
        """Whether no update is under way."""
        ...

    def submit(self, window: Window, at: float) -> None:
        """Start an update with a window that ends at a time [s]; only when `ready`."""
        ...

    def poll(self, now: float) -> tuple[News, ...]:
        """Results of the estimator since the last call, as known at a time [s]; never waits."""
        ...

    def close(self) -> None:
        """Stop the estimator."""
        ...


class SeenWorker:
    """A worker whose windows and estimates somebody looks at.

    Args:
        worker: Runs the estimator.
        look: Called with each window and its estimate; it returns at once.
    """

    def __init__(self, worker: Worker, look: Callable[[Window, Estimate], None]) -> None:
        self._worker, self._look = worker, look
        self._window: Window | None = None

    @property
    def ready(self) -> bool:
        """See `Worker`."""
        return self._worker.ready

    def submit(self, window: Window, at: float) -> None:
        """See `Worker`."""
        self._window = window
        self._worker.submit(window, at)

    def poll(self, now: float) -> tuple[News, ...]:
        """See `Worker`."""
        news = self._worker.poll(now)
        for each in news:
            if isinstance(each, Estimate) and self._window is not None:
                self._look(self._window, each)
        return news

    def close(self) -> None:
        """See `Worker`."""
        self._worker.close()


class InStep:
    """Updates at once, for simulations in lock-step: every run is the same, to the bit.

    Args:
        factory: Makes the estimator.
        latency: Time from the end of a window until its estimate is in force [s].
    """

    def __init__(self, factory: Factory, latency: float) -> None:
        self._estimator, self._latency = factory(None), latency
        self._waiting: tuple[float, Estimate | str] | None = None

    @property
    def ready(self) -> bool:
        """See `Worker`."""
        return self._waiting is None

    def submit(self, window: Window, at: float) -> None:
        """See `Worker`."""
        self._waiting = at + self._latency, _updated(self._estimator, window, at)

    def poll(self, now: float) -> tuple[News, ...]:
        """See `Worker`."""
        if self._waiting is None or now < self._waiting[0] - 1e-6:
            return ()
        answer, self._waiting = self._waiting[1], None
        return (_news(now, answer),)

    def close(self) -> None:
        """See `Worker`."""


class InProcess:
    """Updates in another process, for systems that run by the wall clock: nobody waits for the estimator.

    Args:
        factory: Makes the estimator, in the process.
        budget: Longest time that an update may take [s].
        patience: An update that takes longer hangs [s]: its process is ended and another one started.
        starting: The same for the start of the process, which loads a lot [s].
    """

    def __init__(
        self, factory: Factory, budget: float, patience: float = PATIENCE, starting: float = 20.0
    ) -> None:
        self._factory, self._budget = factory, budget
        self._patience, self._starting = patience, starting
        self._good: Belief | None = None
        self._failures = 0
        self._cores = _cores()
        self._start()

    @property
    def ready(self) -> bool:
        """See `Worker`."""
        return self._since is None

    def submit(self, window: Window, at: float) -> None:
        """See `Worker`; does nothing once no other estimator is started."""
        if self._given_up:
            return
        self._since, self._limit = time.monotonic(), self._patience
        # in a thread: a long window fills the pipe, and waits for a reader
        order = self._pipe, (window, at, self._budget)
        threading.Thread(target=_send, args=order, daemon=True).start()

    def poll(self, now: float) -> tuple[News, ...]:
        """See `Worker`."""
        if self._given_up:
            return ()
        try:
            if self._pipe.poll():
                answer = self._pipe.recv()
                self._since = None
                if isinstance(answer, Estimate):
                    self._good, self._failures = answer.belief, 0
                return () if answer is None else (_news(now, answer),)
        except (OSError, EOFError):
            return self._restarted(now, f"the estimator died{self._exit_code()}")
        if self._since is not None and time.monotonic() - self._since > self._limit:
            return self._restarted(now, f"the estimator gave no answer for {self._limit:g} s of the clock")
        return ()

    def close(self) -> None:
        """See `Worker`."""
        self._process.kill()
        self._process.join()
        self._pipe.close()

    @property
    def _given_up(self) -> bool:
        return self._failures >= _MOST_FAILURES

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._factory, self._good), daemon=True)
        with _without_priority(self._cores):
            self._process.start()
        theirs.close()  # so that its death is seen
        self._since: float | None = time.monotonic()
        self._limit = self._starting

    def _exit_code(self) -> str:
        self._process.join(0.1)
        code = self._process.exitcode
        return "" if code is None else f" (exit code {code})"

    def _restarted(self, now: float, what: str) -> tuple[Trouble]:
        """Start again from the belief in force, but not for ever: each start takes the controller's cores."""
        self.close()
        self._failures += 1
        if self._given_up:
            self._since = None
            return (Trouble(now, f"{what}; the last good belief stays, and no other estimator is started"),)
        self._start()
        return (Trouble(now, f"{what}; another one starts from the last good belief"),)


def _cores() -> set[int]:
    """Cores of this thread; none where the operating system does not say."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()


@contextmanager
def _without_priority(cores: set[int]) -> Iterator[None]:
    """Real-time priority and cores of a running planner are not for a process that it starts again.

    The process inherits them from this thread, and would take the planner's core while it is imported.
    """
    if not cores:
        yield
        return
    policy, priority, now = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    with suppress(OSError):  # cores may have been taken away meanwhile: the start matters more
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setaffinity(0, now)
            os.sched_setscheduler(0, policy, priority)


def _updated(
    estimator: MovingHorizon, window: Window, at: float, budget: float | None = None
) -> Estimate | str:
    """The estimate, or what went wrong: one bad window must end neither estimator nor run."""
    try:
        return estimator.update(window, at, budget)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _news(now: float, answer: Estimate | str) -> News:
    return answer if isinstance(answer, Estimate) else Trouble(now, f"the estimator failed: {answer}")


def _send(pipe: Connection, order: tuple[Window, float, float]) -> None:
    with suppress(OSError):  # it has died: poll will see that
        pipe.send(order)


def _serve(pipe: Connection, factory: Factory, belief: Belief | None) -> None:
    """Loop of the process: windows in, estimates out, until the pipe ends. None means that it is ready."""
    os.nice(_NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the run, which ends this process
    with suppress(EOFError, OSError):  # the reader has ended
        try:
            estimator = factory(belief)
        except Exception as error:
            return pipe.send(f"{type(error).__name__}: {error}")
        pipe.send(None)
        while True:
            pipe.send(_updated(estimator, *pipe.recv()))
