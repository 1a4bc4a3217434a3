"""Episodes: the loop, what it records, and its adaptation."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest

from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import ConfigError, OperatorStopError
from amhe_cli.core.log import Window, merged
from amhe_cli.core.rotations import exp, multiply
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.tracker import Buffer
from amhe_cli.estimation.online.workers import InProcess, Trouble
from amhe_cli.live.episode import Cycle
from amhe_cli.live.recorder import Recorder, drive
from amhe_cli.logs import inspect_log, read_log, read_metadata, survey
from amhe_cli.robots.go1 import tasks
from amhe_cli.robots.go1.behaviours.gait import box_friction
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.kinematics import HOME, JOINTS
from amhe_cli.robots.go1.model import Box, Change, home, plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.run import (
    Run,
    RunOptions,
    estimator_of,
    measured,
    open_run,
    recorder_of,
    task_and_system,
)
from amhe_cli.robots.go1.state import State
from amhe_cli.robots.go1.tasks import Believed, Task, find_task
from amhe_cli.system.system import System
from tests.estimation.online.test_workers import ready, wait

PERIOD = 0.02


def opened(task: str = "t1", duration: float = 0.2, **options: object) -> Run:
    return open_run(RunOptions(task, duration=duration, **options))  # type: ignore[arg-type]


def cycles_of(task: str = "t1", duration: float = 0.2, **options: object) -> list[Cycle]:
    return list(opened(task, duration, **options).episode.cycles())


def targets(cycles: list[Cycle]) -> np.ndarray:
    return np.array([cycle.plan.targets for cycle in cycles])


@pytest.fixture(scope="module")
def second() -> list[Cycle]:
    """The first second of T1."""
    return cycles_of(duration=1.0, seed=3)


@pytest.mark.medium
def test_it_ends_in_time_and_has_not_fallen(second: list[Cycle]) -> None:
    assert len(second) == 50
    assert [cycle.over for cycle in second] == [False] * 49 + [True]
    np.testing.assert_allclose([cycle.time for cycle in second], PERIOD * np.arange(1, 51))
    truth = second[-1].truth
    assert truth is not None and truth.time == pytest.approx(1.0)
    assert truth.trunk.position[2] > 0.2
    assert truth.trunk.position[0] > second[0].truth.trunk.position[0] + 0.03, "it walks"
    assert all(cycle.misses == 0 and cycle.plan_ms > 0.0 for cycle in second)


def test_another_seed_starts_elsewhere_and_measures_and_samples_otherwise() -> None:
    first, other = opened(seed=3), opened(seed=4)
    for body in ("trunk", "box"):
        a, b = getattr(first.plant.state, body), getattr(other.plant.state, body)
        assert (a.position[:2] != b.position[:2]).all() and (a.orientation != b.orientation).any()
    a, b = (next(run.episode.cycles()) for run in (first, other))
    assert (a.samples["joints.position"][1] != b.samples["joints.position"][1]).all()
    assert (a.plan.targets != b.plan.targets).any()


@pytest.mark.medium
def test_starts_differ_by_three_centimetres_and_three_degrees_at_most_and_nearly_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for unneeded in ("controller_for", "belief_source"):
        monkeypatch.setattr(f"amhe_cli.robots.go1.run.{unneeded}", Mock())
    shifts, turns = [], []
    for seed in range(10):
        state = opened(seed=seed).plant.state
        for body, place in ((state.trunk, [0.0, 0.0]), (state.box, [0.6, 0.0])):
            shifts.append(body.position[:2] - place)
            turns.append(2.0 * np.arctan2(body.orientation[3], body.orientation[0]))
            np.testing.assert_allclose(body.orientation[1:3], 0.0, atol=1e-12)
    limits = {"m": 0.03, "rad": np.radians(3.0)}
    for values, limit in ((np.array(shifts), limits["m"]), (np.array(turns), limits["rad"])):
        assert 0.8 * limit < np.abs(values).max() <= limit
        assert values.std() == pytest.approx(limit / np.sqrt(3.0), rel=0.3)


def test_plans_take_effect_one_period_after_what_they_were_made_from(second: list[Cycle]) -> None:
    np.testing.assert_array_equal(second[0].played, HOME)
    for before, cycle in pairwise(second):
        assert cycle.plan.start == pytest.approx(cycle.time + PERIOD)
        np.testing.assert_array_equal(cycle.played, before.plan.targets[0])


def test_the_controller_does_not_see_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Told a false truth, it plans the same: only the judge listens."""
    honest = cycles_of(seed=1, mode="baseline")
    true_state = Plant.state.fget

    def false(plant: Plant) -> State:
        state = true_state(plant)
        turn = multiply(exp(np.array([0.0, 0.0, 0.4])), state.trunk.orientation)
        trunk = replace(state.trunk, position=state.trunk.position + 0.2, orientation=turn)
        box = replace(state.box, position=state.box.position - 0.3, velocity=state.box.velocity + 1.0)
        return replace(state, trunk=trunk, box=box, joints=state.joints + 0.3)

    monkeypatch.setattr(Plant, "state", property(false))
    monkeypatch.setattr(Plant, "parameters", property(lambda plant: {"box_mass": 99.0}))
    lied_to = cycles_of(seed=1, mode="baseline")
    assert (honest[0].truth.trunk.position != lied_to[0].truth.trunk.position).all()
    np.testing.assert_array_equal(targets(honest), targets(lied_to))


