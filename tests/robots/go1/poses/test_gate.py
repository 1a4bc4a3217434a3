"""Which poses are believed, without a robot."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply
from amhe_cli.robots.go1.poses.gate import Gate
from amhe_cli.robots.go1.settings import PoseSettings

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
PERIOD = 0.01


class Cameras:
    """A robot that walks ahead of cameras, and the box before it."""

    def __init__(self) -> None:
        self.gate = Gate(PoseSettings(), "go1", "box")
        self.time, self.rng = 50.0, np.random.default_rng(0)

    def shows(self, body: str = "go1", by=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0), early: float = 0.0) -> bool:
        """Whether the next pose of a body is believed, that is off by so much."""
        self.time += PERIOD
        sway = 0.01 * np.sin(12.0 * self.time)
        place = np.array([0.3 * (self.time - 50.0) + 0.6 * (body == "box"), sway, 0.2])
        noisy = place + 0.001 * self.rng.standard_normal(3) + by
        pose = noisy, multiply(exp(np.array([0.0, 0.3 * sway, 0.0])), exp(np.array(turn)))
        return self.gate.believes(body, self.time + early, pose, self.time + 0.005, LEVEL, "")


@pytest.fixture
def cameras() -> Cameras:
    seen = Cameras()
    assert all(seen.shows(body) for _ in range(200) for body in ("go1", "box"))
    assert (seen.gate.dropped, seen.gate.doubt) == (0, "")
    return seen


@pytest.mark.parametrize(
    "wrong",
    [
        {"by": (1e300, 0.0, 0.0)}, {"by": (np.nan, 0.0, 0.0)}, {"by": (0.0, 25.0, 0.0)},
        {"by": (0.0, 0.1, 0.0)}, {"by": (0.0, 0.05, 0.0)}, {"turn": (0.0, 0.0, 0.5)},
        {"early": 1e9}, {"early": -0.2},
    ],
)  # fmt: skip
@pytest.mark.parametrize("body", ["go1", "box"])
def test_a_pose_that_cannot_be_true_is_dropped(cameras: Cameras, body: str, wrong: dict) -> None:
    assert not cameras.shows(body, **wrong)
    assert cameras.gate.dropped == 1
    assert all(cameras.shows(body) for _ in range(20))
    assert cameras.gate.doubt == ""


@pytest.mark.parametrize("by", [(-0.7, 0.0, 0.0), (1.6, 0.0, 0.0)])
def test_a_box_behind_the_robot_or_out_of_reach_is_none(by: tuple[float, float, float]) -> None:
    seen = Cameras()
    assert seen.shows("go1")
    assert not any(seen.shows("box", by) for _ in range(10))
    assert "10 of the last 100 poses of 'box' cannot be true: the box would be" in seen.gate.doubt


def test_ten_of_a_hundred_are_too_many(cameras: Cameras) -> None:
    for number in range(80):
        assert cameras.shows(by=(0.0, 0.5, 0.0) if number % 10 == 0 else (0.0, 0.0, 0.0)) == (number % 10 > 0)
    assert cameras.gate.doubt == ""
    for _ in range(2):
        assert not cameras.shows(by=(0.0, 0.5, 0.0))
    assert cameras.gate.doubt.startswith("10 of the last 100 poses of 'go1' cannot be true: it steps by")


def test_a_tilt_that_the_imu_does_not_feel_is_doubted_after_a_while(cameras: Cameras) -> None:
    """It grows slowly: no single pose is out of the way."""
    leant = 0
    for number in range(60):
        assert cameras.shows(turn=(0.0, 0.02 * number, 0.0))
        leant += 0.02 * number > np.deg2rad(15.5)
        if cameras.gate.doubt:
            break
    assert 18 <= leant <= 24
    assert "disagree by" in cameras.gate.doubt
