"""The sweep with one leg: when it ends."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.robots.go1.behaviours.gait import Gait, neutral_feet
from amhe_cli.robots.go1.behaviours.objective import Course
from amhe_cli.robots.go1.behaviours.sweeping import Sweeping, SweepShape
from amhe_cli.robots.go1.kinematics import joint_angles
from amhe_cli.robots.go1.state import Body, State

REACH, HEIGHT = 0.25, 0.27
BELIEF = {"box_mass": 2.5, "floor_friction": 0.4}


def at_rest(position: tuple[float, float, float]) -> Body:
    return Body(np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))


def stalled(time: float, slipped: float = 0.0) -> State:
    """The trunk has gone back over its feet; the free foot hangs 2 cm before its reach and does not move.

    Args:
        time: [s]; at 0 the trunk has not gone yet.
        slipped: So far ahead is the other front foot of where it was put [m].
    """
    back = 0.12 * (time > 0.0)
    feet = neutral_feet(Gait(height=HEIGHT)) + np.array([back, 0.0, 0.0])
    feet[0] += np.array([0.0, -(REACH - 0.02) - feet[0, 1], 0.14])
    feet[1, 0] += slipped
    trunk, box = at_rest((-back, 0.0, HEIGHT)), at_rest((0.1, -0.405, 0.15))
    return State(time, trunk, box, joint_angles(feet).ravel(), np.zeros(12))


def test_a_kick_that_stalls_is_given_up() -> None:
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=REACH))
    speeds = {t: sweeping.move(stalled(t), BELIEF).reference.speed for t in (0.0, 2.0, 2.5, 2.75, 2.85, 3.5)}
    shape = sweeping.shape
    assert speeds[2.0] == speeds[2.5] == speeds[2.75] == shape.kick
    assert speeds[2.85] == speeds[3.5] == 0.0
    assert 0.75 < shape.kick_time < 0.85


def test_when_all_is_done_the_foot_is_set_down() -> None:
    """Given up at 12 s; back where it began, the foot goes down to the floor, and stays there."""
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=2.0))
    shape, heights = sweeping.shape, {}
    for time in (0.0, *np.arange(1.0, 20.0, 0.02)):
        heights[round(float(time), 2)] = sweeping.move(stalled(time), BELIEF).foot[2] + Gait().height
    assert heights[5.0] == heights[12.0] == pytest.approx(shape.height)
    assert 0.0 < heights[14.5] < shape.height
    assert abs(heights[19.9]) < 1e-12


def test_a_foot_that_has_slipped_is_taken_for_where_it_is() -> None:
    """In a second or so; the others stay, and so does the free one's place under its hip."""
    sweeping = Sweeping(Course((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=REACH))
    begin, planted = 1.6, {}
    for time in np.arange(0.0, 8.0, 0.02):
        planted[round(float(time), 2)] = sweeping.move(stalled(time, slipped=0.05), BELIEF).planted
    slips = {time: feet - neutral_feet(sweeping.gait) for time, feet in planted.items()}
    assert slips[begin - 0.02] == pytest.approx(0.0)
    assert slips[begin + 1.0][1, 0] == pytest.approx(0.05 * (1.0 - np.exp(-1.0)), rel=0.03)
    assert slips[7.98] == pytest.approx(np.array([[0, 0, 0], [0.05, 0, 0], [0, 0, 0], [0, 0, 0]]), abs=1e-3)