def test_the_estimate_is_near_the_truth_but_not_the_truth(second: list[Cycle]) -> None:
    errors = np.array(
        [
            np.concatenate(
                (
                    cycle.estimate.trunk.position - cycle.truth.trunk.position,
                    cycle.estimate.box.position - cycle.truth.box.position,
                )
            )
            for cycle in second[10:]
        ]
    )
    assert (errors != 0.0).all()
    assert 1e-4 < errors.std() < 5e-3


def test_the_true_belief_switches_with_the_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    early = replace(tasks.TASKS["t3"], changes=(Change(mass=6.0, at_time=0.1),))
    monkeypatch.setitem(tasks.TASKS, "t3", early)
    run = opened("t3", seed=2)
    cycles = list(run.episode.cycles())
    assert [cycle.belief["box_mass"] for cycle in cycles] == pytest.approx([4.0] * 4 + [6.0] * 6)
    assert all(cycle.belief == cycle.parameters for cycle in cycles)
    assert run.first_truth == cycles[0].belief
    assert run.first_truth["box_mass"] == pytest.approx(4.0)

    fixed = cycles_of("t3", seed=2, mode="baseline")
    assert {cycle.belief["box_mass"] for cycle in fixed} == {4.0}
    assert fixed[-1].parameters["box_mass"] == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("task", "mode", "mass", "friction"),
    [
        ("t1", "true", 4.0, 0.6), ("t1", "baseline", 2.0, 0.3), ("t3", "baseline", 4.0, 0.4),
        ("t4", "stale", 2.0, 0.2), ("t5", "true", 3.0, 0.4), ("hw1", "baseline", 3.0, 0.4),
        ("hw2", "baseline", 4.0, 0.6),
    ],
)  # fmt: skip
def test_a_mode_s_belief(task: str, mode: str, mass: float, friction: float) -> None:
    belief = {"box_mass": mass, "box_inertia_scale": 1.0, "floor_friction": friction}
    run = opened(task, mode=mode)
    believed = run.episode.belief.now
    assert believed == pytest.approx(belief)
    assert tuple(believed) == run.system.space.names
    assert box_friction(believed) == pytest.approx(mass * friction * 9.81)


def test_what_cannot_be_run_is_refused() -> None:
    with pytest.raises(ConfigError, match="task t1 has no stale belief"):
        opened("t1", mode="stale")
    with pytest.raises(ConfigError, match=r"no mode 'tru' \(did you mean 'true'\?\)"):
        opened("t1", mode="tru")
    with pytest.raises(ConfigError, match="ask for `box` too"):
        opened("t1", mode="adaptive", settings={"unknowns": ["robot"]})


@pytest.mark.parametrize("task", ["t2", "t5"])
def test_the_measures_are_of_the_true_states(task: str) -> None:
    """J by hand from the recorded truth; the judge's own behaviour must not be disturbed by planning."""
    run = opened(task, seed=1)
    cycles = list(run.episode.cycles())
    fresh = run.task.behaviour()
    by_hand = sum(sum(fresh.running_cost(cycle.truth).values()) for cycle in cycles)
    found = run.judge.measures()
    assert found.cost == pytest.approx(by_hand)
    box = cycles[-1].truth.box.position[:2]
    assert found.goal_error_m == pytest.approx(float(np.hypot(*(box - run.task.path.goal))))


def test_a_box_of_another_size_is_so_for_plant_estimator_and_log() -> None:
    """`boxes.box` is what the user measured: whoever has a model of the box must have that one."""
    edges = (0.4, 0.6, 0.2)
    run = opened(settings={"boxes": {"box": list(edges)}})
    assert run.plant is not None
    for model in (run.plant.model, run.system.model):
        np.testing.assert_allclose(2.0 * model.geom("box").size, edges)
    assert run.task.box.size == pytest.approx(edges)
    assert measured(run.task)["boxes"]["box"] == pytest.approx(edges), "and whoever reads the log"


def with_box(name: str, edges: Sequence[float]) -> Task:
    options = RunOptions(name, settings={"boxes": {"box": list(edges)}})
    return task_and_system(options)[0]


