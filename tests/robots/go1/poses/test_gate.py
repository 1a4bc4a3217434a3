"""From the frame of the cameras to the task's, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.robots.go1.poses.gate import Gate, World, check_axes, check_place, offset_pose, tilt_offset
from amhe_cli.robots.go1.poses.sources import PoseError
from amhe_cli.robots.go1.settings import PoseSettings

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
WANTED = np.array([0.6, 0.0, 0.15])


def turned(x: float, y: float, z: float) -> np.ndarray:
    return exp(np.array([x, y, z]))


def test_the_tasks_frame_lies_under_the_trunk_along_its_heading() -> None:
    heading = turned(0.0, 0.0, 2.0)
    trunk = (np.array([3.0, -1.0, 0.09]), multiply(heading, turned(0.02, -0.03, 0.0)))
    world = World.under(trunk)
    position, orientation = world.seen(trunk)
    np.testing.assert_allclose(position, [0.0, 0.0, 0.09], atol=1e-12)
    ahead = rotate(orientation, np.array([1.0, 0.0, 0.0]))
    assert np.arctan2(ahead[1], ahead[0]) == pytest.approx(0.0, abs=1e-9)
    box = (trunk[0] + rotate(heading, np.array([0.6, 0.1, 0.06])), heading)
    np.testing.assert_allclose(world.seen(box)[0], [0.6, 0.1, 0.15], atol=0.01)


def test_a_rigid_body_elsewhere_on_the_trunk_is_moved_to_its_centre() -> None:
    centre, turn = np.array([1.0, 2.0, 0.3]), turned(0.1, -0.2, 0.7)
    offset = (0.05, -0.01, -0.08, 0.0, 0.0, 0.4)
    orientation = multiply(turn, turned(0.0, 0.0, -0.4))
    position = centre - rotate(orientation, np.array(offset[:3]))
    found = offset_pose((position, orientation), offset)
    np.testing.assert_allclose(found[0], centre, atol=1e-12)
    np.testing.assert_allclose(np.abs(found[1] @ turn), 1.0)


def test_the_tilt_that_is_proposed_makes_imu_and_cameras_agree() -> None:
    imu = turned(0.05, -0.04, 0.3)
    seen = multiply(turned(0.0, 0.0, 1.0), multiply(imu, turned(0.1, 0.2, 0.0)))
    pose = (np.array([0.0, 0.0, 0.1]), seen)
    mended = offset_pose(pose, (0.0, 0.0, 0.0, *tilt_offset(pose, imu)))
    np.testing.assert_allclose(tilt_offset(mended, imu), 0.0, atol=1e-9)


def test_a_frame_that_is_right_is_taken() -> None:
    check_axes((np.array([5.0, 1.0, 0.09]), turned(0.02, 0.0, 2.5)), turned(0.0, 0.03, -1.0))
    check_place(np.array([0.65, -0.05, 0.16]), WANTED, 0.15)


@pytest.mark.parametrize(
    ("position", "orientation", "message"),
    [
        ([0.0, 0.09, 0.0], turned(-np.pi / 2, 0.0, 0.0), "Up Axis: Z"),
        ([0.0, 0.0, 90.0], LEVEL, "stream metres"),
        ([0.0, 0.0, -0.2], LEVEL, "origin on the floor"),
        ([0.0, 0.0, 0.09], turned(0.4, 0.0, 0.0), "disagree by 23 degrees"),
    ],
)
def test_a_frame_that_cannot_be_is_refused(position, orientation, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_axes((np.array(position), orientation), LEVEL)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ([-0.6, 0.0, 0.09], "each other's name"),
        ([0.9, 0.0, 0.15], "wants it at"),
        ([0.6, 0.0, 0.5], "wants it at"),
    ],
)
def test_a_box_that_is_elsewhere_is_refused(box, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        check_place(np.array(box), WANTED, 0.15)


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
