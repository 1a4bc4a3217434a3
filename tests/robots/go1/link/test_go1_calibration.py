"""Calibration of rigid bodies, from poses that a test makes up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply
from amhe_cli.robots.go1.link import mail
from amhe_cli.robots.go1.link.calibration import Calibration
from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.feed import TimedPose
from amhe_cli.robots.go1.poses.source import PoseError
from amhe_cli.robots.go1.resting import trunk_height
from amhe_cli.robots.go1.settings import Go1Settings

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
        states = np.zeros(20, mail.SAMPLE)
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