@pytest.mark.parametrize("name", ["t1", "t5"])
def test_a_deep_box_does_not_reach_into_the_robot(name: str) -> None:
    own = tasks.TASKS[name]
    assert with_box(name, own.box.size) is own, "the task's own size changes nothing"
    deep = with_box(name, [3.0 * edge for edge in own.box.size])
    ahead = np.array([np.cos(own.path.heading), np.sin(own.path.heading)])
    half = [0.5 * abs(ahead @ task.box.size[:2]) for task in (own, deep)]
    faces = [ahead @ task.box.position - reach for task, reach in zip((own, deep), half, strict=True)]
    assert faces[0] == pytest.approx(faces[1]), "the face that is pushed stays"
    assert deep.path.start == deep.box.position
    assert deep.path.length == own.path.length
    for box, touching in ((deep.box, False), (replace(deep.box, position=own.box.position), True)):
        assert touches(box) == touching


def touches(box: Box) -> bool:
    """Whether the robot at its start is in touch with a box."""
    model = plant_model(box)
    data = mujoco.MjData(model)
    data.qpos[:] = home(model)
    mujoco.mj_forward(model, data)
    floor, geom = model.geom("floor").id, model.geom("box").id
    return any(geom in pair and floor not in pair for pair in data.contact.geom.tolist())


class Troubled(History):
    """Counts the estimator's troubles, and nothing else of a cycle."""

    def add(self, cycle) -> dict[str, float]:
        self._estimated(cycle)
        return {}


def test_a_trouble_of_the_estimator_is_a_warning_at_once_and_counted_in_the_end(caplog) -> None:
    died = [Trouble(3.2, "the estimator died")]
    cycles = [SimpleNamespace(time=t, news=news, over=False) for t, news in enumerate([[], died, [], died])]
    seen: list[list[str]] = []

    def on_cycle(cycle, row) -> None:
        seen.append(list(caplog.messages))

    with caplog.at_level(logging.WARNING, "amhe_cli"):
        episode = Mock(cycles=lambda: iter(cycles), judge=Mock(verdict=(0, "")))
        drive(episode, Mock(), Troubled(Mock()), lambda: False, on_cycle)
    once = ["at 3.2 s the estimator died"]
    assert seen == [[], [], once, once]
    assert caplog.messages == [*once, "at 3.2 s the estimator died; 2 times"]


@pytest.mark.parametrize("stop", [OperatorStopError("key"), RuntimeError("broken")])
def test_a_stop_by_the_operator_is_an_interruption_and_no_error(stop: Exception) -> None:
    episode = Mock(cycles=Mock(side_effect=stop))
    ending = drive(episode, Mock(), Troubled(Mock()), lambda: False, Mock())
    operator = isinstance(stop, OperatorStopError)
    assert ending.interrupted == operator
    assert ending.error is (None if operator else stop)


