"""Calibration of rigid bodies, from poses that a test makes up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply
from amhe_cli.robots.go1.emulator import EmulatedBody
from amhe_cli.robots.go1.kinematics import HOME, HOME_HEIGHT
from amhe_cli.robots.go1.link.calibration import Calibration, average, check_pivot, offset_of, trunk_height
from amhe_cli.robots.go1.link.mail import SAMPLE
from amhe_cli.robots.go1.link.packets import DAMPED, MotorCommand
from amhe_cli.robots.go1.link.process import Clock
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.feed import TimedPose
from amhe_cli.robots.go1.poses.gate import offset_pose, rigid_body
from amhe_cli.robots.go1.poses.sources import PoseError
from amhe_cli.robots.go1.settings import Go1Settings
from amhe_cli.robots.go1.tasks import find_task

NOTHING: Any = SimpleNamespace(connect=lambda: None, samples=list)
#: As a Go1 lies, its calves folded [rad].
FOLDED = np.tile([0.0, 1.2, -2.7], 4)
#: How it lies: pitched by 0.03, headed elsewhere.
TURN = multiply(exp(np.array([0.0, 0.0, 0.7])), exp(np.array([0.0, 0.03, 0.0])))


class Cameras:
    """See bodies at one place so many times a second.

    Args:
        rate: [Hz].
    """

    bodies: tuple[str, ...] = ("go1",)
    place = np.zeros(3)

    def __init__(self, rate: float) -> None:
        self._clock, self._period = Clock(), 1.0 / rate
        self._last = self._clock.now()

    def first(self) -> dict[str, TimedPose]:
        return {}

    def poses(self) -> list[TimedPose]:
        new = int((self._clock.now() - self._last) / self._period)
        self._last += new * self._period
        level = np.array([1.0, 0.0, 0.0, 0.0])
        return [TimedPose(body, 0.0, self.place, level) for body in self.bodies] * new


def test_a_look_too_short_for_slow_cameras_says_so() -> None:
    cameras: Any = Cameras(rate=10.0)
    calibration = Calibration(NOTHING, cameras, Go1Settings(), Clock(), Box())
    with pytest.raises(PoseError, match=r"\d poses of 'go1' came in 0.5 s, and 20 are needed: look longer"):
        calibration.offsets(lambda text: None, 0.5)


class Lying:
    """A robot that lies still, and says so through noisy sensors."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def connect(self) -> None: ...

    def samples(self) -> list[Any]:
        states = np.zeros(20, SAMPLE)
        states["quaternion"] = TURN
        states["joints"] = FOLDED + self._rng.normal(0.0, 0.003, (20, 12))
        return list(states)


def test_the_height_is_that_of_the_mean_joints() -> None:
    cameras: Any = Cameras(rate=200.0)
    cameras.place, cameras.bodies = np.array([0.0, 0.0, 0.1]), ("go1", "box")
    link: Any = Lying()
    found = Calibration(link, cameras, Go1Settings(), Clock(), Box(position=(0.0, 0.0))).offsets(
        lambda text: None, 0.5
    )
    true = trunk_height(TURN, FOLDED)
    assert found.height == pytest.approx(true, abs=2e-4), "a single state is 1 mm off"
    assert found.trunk[2] == pytest.approx(true - 0.1, abs=1e-3)
    assert found.tilt == pytest.approx(0.03)


def test_a_robot_that_falls_silent_is_reported() -> None:
    cameras: Any = Cameras(rate=200.0)
    calibration = Calibration(NOTHING, cameras, Go1Settings(), Clock(), Box())
    with pytest.raises(PoseError, match="0 states of the robot came in 0.5 s"):
        calibration.offsets(lambda text: None, 0.5)


TRUE = (np.array([0.6, 0.1, 0.15]), exp(np.array([0.02, -0.01, 0.4])))
OFFSET = (0.05, -0.02, -0.1, 0.1, 0.2, -1.0)
BOX_SIZE = np.array([0.3, 0.5, 0.3])


def test_an_offset_leads_there_and_back() -> None:
    body = rigid_body(TRUE, OFFSET)
    np.testing.assert_allclose(offset_of(body, TRUE), OFFSET, atol=1e-12)
    place, turn = offset_pose(body, offset_of(body, TRUE))
    np.testing.assert_allclose(place, TRUE[0], atol=1e-12)
    np.testing.assert_allclose(turn, TRUE[1], atol=1e-12)


def test_noise_is_averaged_whatever_the_sign_of_the_quaternions() -> None:
    rng = np.random.default_rng(0)
    seen = [
        (
            TRUE[0] + 0.001 * rng.standard_normal(3),
            (-1.0) ** i * multiply(TRUE[1], exp(0.003 * rng.standard_normal(3))),
        )
        for i in range(200)
    ]
    place, turn = average(seen, "box")
    np.testing.assert_allclose(place, TRUE[0], atol=4e-4)
    np.testing.assert_allclose(abs(turn @ TRUE[1]), 1.0, atol=1e-6)


@pytest.mark.parametrize("step", [(np.array([0.02, 0.0, 0.0]), 0.0), (np.zeros(3), 0.05)])
def test_what_moves_is_refused(step: tuple[np.ndarray, float]) -> None:
    moved = (TRUE[0] + step[0], multiply(TRUE[1], exp(np.array([0.0, 0.0, step[1]]))))
    with pytest.raises(PoseError, match="'box' does not stand still"):
        average([TRUE] * 20 + [moved] * 20, "box")


@pytest.mark.parametrize(
    ("place", "message"), [([0.6, 0.15, -0.1], "up axis z"), ([0.0, 0.0, 0.3], "check its name"),
                        ([600.0, 100.0, 150.0], "metres")],
)  # fmt: skip
def test_a_pivot_that_is_elsewhere_is_refused(place: list[float], message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_pivot((np.array(place), TRUE[1]), TRUE, BOX_SIZE, "box")


def test_markers_may_stand_off() -> None:
    check_pivot((np.array([0.6, 0.1, 0.4]), TRUE[1]), TRUE, BOX_SIZE, "box")


LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def test_a_lying_robot_is_at_rest_where_it_should_be_and_as_high_as_its_joints_say() -> None:
    plant = EmulatedBody(find_task("t1"), np.random.default_rng(0))
    trunk = plant.state.trunk
    assert trunk_height(trunk.orientation, plant.state.joints) == pytest.approx(trunk.position[2], abs=0.002)
    for _ in range(1000):
        plant.obey(MotorCommand(DAMPED))
    after = plant.state.trunk
    np.testing.assert_allclose(after.position, trunk.position, atol=1e-3)
    np.testing.assert_allclose(after.position[:2], 0.0, atol=1e-3)
    np.testing.assert_allclose(abs(after.orientation @ LEVEL), 1.0, atol=1e-4)


def test_a_standing_robot_is_as_high_as_its_legs() -> None:
    assert trunk_height(LEVEL, HOME) == pytest.approx(HOME_HEIGHT, abs=0.02)


def test_a_robot_on_its_side_rests_on_its_side() -> None:
    assert 0.1 < trunk_height(exp(np.array([0.5 * np.pi, 0.0, 0.0])), HOME) < 0.3
