"""The tasks' numbers, fixed so that results stay comparable. Weights and gains are not among them."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.behaviours.sweeping import Sweeping
from amhe_cli.robots.go1.behaviours.walking import Walking
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, HOME, feet
from amhe_cli.robots.go1.tasks import TASKS, find_task


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