def test_the_first_plan_makes_no_simulations(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would take twice the time of the others, while a robot waits."""
    run = open_run(RunOptions("t1", duration=0.1))
    monkeypatch.setattr("mujoco.batch.Batch", None)
    assert next(run.episode.cycles()).plan.step is not None


QUICK = {"control": {"samples": 5, "horizon": 8}}


def messages(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Every message by topic, as it lies in the file."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
    return found


def record(path: Path, task: str = "t1", seconds: float = 0.6, threads: int = 1, seed: int = 0) -> list:
    """Run a task for some time; its cycles."""
    run = open_run(RunOptions(task, seed=seed, duration=seconds, threads=threads, settings=QUICK))
    cycles = []
    with recorder_of(run, path) as recorder:
        for cycle in run.episode.cycles():
            recorder.write(cycle)
            cycles.append(cycle)
    return cycles


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    path = tmp_path_factory.mktemp("live") / "log.mcap"
    return path, record(path)


@pytest.mark.medium
def test_identify_finds_every_signal_all_the_time(log) -> None:
    found = inspect_log(log[0], System.load("go1_push"))
    assert found.system == "go1_push"
    assert found.problem is None
    assert all(check.problem is None for check in found.checks)
    assert found.duration == pytest.approx(0.58, abs=0.02)  # from the first command on


def test_what_is_read_is_what_was_measured_and_played(log) -> None:
    path, cycles = log
    read = read_log(path, System.load("go1_push"))
    samples = merged([cycle.samples for cycle in cycles])
    times, joints = samples["joints.position"]
    at = round((0.3 - 1e-9 * read.start_ns) / read.dt)  # the row of 0.3 s
    assert read["joints.position"].columns == JOINTS
    measured = joints[np.argmin(np.abs(times - 0.3))]
    assert read["joints.position"].values[at] == pytest.approx(measured, abs=1e-6)
    cycle = next(c for c in cycles if c.estimate.time == pytest.approx(0.3))
    assert read["box.position"].values[at] == pytest.approx(cycle.samples["box.position"][1][-1], abs=1e-6)
    assert read["trunk.linear_velocity"].values[at] == pytest.approx(cycle.estimate.trunk.velocity, abs=1e-6)
    assert read["trunk.angular_velocity"].values[at] == pytest.approx(cycle.estimate.trunk.rate, abs=1e-6)
    assert read["command.position"].values[at] == pytest.approx(cycle.played, abs=1e-6)


def test_stamps_are_the_time_of_the_run(log) -> None:
    path, cycles = log
    by_topic = messages(path)
    stamps = [stamp for stamp, _ in by_topic["/joint_commands"]]
    assert stamps == [round(cycle.estimate.time * 1e6) * 1000 for cycle in cycles]
    assert stamps[0] == 20_000_000
    assert [stamp for stamp, _ in by_topic["/joint_states"]][:3] == [20_000_000, 30_000_000, 40_000_000]


def test_the_log_says_what_it_is_of_and_carries_its_settings(log) -> None:
    metadata = read_metadata(log[0])
    assert (metadata["system"], metadata["task"], metadata["mode"], metadata["seed"]) == (
        "go1_push",
        "t1",
        "true",
        "0",
    )
    assert json.loads(metadata["truth"]) == pytest.approx(
        {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.6}
    )
    from mcap.reader import make_reader

    with log[0].open("rb") as file:
        attached = {one.name: one.data.decode() for one in make_reader(file).iter_attachments()}
    assert '"samples": 5' in attached["settings.yaml"]
    assert "box_mass" in attached["system.yaml"]


def test_a_truth_that_will_change_is_no_metadata(tmp_path: Path) -> None:
    record(tmp_path / "log.mcap", "t4", seconds=0.04)
    assert "truth" not in read_metadata(tmp_path / "log.mcap")
    assert "/amhe/truth" in {topic.name for topic in survey(tmp_path / "log.mcap").topics}


@pytest.mark.medium
def test_a_seed_gives_the_same_log_whatever_the_threads(log, tmp_path: Path) -> None:
    record(tmp_path / "again.mcap", threads=2)
    first, again = (messages(path) for path in (log[0], tmp_path / "again.mcap"))
    assert set(first) == set(again)
    for topic in set(first) - {"/amhe/timing", "/diagnostics"}:
        assert first[topic] == again[topic], topic


def test_a_log_that_breaks_off_is_whole(log, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with pytest.raises(KeyboardInterrupt), Recorder(path, (), {}, {}) as recorder:
        recorder.write(log[1][0])
        raise KeyboardInterrupt
    assert not survey(path).problems
    assert [p.name for p in tmp_path.iterdir()] == ["log.mcap"]


def test_a_quarter_of_a_minute_takes_less_than_a_megabyte(log, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    record(path, seconds=0.02)
    definitions, whole = path.stat().st_size, log[0].stat().st_size
    assert definitions + (whole - definitions) / 0.58 * 15.0 < 1e6


QUICK_ADAPTIVE = {"control": {"samples": 5, "horizon": 8}, "mhe": {"samples": 6}}


def cycles(tmp_path: Path, seconds: float, threads: int = 1) -> list[Cycle]:
    run = open_run(
        RunOptions("t1", mode="adaptive", seed=5, duration=seconds, threads=threads, settings=QUICK_ADAPTIVE)
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


@pytest.mark.medium
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
    system = System.load("go1_push", QUICK_ADAPTIVE)
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
    options = RunOptions("t1", mode="adaptive", duration=0.6, settings=QUICK_ADAPTIVE)
    run = list(open_run(options, task).episode.cycles())
    assert run[0].belief["box_mass"] == pytest.approx(3.3)
    first = news(run)[0][1]
    assert first.mark == "still", "the box has not been met yet"
    assert first.theta == pytest.approx([3.3, 1.0, 0.44])


@pytest.mark.medium
def test_a_crate_that_is_larger_than_stated_is_found_if_it_is_asked_for() -> None:
    asked = QUICK_ADAPTIVE | {"unknowns": ["box", "box_size"]}
    run = opened(duration=2.5, mode="adaptive", seed=6, plant="crate", settings=asked)
    believed = list(run.episode.cycles())[-1].belief
    assert believed["face_overlap"] == pytest.approx(run.first_truth["face_overlap"], abs=0.004)
    assert believed["floor_overlap"] == pytest.approx(run.first_truth["floor_overlap"], abs=0.002)
    assert believed["box_mass"] * believed["floor_friction"] == pytest.approx(2.4, rel=0.1)


@pytest.mark.medium
def test_the_estimator_of_a_run_works_in_a_process(adaptive: tuple[Path, list[Cycle]]) -> None:
    system = System.load("go1_push", QUICK_ADAPTIVE)
    log = read_log(adaptive[0], system)
    options = RunOptions("t1", mode="adaptive", seed=5, settings=QUICK_ADAPTIVE)
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
