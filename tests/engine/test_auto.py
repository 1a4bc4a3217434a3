"""The engine that takes the processor or the cards for each call."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from threading import Event
from time import sleep
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.errors import NOTE, SimulationError
from amhe_cli.engine import open as opening
from amhe_cli.engine.auto import (
    BRIEF,
    FEWEST,
    FOLLOWING,
    TABLE,
    AutoEngine,
    StepCost,
    apart,
    in_background,
    step_cost,
)
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.gpu.engine import GpuEngine
from amhe_cli.engine.open import open_engine
from tests.engine.test_contract import CUBE, PENDULUM, clips, some


class Cards:
    """Takes the place of the cards: the processor's numbers, and the sizes of the calls."""

    def __init__(self, engine: Any) -> None:
        self.engine, self.calls = engine, []
        self.precision, self.device_bytes = engine.precision, 2**30

    def rollout(self, *arguments: Any) -> Any:
        self.calls.append(len(arguments[-1]))
        return self.engine.rollout(*arguments)

    def predict(self, theta: Any, starts: Any, *rest: Any) -> Any:
        self.calls.append(len(theta) * len(starts.lengths))
        return self.engine.predict(theta, starts, *rest)

    def load(self, count: int, compilers: int) -> None:
        """Nothing to load."""

    def upon(self, model: Any, edits: Any = None) -> Cards:
        return Cards(self.engine.upon(model, edits))


@pytest.fixture
def cards(monkeypatch: pytest.MonkeyPatch) -> list[Cards]:
    """The engines of the cards that were opened, on a computer that has one."""
    opened: list[Cards] = []

    def opens(
        executor: object, model: Any, edits: Any, input_spec: int, sensors: bool, beside: object
    ) -> Cards:
        opened.append(Cards(CpuEngine(model, edits, input_spec, 1, sensors)))
        return opened[-1]

    monkeypatch.setattr(opening, "look_for_cards", lambda: None)
    monkeypatch.setattr(opening, "_gpu_engine", opens)
    for name, value in {"START": 0.0, "OPENS": 0.0, "MEASURED": np.inf}.items():
        monkeypatch.setattr(f"amhe_cli.engine.auto.{name}", value)
    monkeypatch.setattr(opening, "in_background", at_once)
    return opened


def at_once(work: Callable[[], Any]) -> Future[Any]:
    """What `in_background` gives, when the work is done."""
    future: Future[Any] = Future()
    try:
        future.set_result(work())
    except SimulationError as error:
        future.set_exception(error)
    return future


def alike(count: int) -> Any:
    """So many rollouts of the same length."""
    theta, qpos, qvel, inputs, _ = some(count)
    return theta, qpos, qvel, inputs, np.full(count, 40)


def auto() -> AutoEngine:
    engine = open_engine(PENDULUM, kind="auto")
    assert isinstance(engine, AutoEngine)
    return engine


def test_without_a_card_it_is_the_engine_of_the_processor_and_says_so(monkeypatch, caplog) -> None:
    monkeypatch.setattr("amhe_cli.engine.gpu.visible._driver", lambda: None)
    caplog.set_level(NOTE, "amhe_cli")
    assert isinstance(open_engine(PENDULUM, kind="auto"), CpuEngine)
    assert caplog.messages == ["the CPU computes all rollouts: no graphics card that CUDA can use"]


