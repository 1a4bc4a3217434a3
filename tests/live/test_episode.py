"""A task run for a second: reproducible, blind to the truth, and of the right belief."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError, OperatorStopError
from amhe_cli.core.rotations import exp, multiply
from amhe_cli.estimation.online.workers import Trouble
from amhe_cli.live.episode import Cycle
from amhe_cli.live.recorder import drive
from amhe_cli.robots.go1 import tasks
from amhe_cli.robots.go1.behaviours.gait import box_friction
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.kinematics import HOME
from amhe_cli.robots.go1.model import Box, Change, home, plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.run import Run, RunOptions, measured, open_run, task_and_system
from amhe_cli.robots.go1.state import State
from amhe_cli.robots.go1.tasks import Task

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
    believed = run.episode.belief.at(0.0)
    assert believed == pytest.approx(belief)
    assert tuple(believed) == run.system.space.names
    assert box_friction(believed) == pytest.approx(mass * friction * 9.81)


def test_what_cannot_be_run_is_refused() -> None:
    with pytest.raises(ConfigError, match="task t1 has no stale belief"):
        opened("t1", mode="stale")
    with pytest.raises(ConfigError, match=r"no mode 'tru' \(did you mean 'true'\?\)"):
        opened("t1", mode="tru")


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
