"""The estimator beside the controller: reproducible in step, harmless whatever becomes of its process."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.assembly import LogSource, open_system, trajectories
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import Belief, belief_of
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.live.belief import AdaptiveBelief
from amhe_cli.live.buffer import Buffer
from amhe_cli.live.episode import Cycle, News
from amhe_cli.live.samples import Sampler
from amhe_cli.live.workers import InProcess, InStep
from amhe_cli.robots.go1.recording import recorder_of
from amhe_cli.robots.go1.run import RunOptions, estimator_of, open_run
from amhe_cli.robots.go1.tasks import Believed, find_task

QUICK = ("control.samples=5", "control.horizon=8", "mhe.samples=6")


def cycles(tmp_path: Path, seconds: float, threads: int = 1) -> list[Cycle]:
    run = open_run(
        RunOptions("t1", mode="adaptive", seed=5, duration=seconds, threads=threads, assignments=QUICK)
    )
    with recorder_of(run, tmp_path / "log.mcap") as recorder:
        found = []
        for cycle in run.episode.cycles():
            recorder.write(cycle)
            found.append(cycle)
    return found


@pytest.fixture(scope="module")
def adaptive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Cycle]]:
    folder = tmp_path_factory.mktemp("adaptive")
    return folder / "log.mcap", cycles(folder, 2.2)


def news(of: list[Cycle]) -> list[tuple[float, Estimate]]:
    return [(cycle.estimate.time, n.estimate) for cycle in of for n in cycle.news if n.estimate]


def test_it_starts_from_the_baseline_and_learns(adaptive: tuple[Path, list[Cycle]]) -> None:
    _, run = adaptive
    assert run[0].belief == pytest.approx({"box_mass": 2.0, "box_inertia_scale": 1.0, "floor_friction": 0.3})
    last = run[-1].belief
    assert last["box_mass"] * last["floor_friction"] > 1.2, "0.6 was believed, 2.4 is true"


def test_a_belief_takes_effect_after_the_latency_and_between_plans(
    adaptive: tuple[Path, list[Cycle]],
) -> None:
    _, run = adaptive
    first, estimate = news(run)[0]
    assert first == pytest.approx(estimate.time + 0.08 + 0.02)  # the cycle that ends after it
    changed = [b.estimate.time for a, b in pairwise(run) if a.belief != b.belief]
    assert set(np.round(changed, 3)) <= set(np.round([t for t, _ in news(run)], 3))
    assert np.diff([e.time for _, e in news(run)]) == pytest.approx(0.1)


def test_the_same_seed_gives_the_same_run_on_any_number_of_threads(
    adaptive: tuple[Path, list[Cycle]], tmp_path: Path
) -> None:
    again = cycles(tmp_path, 1.2, threads=2)
    for one, other in zip(again, adaptive[1], strict=False):
        np.testing.assert_array_equal(one.plan.targets, other.plan.targets)
        assert one.belief == other.belief


def test_the_buffer_holds_what_the_log_holds(adaptive: tuple[Path, list[Cycle]]) -> None:
    path, run = adaptive
    source = LogSource((path,), {}, None, None, None)
    system = open_system(None, source, QUICK)
    (log,) = trajectories(system, source)
    sampler, buffer = Sampler(0.02), Buffer(system.signals, 0.5, log.dt, 0.2)
    windows = []
    for cycle in run:
        buffer.append(sampler.take(cycle))
        windows.append(buffer.window(cycle.estimate.time))
    assert windows[20] is None, "there is not enough yet"
    for cycle, window in list(zip(run, windows, strict=True))[60:100:7]:
        assert window is not None and window.length == 125
        stop = round((cycle.estimate.time - 1e-9 * log.start_ns) / log.dt)
        for key, logged in log.series.items():
            live = window.log[key]
            ours, theirs = slice(window.start, window.stop + 1), slice(stop - 125, stop + 1)
            # a sample halfway between two steps may count for either
            assert live.sampled[ours].sum() == pytest.approx(logged.sampled[theirs].sum(), abs=1), key
            np.testing.assert_allclose(live.values[ours], logged.values[theirs], atol=1e-9, err_msg=key)


def test_targets_that_a_robot_was_sent_are_taken_in_place_of_those_planned(
    adaptive: tuple[Path, list[Cycle]],
) -> None:
    """A late plan begins late: what was sent is what the model must be driven with."""
    sampler, times, taken = Sampler(0.02), [], []
    for cycle in adaptive[1][:10]:
        count = cycle.measured.robot_times.size
        ramp = np.tile(cycle.measured.robot_times[:, None], (1, 12))
        samples = sampler.take(replace(cycle, measured=replace(cycle.measured, targets=ramp)))
        times, taken = [*times, *samples.command_times], [*taken, *samples.commands[:, 0]]
        assert samples.commands.shape == (samples.command_times.size, 12) and count
    assert len(times) > 40, "every 4 ms, not every 20 ms"
    np.testing.assert_allclose(np.diff(times), 0.004, atol=1e-9, err_msg="on the steps of the reader's clock")
    # each is held for 4 ms: it is what was followed in the middle of them, not at their beginning
    np.testing.assert_allclose(taken[1:], np.add(times[1:], 0.002), atol=1e-6)


# -- a process of its own --------------------------------------------------------------------------------


class Puppet:
    """An estimator that does what the window says, and counts up from the belief that it begins with."""

    def __init__(self, belief: Belief | None = None) -> None:
        self.count = 0.0 if belief is None else float(SPACE.space.gaussian_of(belief)[0][0])

    def update(self, window: str, at: float, budget: float | None = None) -> Estimate:
        self.count += 1
        if window == "die":
            os._exit(7)
        if window == "hang":
            time.sleep(60.0)
        if window == "fail":
            raise ValueError("no such window")
        space = SPACE.space
        belief = belief_of("go1_push", space, np.full(3, self.count), np.eye(3), {})
        nothing = np.zeros(3)
        theta = space.nominal + self.count
        return Estimate(at, theta, nothing, nothing, nothing, belief, "updated", 1.0, 1.0, 9, 0, 1.0)


SPACE = open_system("go1_push", LogSource((), {}, None, None, None))


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


@pytest.mark.parametrize(
    ("order", "said"),
    [("fail", "ValueError: no such window"), ("die", "died (exit code 7)"), ("hang", "hung for 0.3 s")],
)
def test_whatever_becomes_of_the_estimator_the_controller_goes_on(order: str, said: str) -> None:
    worker = InProcess(Puppet, budget=0.2, patience=0.3)
    try:
        ready(worker)
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        (one,) = wait(worker)
        assert one.estimate.time == 3.0 and one.estimate.theta[0] == SPACE.space.nominal[0] + 1
        begun = time.monotonic()
        worker.submit(order, 4.0)  # type: ignore[arg-type]
        at_once = worker.poll(4.0)
        assert time.monotonic() - begun < 0.1, "nobody waits for it"
        (two,) = at_once or wait(worker)
        assert two.estimate is None and said in two.text
        ready(worker)  # a new one, or the same
        worker.submit("fine", 5.0)  # type: ignore[arg-type]
        (three,) = wait(worker)
        assert three.estimate.time == 5.0
        assert three.estimate.theta[0] > one.estimate.theta[0] + 0.5, "it goes on from the last good belief"
    finally:
        worker.close()


def dies(belief: Belief | None) -> MovingHorizon:
    os._exit(3)


def test_an_estimator_that_dies_again_and_again_is_given_up() -> None:
    worker = InProcess(dies, budget=0.2)
    try:
        told = [wait(worker)[0].text for _ in range(5)]
        assert all("died (exit code 3)" in text for text in told)
        assert [("no other estimator" in text) for text in told] == [False] * 4 + [True]
        assert worker.ready, "it is not late: nobody is asked"
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        assert worker.ready and worker.poll(3.1) == ()
    finally:
        worker.close()


def breaks(belief: Belief | None) -> MovingHorizon:
    raise ValueError("no such model")


def test_why_an_estimator_cannot_begin_is_told() -> None:
    worker = InProcess(breaks, budget=0.2)
    try:
        told = [one.text for _ in range(2) for one in wait(worker)]
        assert "ValueError: no such model" in told[0]
        assert "the estimator died" in told[1]
    finally:
        worker.close()


def test_a_ctrl_c_is_for_the_run_and_leaves_the_estimator_alone(capfd: pytest.CaptureFixture[str]) -> None:
    worker = InProcess(Puppet, budget=0.2)
    try:
        ready(worker)
        assert worker._process.pid is not None
        os.kill(worker._process.pid, signal.SIGINT)
        time.sleep(0.2)
        worker.submit("fine", 3.0)  # type: ignore[arg-type]
        (one,) = wait(worker)
        assert one.estimate.time == 3.0
    finally:
        worker.close()
    assert "Traceback" not in capfd.readouterr().err


@given(
    jitter=st.floats(0.0, 4e-4),
    lost=st.floats(0.0, 0.2),
    seed=st.integers(0, 2**31),
)
def test_one_sample_of_the_joints_is_taken_in_each_period_whatever_the_stamps(
    jitter: float, lost: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    times = 0.002 * np.arange(1000) + rng.uniform(0.0, jitter, 1000)
    times = times[rng.random(1000) >= lost]
    sampler = Sampler(0.02, 0.01)
    kept = np.concatenate([part[sampler._thinned(part)] for part in np.array_split(times, 100)])
    periods = np.floor(times / 0.01 + 1e-6)
    np.testing.assert_array_equal(np.floor(kept / 0.01 + 1e-6), np.unique(periods))


def test_a_window_that_fills_the_pipe_of_a_hung_estimator_holds_nobody_up() -> None:
    worker = InProcess(Puppet, budget=0.2, patience=0.3)
    try:
        ready(worker)
        worker.submit("hang", 3.0)  # type: ignore[arg-type]
        time.sleep(0.1)
        begun = time.monotonic()
        worker.submit("long" * 1_000_000, 3.1)  # type: ignore[arg-type]
        assert time.monotonic() - begun < 0.1
        assert "hung" in wait(worker)[0].text
    finally:
        worker.close()


def test_in_lock_step_a_window_that_breaks_the_estimator_is_told_and_passed_over() -> None:
    worker = InStep(Puppet, latency=0.08)  # type: ignore[arg-type]
    worker.submit("fail", 1.0)  # type: ignore[arg-type]
    assert not worker.ready and worker.poll(1.07) == ()
    (one,) = worker.poll(1.08)
    assert one.estimate is None and "ValueError: no such window" in one.text
    worker.submit("fine", 2.0)  # type: ignore[arg-type]
    assert worker.poll(2.08)[0].estimate is not None


class Busy:
    """A worker that is never done with its first window."""

    ready = True

    def submit(self, window: Window, at: float) -> None:
        self.ready = False

    def poll(self, now: float) -> tuple[News, ...]:
        return ()

    def close(self) -> None: ...


def test_a_late_estimator_is_told_once_and_its_last_belief_stays(adaptive: tuple[Path, list[Cycle]]) -> None:
    buffer = Buffer(SPACE.signals, 0.4, SPACE.model.opt.timestep, 0.2)
    belief = AdaptiveBelief({"box_mass": 2.0}, buffer, Sampler(0.02), Busy(), 0.1)
    told = [(cycle.estimate.time, one.text) for cycle in adaptive[1] for one in belief.saw(cycle)]
    assert len(told) == 1 and "late" in told[0][1]
    assert 0.5 < told[0][0] < 0.7, "a window of 0.4 s, and the next update that is due"
    assert belief.at(2.0) == {"box_mass": 2.0}


def test_the_estimator_begins_with_what_the_controller_believes() -> None:
    task = replace(find_task("t1"), baseline=Believed(3.3, 0.44))  # as a probe has its own
    options = RunOptions("t1", mode="adaptive", duration=0.6, assignments=QUICK)
    run = list(open_run(options, task).episode.cycles())
    assert run[0].belief["box_mass"] == pytest.approx(3.3)
    first = news(run)[0][1]
    assert first.mark == "still", "the box has not been met yet"
    assert first.theta == pytest.approx([3.3, 1.0, 0.44])


def test_the_estimator_of_a_run_works_in_a_process(adaptive: tuple[Path, list[Cycle]]) -> None:
    source = LogSource((adaptive[0],), {}, None, None, None)
    system = open_system(None, source, QUICK)
    (log,) = trajectories(system, source)
    options = RunOptions("t1", mode="adaptive", seed=5, assignments=QUICK)
    window = Window(log, 60, 125)
    start = belief_of(system.name, system.space, np.zeros(3), np.eye(3), {})
    here = estimator_of(options, start).update(window, 1.0)
    worker = InProcess(partial(estimator_of, options, start), budget=1.0, patience=20.0, starting=60.0)
    try:
        ready(worker)
        worker.submit(window, 1.0)
        assert worker.ready is False
        there = wait(worker)[0].estimate
        np.testing.assert_array_equal(there.theta, here.theta)
    finally:
        worker.close()
