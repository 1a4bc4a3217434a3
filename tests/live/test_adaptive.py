"""The estimator beside the controller: reproducible in step, harmless whatever becomes of its process."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.belief import belief_of
from amhe_cli.core.log import Window
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.tracker import Buffer
from amhe_cli.estimation.online.workers import InProcess
from amhe_cli.live.episode import Cycle
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.kinematics import JOINTS
from amhe_cli.robots.go1.run import RunOptions, estimator_of, open_run, recorder_of
from amhe_cli.robots.go1.tasks import Believed, find_task
from amhe_cli.system.system import System
from tests.estimation.online.test_workers import ready, wait

QUICK = {"control": {"samples": 5, "horizon": 8}, "mhe": {"samples": 6}}


def cycles(tmp_path: Path, seconds: float, threads: int = 1) -> list[Cycle]:
    run = open_run(
        RunOptions("t1", mode="adaptive", seed=5, duration=seconds, threads=threads, settings=QUICK)
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
    return [(cycle.time, n) for cycle in of for n in cycle.news if isinstance(n, Estimate)]


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


@pytest.mark.medium
def test_the_same_seed_gives_the_same_run_on_any_number_of_threads(
    adaptive: tuple[Path, list[Cycle]], tmp_path: Path
) -> None:
    again = cycles(tmp_path, 1.2, threads=2)
    for one, other in zip(again, adaptive[1], strict=False):
        np.testing.assert_array_equal(one.plan.targets, other.plan.targets)
        assert one.belief == other.belief


def test_the_buffer_holds_what_the_log_holds(adaptive: tuple[Path, list[Cycle]]) -> None:
    path, run = adaptive
    system = System.load("go1_push", QUICK)
    log = read_log(path, system)
    assert all(s.names in ((), JOINTS) for s in system.signals), "samples come in this order"
    buffer = Buffer(system.signals, 0.5, log.dt, 0.2)
    windows = []
    for cycle in run:
        buffer.append(cycle.samples)
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


def test_the_estimator_begins_with_what_the_controller_believes() -> None:
    task = replace(find_task("t1"), baseline=Believed(3.3, 0.44))  # as a probe has its own
    options = RunOptions("t1", mode="adaptive", duration=0.6, settings=QUICK)
    run = list(open_run(options, task).episode.cycles())
    assert run[0].belief["box_mass"] == pytest.approx(3.3)
    first = news(run)[0][1]
    assert first.mark == "still", "the box has not been met yet"
    assert first.theta == pytest.approx([3.3, 1.0, 0.44])


@pytest.mark.medium
def test_the_estimator_of_a_run_works_in_a_process(adaptive: tuple[Path, list[Cycle]]) -> None:
    system = System.load("go1_push", QUICK)
    log = read_log(adaptive[0], system)
    options = RunOptions("t1", mode="adaptive", seed=5, settings=QUICK)
    window = Window(log, 60, 125)
    start = belief_of(system, np.zeros(3), np.eye(3))
    here = estimator_of(options, start).update(window, 1.0)
    worker = InProcess(partial(estimator_of, options, start), budget=1.0, patience=20.0, starting=60.0)
    try:
        ready(worker)
        worker.submit(window, 1.0)
        assert worker.ready is False
        there = wait(worker)[0]
        np.testing.assert_array_equal(there.theta, here.theta)
    finally:
        worker.close()
