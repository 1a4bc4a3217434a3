"""The quicker engine: the processor for calls of few rollouts, the graphics cards for those of many."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import NOTE, SimulationError
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts, Starts, Wanted
from amhe_cli.engine.states import collides
from amhe_cli.system.parameters.model_edits import ModelEdits

logger = logging.getLogger(__name__)


#: A card has at least so many worlds; fewer would be no quicker.
FEWEST = 1024


@dataclass(frozen=True, slots=True)
class StepCost:
    """What a step of a model takes: one H100, and the cores beside it.

    Args:
        contacts: Whether it can collide.
        dofs: Its degrees of freedom.
        core: Time of one step on one core [s].
        card: Time of one step on a card, however few the worlds are [s].
        world: Time that each world adds to it, of which there are `FEWEST` at least [s].
    """

    contacts: bool
    dofs: int
    core: float
    card: float
    world: float

    def on_card(self, worlds: int) -> float:
        """Time of one step of so many worlds on a card [s]."""
        return self.card + self.world * max(worlds, FEWEST)

    def fewest(self, threads: int) -> float:
        """Number of rollouts of one length from which a card is quicker than so many cores; inf if never."""
        each = self.core / threads
        if (few := self.on_card(1) / each) <= FEWEST:
            return few
        return self.card / (each - self.world) if each > self.world else np.inf


#: pendulum, 12 joints, cube_toss, go1_push.
TABLE = (
    StepCost(False, 1, 6.2e-6, 0.27e-3, 0.02e-6),
    StepCost(False, 12, 22e-6, 0.40e-3, 0.055e-6),
    StepCost(True, 6, 7.3e-6, 0.67e-3, 0.07e-6),
    StepCost(True, 24, 123e-6, 1.6e-3, 0.65e-6),
)


def step_cost(model: mujoco.MjModel) -> StepCost:
    """The line of the table that is nearest to a model: of those that collide or not, by its size."""
    alike = [line for line in TABLE if line.contacts == collides(model)]
    return min(alike, key=lambda line: abs(np.log(max(model.nv, 1) / line.dofs)))


T = TypeVar("T")

#: Time that the cards take to open, while the processor computes on [s].
OPENS = 5.0
#: Time that calls must save beyond it: the thread that opens the cards takes Python's lock from rollouts [s].
START = 3.0
#: Calls like a large one that are expected after it, by their rollouts: as in a search with contacts.
FOLLOWING = 2.7
#: Steps of a call on the processor from which its time shows what a step takes.
MEASURED = 1000
#: The longest that a thread which opens the cards has Python's lock where another one waits for it [s]; of
#: Python's own 5 ms, rollouts on the CPU, which give the lock back and forth, would take twice as long.
BRIEF, USUAL = 2e-4, sys.getswitchinterval()
#: Name of threads that open cards, or compile for them: a process that ends does not wait for them.
OPENING = "opens cards"


def in_background(work: Callable[[], T]) -> Future[T]:
    """The result of work in a thread that the end of the process does not wait for."""
    future: Future[T] = Future()

    def fill() -> None:
        sys.setswitchinterval(BRIEF)
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)
        finally:
            sys.setswitchinterval(USUAL)

    threading.Thread(target=fill, daemon=True, name=OPENING).start()
    return future


def apart(work: Callable[[], object]) -> None:
    """Do work in a process of the lowest priority, which takes only what cores have left, and wait for it.

    Beside a thread that did it, rollouts would wait for Python's lock. The process ends with this one.

    Args:
        work: What to do; it is pickled.

    Raises:
        SimulationError: The process failed.
    """
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import _work_apart; _work_apart()"
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    assert child.stdin is not None
    with child, suppress(BrokenPipeError), child.stdin:
        child.stdin.write(pickle.dumps(work))
        child.stdin.flush()
        child.wait()  # before its stdin closes, by which it sees that this process has ended
    if child.returncode:
        raise SimulationError("the process that compiles kernels of the graphics card failed")


def _work_apart() -> None:
    """The other side of `apart`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent decides what an interrupt ends
    if hasattr(os, "nice"):
        os.nice(19)
    if hasattr(os, "SCHED_IDLE"):  # else Linux lets it end its time slice when a rollout could go on
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    work = pickle.load(sys.stdin.buffer)

    def end_with_parent() -> None:
        sys.stdin.buffer.read()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    work()
    os._exit(0)  # no thread waits for what the libraries clear up


