"""Estimators in lock-step and in a process: whatever becomes of one, nobody waits for it."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from amhe_cli.core.belief import Belief, belief_of, gaussian_of
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.workers import InProcess, InStep, Trouble
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.system import System

pytestmark = pytest.mark.flaky(reruns=2)

SYSTEM = System.load(find_system("go1_push"))


class Puppet:
    """An estimator that does what the window says, and counts up from the belief that it begins with."""

    def __init__(self, belief: Belief | None = None) -> None:
        self.count = 0.0 if belief is None else float(gaussian_of(SYSTEM.space, belief)[0][0])

    def update(self, window: str, at: float, budget: float | None = None) -> Estimate:
        self.count += 1
        if window == "die":
            os._exit(7)
        if window == "hang":
            time.sleep(60.0)
        if window == "fail":
            raise ValueError("no such window")
        space = SYSTEM.space
        belief = belief_of(SYSTEM, np.full(3, self.count), np.eye(3))
        nothing = np.zeros(3)
        theta = space.nominal + self.count
        return Estimate(at, theta, nothing, nothing, nothing, belief, "updated", 1.0, 1.0, 9, 0, 1.0)


def wait(worker: InProcess, seconds: float = 20.0) -> tuple:
    """Poll until there is something."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := worker.poll(1.0):
            return found
        time.sleep(0.01)
    raise AssertionError("nothing came")


def ready(worker: InProcess) -> None:
    end = time.monotonic() + 20.0
    while not worker.ready and time.monotonic() < end:
        worker.poll(0.0)
        time.sleep(0.01)
    assert worker.ready


@pytest.mark.medium
@pytest.mark.parametrize(
    ("order", "message"),
    [("fail", "ValueError: no such window"), ("die", "died (exit code 7)"), ("hang", "no answer for 0.3 s")],
)
def test_whatever_becomes_of_the_estimator_the_controller_goes_on(order: str, message: str) -> None:
    worker = InProcess(Puppet, budget=0.2, patience=0.3)  # type: ignore[arg-type]
    try:
        ready(worker)
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        (one,) = wait(worker)
        assert one.time == 3.0 and one.theta[0] == SYSTEM.space.nominal[0] + 1
        begun = time.monotonic()
        worker.submit(order, 4.0)  # type: ignore[arg-type]
        at_once = worker.poll(4.0)
        assert time.monotonic() - begun < 0.1, "nobody waits for it"
        (two,) = at_once or wait(worker)
        assert isinstance(two, Trouble) and message in two.text
        ready(worker)  # a new one, or the same
        worker.submit("fine", 5.0)  # type: ignore[arg-type]
        (three,) = wait(worker)
        assert three.time == 5.0
        assert three.theta[0] > one.theta[0] + 0.5, "it goes on from the last good belief"
    finally:
        worker.close()


def dies(belief: Belief | None) -> MovingHorizon:
    os._exit(3)


@pytest.mark.medium
def test_an_estimator_that_dies_again_and_again_is_given_up() -> None:
    worker = InProcess(dies, budget=0.2)
    try:
        texts = [wait(worker)[0].text for _ in range(5)]
        assert all("died (exit code 3)" in text for text in texts)
        assert [("no other estimator" in text) for text in texts] == [False] * 4 + [True]
        assert worker.ready, "it is not late: nobody is asked"
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        assert worker.ready and worker.poll(3.1) == ()
    finally:
        worker.close()


def breaks(belief: Belief | None) -> MovingHorizon:
    raise ValueError("no such model")


@pytest.mark.medium
def test_why_an_estimator_cannot_begin_is_reported() -> None:
    worker = InProcess(breaks, budget=0.2)
    try:
        texts = [one.text for _ in range(2) for one in wait(worker)]
        assert "ValueError: no such model" in texts[0]
        assert "the estimator died" in texts[1]
    finally:
        worker.close()


@pytest.mark.medium
def test_a_ctrl_c_is_for_the_run_and_leaves_the_estimator_alone(capfd: pytest.CaptureFixture[str]) -> None:
    worker = InProcess(Puppet, budget=0.2)  # type: ignore[arg-type]
    try:
        ready(worker)
        assert worker._process.pid is not None
        os.kill(worker._process.pid, signal.SIGINT)
        time.sleep(0.2)
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        (one,) = wait(worker)
        assert one.time == 3.0
    finally:
        worker.close()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.medium
def test_a_window_that_fills_the_pipe_of_a_hung_estimator_holds_nobody_up() -> None:
    worker = InProcess(Puppet, budget=0.2, patience=0.3)  # type: ignore[arg-type]
    try:
        ready(worker)
        worker.submit("hang", 3.0)  # type: ignore[arg-type]
        time.sleep(0.1)
        begun = time.monotonic()
        worker.submit("long" * 1_000_000, 3.1)  # type: ignore[arg-type]
        assert time.monotonic() - begun < 0.1
        assert "no answer" in wait(worker)[0].text
    finally:
        worker.close()


def test_in_lock_step_a_window_that_breaks_the_estimator_is_reported_and_passed_over() -> None:
    worker = InStep(Puppet, latency=0.08)  # type: ignore[arg-type]
    worker.submit("fail", 1.0)  # type: ignore[arg-type]
    assert not worker.ready and worker.poll(1.07) == ()
    (one,) = worker.poll(1.08)
    assert isinstance(one, Trouble) and "ValueError: no such window" in one.text
    worker.submit("fine", 2.0)  # type: ignore[arg-type]
    assert isinstance(worker.poll(2.08)[0], Estimate)


def reports_its_place(belief: Belief | None) -> MovingHorizon:
    raise ValueError(f"policy {os.sched_getscheduler(0)} on {sorted(os.sched_getaffinity(0))}")


@pytest.mark.medium
@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="there is no such call")
def test_an_estimator_that_a_planner_starts_again_has_neither_its_priority_nor_its_cores() -> None:
    policy, priority, cores = os.sched_getscheduler(0), os.sched_getparam(0), os.sched_getaffinity(0)
    worker = InProcess(reports_its_place, budget=0.2)
    try:
        wait(worker)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setaffinity(0, {min(cores)})
        worker._restarted(1.0, "it died")
        assert os.sched_getscheduler(0) == os.SCHED_FIFO and os.sched_getaffinity(0) == {min(cores)}
    except PermissionError:
        pytest.skip("this user may not take real-time priority")
    finally:
        os.sched_setaffinity(0, cores)
        os.sched_setscheduler(0, policy, priority)
    try:
        assert f"policy {os.SCHED_OTHER} on {sorted(cores)}" in wait(worker)[0].text
    finally:
        worker.close()
