"""The tasks' numbers, fixed so that results stay comparable. Weights and gains are not among them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.behaviours.sweeping import Sweeping
from amhe_cli.robots.go1.behaviours.walking import Walking
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, HOME, feet
from amhe_cli.robots.go1.model import Change
from amhe_cli.robots.go1.tasks import LONGEST, TASKS, Believed, find_task

Facts: TypeAlias = tuple[
    tuple[float, ...], float, float, tuple[float, float], tuple[float, float], float, float,
    tuple[Change, ...], Believed, Believed | None,
]  # fmt: skip
BIG, SMALL, AHEAD = (0.3, 0.5, 0.3), (0.2, 0.3, 0.3), (0.6, 0.0)
#: "Beside the front right foot" leaves its place open; a test below says what must hold.
BESIDE = TASKS["t5"].box.position
TURF, HEAVIER = Change(floor_friction=0.8, beyond_x=1.5), Change(mass=6.0, at_time=10.0)
LIGHT, KNOWN, STALE = Believed(2.0, 0.3), Believed(4.0, 0.4), Believed(2.0, 0.2)
#: Size, mass and friction of the box, start, goal and length of the path, nominal time, changes, beliefs.
FACTS: dict[str, Facts] = {
    "t1": (BIG, 4.0, 0.6, AHEAD, (3.0, 0.0), 2.4, 12.0, (), LIGHT, None),
    "t2": (BIG, 4.0, 0.4, AHEAD, (0.6, 3.0), 1.5 * np.pi, 23.6, (), LIGHT, None),
    "t3": (BIG, 4.0, 0.4, AHEAD, (3.6, 0.0), 3.0, 15.0, (HEAVIER,), KNOWN, STALE),
    "t4": (BIG, 4.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (TURF,), KNOWN, STALE),
    "t5": (SMALL, 3.0, 0.4, BESIDE, (BESIDE[0], BESIDE[1] - 0.5), 0.5, 10.0, (), LIGHT, None),
    "hw1": (BIG, 3.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (Change(mass=4.0, beyond_x=1.8),),
            Believed(3.0, 0.4), None),
    "hw2": (BIG, 4.0, 0.4, AHEAD, (3.0, 0.0), 2.4, 12.0, (TURF,), Believed(4.0, 0.6), None),
}  # fmt: skip


def test_these_are_all_the_tasks() -> None:
    assert [task.name for task in TASKS.values()] == list(TASKS) == list(FACTS)
    assert LONGEST == 40.0


@pytest.mark.parametrize("name", FACTS)
def test_a_task_s_numbers(name: str) -> None:
    task, (size, mass, friction, start, goal, length, nominal, *rest) = find_task(name), FACTS[name]
    assert task.box.size == pytest.approx(size)
    assert (task.box.mass, task.box.floor_friction, task.box.yaw) == (mass, friction, 0.0)
    assert task.box.position == task.path.start == pytest.approx(start)
    np.testing.assert_allclose(task.path.goal, goal, atol=1e-12)
    assert task.path.length == pytest.approx(length)
    assert task.nominal_time == nominal
    assert [task.changes, task.baseline, task.stale] == rest
    assert task.corridor == (0.4 if name == "t2" else np.inf)
    assert task.one_leg == (name == "t5")


@pytest.mark.parametrize("name", [name for name in TASKS if name != "t5"])
def test_the_walk_is_at_two_decimetres_a_second_and_tapers_over_two(name: str) -> None:
    task = find_task(name)
    end = task.path.length
    speeds = [
        task.commanded_speed(progress) for progress in (-0.1, 0.0, end - 0.2, end - 0.1, end, end + 0.1)
    ]
    assert speeds == pytest.approx([0.2, 0.2, 0.2, 0.1, 0.0, 0.0])
    assert task.judged_from == 1.0
    assert task.nominal_time == pytest.approx(end / 0.2, abs=0.05)


def test_with_one_leg_the_robot_stays_and_is_judged_from_the_lift_off() -> None:
    task = find_task("t5")
    assert {task.commanded_speed(progress) for progress in (0.0, 0.2, 0.45, 0.5)} == {0.0}
    stands = task.behaviour().standing(np.array([task.judged_from - 1e-6, task.judged_from + 1e-6]))
    np.testing.assert_array_equal(stands, [[True] * 4, [False, True, True, True]])


def test_the_box_of_the_one_leg_lies_beside_the_front_right_foot() -> None:
    """Its face is parallel to x, to the right of the foot, and the foot is level with its length."""
    task, foot = find_task("t5"), feet(HOME)[0]
    depth, width, _ = task.box.size
    x, y = task.box.position
    assert 0.0 < foot[1] - FOOT_RADIUS - (y + 0.5 * width) < 0.1
    assert abs(foot[0] - x) < 0.5 * depth
    assert task.path.heading == pytest.approx(-0.5 * np.pi)


def test_a_task_walks_or_sweeps_and_begins_afresh() -> None:
    for name, task in TASKS.items():
        first, second = task.behaviour(), task.behaviour()
        assert first is not second
        assert isinstance(first, Sweeping if name == "t5" else Walking)
        if isinstance(first, Walking) and isinstance(second, Walking):
            assert first.helm is not second.helm


def test_a_task_that_is_not_there_is_refused_with_a_list() -> None:
    with pytest.raises(ConfigError, match=r"no task 't6'.*hw1, hw2, t1, t2, t3, t4, t5"):
        find_task("t6")