def test_small_calls_go_to_the_processor_and_large_ones_to_the_cards(cards, caplog) -> None:
    caplog.set_level(NOTE, "amhe_cli")
    engine = auto()
    assert f"calls of {engine.fewest:.0f} equally long rollouts or more" in caplog.text
    few = int(engine.fewest)
    engine.rollout(*alike(few))
    engine.rollout(*some(few + 10))  # most of them would wait for the longest
    assert not cards, "the libraries of the cards are not even loaded"
    assert engine.precision == CpuEngine.precision
    engine.rollout(*alike(few + 1))
    assert cards[0].calls == [few + 1]
    assert engine.precision == GpuEngine.precision
    starts, wanted = clips(PENDULUM, 10)
    theta = some(few // 5)[0]
    done, alone = (each.predict(theta, starts, None, wanted) for each in (engine, open_engine(PENDULUM)))
    assert cards[0].calls[1:] == [10 * len(theta)]
    np.testing.assert_array_equal(done.values[0], alone.values[0])


def test_cards_open_once_that_is_worth_it_while_the_processor_computes_on(cards, monkeypatch) -> None:
    ready: Future[Any] = Future()
    monkeypatch.setattr(opening, "in_background", lambda work: ready.set_result(work()) or ready)
    engine = auto()
    large = alike(int(2.0 * engine.fewest))  # takes 1 on the cards, 2 on the processor
    each = 40 * step_cost(PENDULUM.model).on_card(1)
    monkeypatch.setattr("amhe_cli.engine.auto.START", (3.5 + FOLLOWING - 1.0) * each)
    monkeypatch.setattr("amhe_cli.engine.auto.OPENS", 2.0 * each)
    for _ in range(3):
        engine.rollout(*large)  # these gain 3, and those that are expected, but for one while the cards open
    assert not cards
    monkeypatch.setattr(ready, "done", lambda: False)
    for _ in range(5):
        engine.rollout(*large)
    assert [one.calls for one in cards] == [[]], "they open"
    monkeypatch.undo()
    engine.rollout(*large)
    assert [len(one.calls) for one in cards] == [1]


def test_rollouts_do_not_wait_for_the_thread_that_opens_the_cards() -> None:
    """It holds Python's lock, which each call of numpy's or MuJoCo's gives back and wants again."""
    begun, end = Event(), Event()
    usual = sys.getswitchinterval()

    def busy() -> None:
        begun.set()
        while not end.is_set():
            pass

    future = in_background(busy)
    begun.wait()
    assert sys.getswitchinterval() == pytest.approx(BRIEF)
    end.set()
    future.result()
    while sys.getswitchinterval() != usual:
        sleep(0.001)


def test_two_engines_that_open_at_a_time_leave_the_lock_as_it_was() -> None:
    usual, begun, end = sys.getswitchinterval(), (Event(), Event()), (Event(), Event())
    futures = []
    for i in range(2):
        futures.append(in_background(lambda i=i: (begun[i].set(), end[i].wait())))
        begun[i].wait()
    for i in range(2):
        end[i].set()
        futures[i].result()
        sleep(0.05)  # what a thread does after its result
    assert sys.getswitchinterval() == usual


def test_variants_of_a_model_share_the_cards(cards) -> None:
    engine = auto()
    variant = engine.upon(PENDULUM.model)
    variant.rollout(*alike(int(engine.fewest) + 1))
    variant.upon(PENDULUM.model).rollout(*alike(int(engine.fewest) + 1))
    assert len(cards) == 1


@pytest.mark.medium
def test_the_end_of_a_process_does_not_wait_for_cards_that_still_open() -> None:
    code = """
import threading
import numpy as np
from amhe_cli.engine import auto, open as opening
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.gpu.engine import GpuEngine
from amhe_cli.system.system import System

auto.START = auto.OPENS = 0.0
begun = threading.Event()
opening.look_for_cards = lambda: None
opening._gpu_engine = lambda *about, **beside: begun.set() or threading.Event().wait()
CpuEngine.rollout = lambda *arguments: print("computed")
engine = opening.open_engine(System.load("pendulum"), kind="auto")
engine.rollout(*4 * [np.zeros(0)], np.full(3000, 40))
begun.wait()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30)
    assert (done.returncode, done.stdout, done.stderr) == (0, "computed\n", "")


@pytest.mark.medium
def test_a_call_that_the_cards_refuse_goes_to_the_processor_and_so_do_all_others(
    cards, monkeypatch, caplog
) -> None:
    def refuses(self: Cards, *arguments: object) -> None:
        self.calls.append(0)
        raise SimulationError("the graphics card has too little free memory; take the engine 'cpu'")

    monkeypatch.setattr(Cards, "rollout", refuses)
    caplog.set_level(NOTE, "amhe_cli")
    engine, large = auto(), alike(2000)
    variant = engine.upon(PENDULUM.model)
    found = [each.rollout(*large).qpos for each in (engine, engine, variant)]
    np.testing.assert_array_equal(found, 3 * [open_engine(PENDULUM).rollout(*large).qpos])
    assert [one.calls for one in cards] == [[0]]
    assert caplog.messages[1:] == [
        "the CPU computes all rollouts: the graphics card has too little free memory"
    ]


def test_work_apart_takes_what_cores_have_left_and_ends_with_its_parent(tmp_path, monkeypatch) -> None:
    done = tmp_path / "done"
    about = "f'{os.nice(0)} {os.sched_getscheduler(0)}'"
    apart(partial(exec, f"import os; open({str(done)!r}, 'w').write({about})"))
    assert done.read_text() == f"19 {os.SCHED_IDLE}"
    with pytest.raises(SimulationError, match="^the process that compiles .* failed$"):
        apart(partial(exec, "1 / 0"))
    with pytest.raises(SimulationError, match="failed$"), monkeypatch.context() as without:
        without.setattr(sys, "executable", "/bin/false")
        apart(partial(len, bytes(10**7)))  # which no pipe holds
    code = """
import functools, os, threading, time
from amhe_cli.engine import auto
from pathlib import Path
work = functools.partial(exec, "import os, time; open('child', 'w').write(str(os.getpid())); time.sleep(60)")
threading.Thread(target=auto.apart, args=[work], daemon=True).start()
while not Path("child").exists() or not Path("child").read_text():
    time.sleep(0.01)
os._exit(0)
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, timeout=30)
    child = Path("/proc", (tmp_path / "child").read_text())
    for _ in range(1000):
        if not child.exists() or "zombie" in (child / "status").read_text():
            return
        sleep(0.01)
    raise AssertionError("it goes on without its parent")


