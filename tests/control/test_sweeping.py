"""The sweep with one leg: when it ends."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.control.gait import Gait, neutral_feet
from amhe_cli.control.path import Path
from amhe_cli.control.sweeping import Sweeping, SweepShape
from amhe_cli.go1.legs import joint_angles
from amhe_cli.go1.state import Body, State

REACH, HEIGHT = 0.25, 0.27


def at_rest(position: tuple[float, float, float]) -> Body:
    return Body(np.array(position), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))


def stalled(time: float) -> State:
    """The trunk has gone back over its feet; the free foot hangs 2 cm before its reach and does not move."""
    feet = neutral_feet(Gait(height=HEIGHT))
    feet[0] += np.array([0.0, -(REACH - 0.02) - feet[0, 1], 0.14])
    trunk, box = at_rest((-0.12 * (time > 0.0), 0.0, HEIGHT)), at_rest((0.1, -0.405, 0.15))
    return State(time, trunk, box, joint_angles(feet).ravel(), np.zeros(12))


def test_a_kick_that_stalls_is_given_up() -> None:
    sweeping = Sweeping(Path((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=REACH))
    speeds = {t: sweeping.move(stalled(t), 10.0).reference.speed for t in (0.0, 2.0, 2.5, 2.75, 2.85, 3.5)}
    shape = sweeping.shape
    assert speeds[2.0] == speeds[2.5] == speeds[2.75] == shape.kick
    assert speeds[2.85] == speeds[3.5] == 0.0
    assert 0.75 < shape.kick_time < 0.85


def test_when_all_is_done_the_foot_is_set_down() -> None:
    """Given up at 12 s; back where it began, the foot goes down to the floor, and stays there."""
    sweeping = Sweeping(Path((0.1, -0.34), -0.5 * np.pi, 0.5), 0.15, shape=SweepShape(reach=2.0))
    shape, heights = sweeping.shape, {}
    for time in (0.0, *np.arange(1.0, 20.0, 0.02)):
        heights[round(float(time), 2)] = sweeping.move(stalled(time), 10.0).foot[2] + Gait().height
    assert heights[5.0] == heights[12.0] == pytest.approx(shape.height)
    assert 0.0 < heights[14.5] < shape.height
    assert abs(heights[19.9]) < 1e-12