class Opening:
    """How far the cards are opened: one for an engine and all its variants.

    Args:
        begin: Begins to open the cards for calls of so many rollouts, in the background.
    """

    def __init__(self, begin: Callable[[int], Future[Engine]]) -> None:
        self._begin = begin
        #: What calls would have saved on the cards [s], until these begin to open.
        self._saved = 0.0
        #: Time of one step on one core, as calls show it [s]; None: none was long enough.
        self.core: float | None = None
        self._cards: Future[Engine] | None = None
        #: Whether the cards have refused a call.
        self.refused = False

    @property
    def begun(self) -> bool:
        """Whether the cards open, or are open."""
        return self._cards is not None

    @property
    def done(self) -> bool:
        """Whether the cards are open; kernels that were never compiled may take a minute."""
        return self._cards is not None and self._cards.done()

    def opened(self) -> Engine:
        """The engine of the cards, which have begun to open.

        Raises:
            SimulationError: They cannot.
        """
        assert self._cards is not None
        return self._cards.result()

    def takes(self, count: int, here: float, there: float) -> bool:
        """Whether the cards compute a call that takes so long on the processor, and on open cards [s]."""
        if here <= there or self.refused:
            return False
        if self._cards is None:
            self._saved += here - there
            if self._saved + (FOLLOWING - OPENS / here) * (here - there) >= START:
                self._cards = self._begin(count)
        return self.done


class AutoEngine:
    """The processor's engine, and that of the cards for calls that are large enough.

    A call's size and the table say which of them is quicker. The first call that is worth it begins to open
    the cards; until they are, the processor computes on.

    Args:
        cpu: The engine of the processor.
        opening: How far the cards are opened.
        cards: The engine of the cards, once they are open.
        model: Model of both.
        threads: Threads of the processor's engine.
    """

    def __init__(
        self,
        cpu: CpuEngine,
        opening: Opening,
        cards: Callable[[], Engine],
        model: mujoco.MjModel,
        threads: int,
    ) -> None:
        self._cpu, self._opening, self._open, self._threads = cpu, opening, cards, threads
        self._line, self._cards = step_cost(model), None

    @property
    def precision(self) -> float:
        """See `Engine.precision`: that of the processor until the cards begin to open."""
        coarse = self._opening.begun and not self._opening.refused
        return float(np.finfo(np.float32).eps) if coarse else self._cpu.precision

    @property
    def device_bytes(self) -> int:
        """See `Engine.device_bytes`."""
        return self._opened().device_bytes if self._opening.done and not self._opening.refused else 0

    @property
    def fewest(self) -> float:
        """Number of rollouts of one length from which the cards are quicker; inf if they never are."""
        return self._line.fewest(self._threads)

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `Engine.rollout`."""
        call = len(lengths), int(lengths.sum()), int(lengths.max())
        return self._computed(*call, lambda engine: engine.rollout(theta, qpos, qvel, inputs, lengths))

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`."""
        count, lengths = len(theta), starts.lengths
        call = count * len(lengths), count * int(lengths.sum()), int(lengths.max())
        return self._computed(*call, lambda engine: engine.predict(theta, starts, errors, wanted))

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> AutoEngine:
        """See `Engine.upon`."""
        cpu, cards = self._cpu.upon(model, edits), lambda: self._opened().upon(model, edits)
        return AutoEngine(cpu, self._opening, cards, model, self._threads)

    def _computed(self, count: int, steps: int, longest: int, call: Callable[[Engine], T]) -> T:
        """A call of so many rollouts, of so many steps together and in the longest, by the quicker engine."""
        core = self._opening.core or self._line.core
        here, there = steps * core / self._threads, longest * self._line.on_card(count)
        engine = self._opened() if self._opening.takes(count, here, there) else self._cpu
        if engine is self._cpu:
            return self._measured(steps, call)
        try:
            return call(engine)
        except SimulationError as error:
            self._stand_aside(error)
            return call(self._cpu)

    def _measured(self, steps: int, call: Callable[[Engine], T]) -> T:
        """A call of the processor, whose time shows what a step takes: cores differ by a factor of two."""
        begun = time.process_time()
        done = call(self._cpu)
        if steps >= MEASURED and (self._opening.done or not self._opening.begun):  # else compilers count, too
            each = (time.process_time() - begun) / steps
            self._opening.core = min(each, self._opening.core or np.inf)
        return done

    def _opened(self) -> Engine:
        if self._cards is None:
            try:
                self._cards = self._open()
            except SimulationError as error:
                self._stand_aside(error)
        return self._cards or self._cpu

    def _stand_aside(self, error: SimulationError) -> None:
        """From now on the processor computes all, of variants too."""
        if not self._opening.refused:
            logger.log(NOTE, "the CPU computes all rollouts: %s", str(error).partition(";")[0])
        self._opening.refused, self._cards = True, self._cpu