def test_mujoco_warp_is_loaded_when_a_call_is_worth_it(monkeypatch, caplog) -> None:
    """It takes seconds; here it cannot be loaded at all."""
    monkeypatch.setattr(opening, "look_for_cards", lambda: None)
    monkeypatch.setattr(opening, "visible_cards", lambda: ["cuda:0"])
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.setattr(opening, "in_background", at_once)
    for name in ("START", "OPENS"):
        monkeypatch.setattr(f"amhe_cli.engine.auto.{name}", 0.0)
    caplog.set_level(NOTE, "amhe_cli")
    engine = auto()
    engine.rollout(*some(2))
    assert len(caplog.messages) == 1, "only where the card is quicker"
    engine.rollout(*alike(int(engine.fewest) + 1))
    assert "which is not installed: pip install 'amhe[gpu]'" in caplog.messages[1]


def test_what_a_step_takes_is_seen_in_calls(cards, monkeypatch) -> None:
    """Cores differ by a factor of two, and so does the size from which the cards are quicker."""
    engine, large = auto(), alike(30)
    monkeypatch.setattr("amhe_cli.engine.auto.MEASURED", 30 * 40)
    clock = iter([0.0, 30 * 40 * 1e-3, 5.0, 5.0 + 30 * 40 * 1e-7])  # slow, and quick
    monkeypatch.setattr("amhe_cli.engine.auto.time.process_time", lambda: next(clock))
    engine.rollout(*large)
    engine.rollout(*alike(29))
    assert [one.calls for one in cards] == [[29]]


def test_the_table_is_read_by_contacts_and_size() -> None:
    assert step_cost(PENDULUM.model) is TABLE[0]
    assert step_cost(CUBE.model) is TABLE[2]


def test_a_card_is_quicker_from_where_its_step_is_cheaper() -> None:
    few, many = StepCost(True, 1, 1.0, 1.0, 1.0 / FEWEST), StepCost(True, 1, 1.0, 3.0 * FEWEST, 0.5)
    assert few.fewest(1) == 2.0, "a step takes 2, whether of 1 world or of 1,024"
    assert few.fewest(8) == 16.0
    assert many.fewest(1) == 6.0 * FEWEST
    assert many.fewest(2) == np.inf, "two cores step a world in the time of a card"
    for line, threads in ((few, 1), (few, 8), (many, 1)):
        count = round(line.fewest(threads))
        assert line.on_card(count) == pytest.approx(count * line.core / threads)
