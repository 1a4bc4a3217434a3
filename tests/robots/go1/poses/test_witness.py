"""Poses against what the robot feels, without a robot: four feet stand, and the trunk moves over them."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.rotations import exp, multiply, rotate
from amhe_cli.robots.go1.behaviours.gait import Gait, walk
from amhe_cli.robots.go1.kinematics import FOOT_RADIUS, HOME, HOME_HEIGHT, feet, joint_angles
from amhe_cli.robots.go1.link.mail import SAMPLE
from amhe_cli.robots.go1.model import Box, plant_model
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.poses.witness import Witness

CYCLE, SPEED = 0.02, 0.15
FEET = feet(HOME) + np.array([0.0, 0.0, HOME_HEIGHT])
#: Centre of a box that the bumper touches when the trunk is over the origin, and its edges.
AHEAD, SIZE = np.array([0.27 + 0.15, 0.0, 0.15]), np.array([0.3, 0.5, 0.3])
AHEAD_ONLY = np.array([1.0, 0.0, 0.0])
CAMERAS = exp(np.array([0.0, 0.0, 0.7]))
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class Walk:
    """Leans ahead over standing feet and sways, and pushes the box by its bumper; cameras see both.

    Args:
        speed: Of the trunk, ahead [m/s].
        noise: Of the cameras [m].
    """

    def __init__(self, speed: float = SPEED, noise: float = 0.002) -> None:
        self.witness = Witness(6.0, 0.045, "go1", "box", SIZE)
        self.time, self.speed, self.noise, self.rng = 0.0, speed, noise, np.random.default_rng(0)
        self.shift = {"go1": np.zeros(3), "box": np.zeros(3)}
        self.slide = {"go1": np.zeros(3), "box": np.zeros(3)}
        self.frozen: dict[str, np.ndarray] = {}
        self.lost = {"go1": 0.0, "box": 0.0}
        self.late, self.deaf, self.until = 0.0, 0.0, np.inf

    def place(self, time: float) -> np.ndarray:
        sway = 0.1 * self.speed * np.sin(14.0 * time)
        return np.array([self.speed * (time - 0.5), sway, HOME_HEIGHT])

    def cycles(self, seconds: float) -> str:
        """Walk on until something contradicts; what does, in words."""
        for _ in range(round(seconds / CYCLE)):
            times = self.time + 0.002 * np.arange(1, 11)
            self.time += CYCLE
            robot = np.zeros(10, dtype=SAMPLE)
            robot["time"], robot["quaternion"] = times - self.late, exp(np.array([0.0, 0.0, -0.2]))
            self._move(robot, times)
            self.witness.feel(robot[:0] if self.time < self.deaf else robot, self.until)
            for time in (self.time - 0.01, self.time):
                self._look(time)
            if contradiction := self.witness.contradiction:
                return contradiction
        return ""

    def _move(self, robot: np.ndarray, times: np.ndarray) -> None:
        moved = [
            np.array([joint_angles(FEET - self.place(time)) for time in times + dt]) for dt in (0.0, 1e-4)
        ]
        robot["joints"] = moved[0] + 0.003 * self.rng.standard_normal((10, 12))
        robot["joint_rates"] = (moved[1] - moved[0]) / 1e-4 + 0.05 * self.rng.standard_normal((10, 12))
        robot["gyro"] = 0.02 * self.rng.standard_normal((10, 3))

    def _look(self, time: float) -> None:
        trunk = self.place(time)
        for body, place in (("go1", trunk), ("box", AHEAD + trunk * AHEAD_ONLY)):
            self.shift[body] = self.shift[body] + 0.01 * self.slide[body]
            if time < self.lost[body]:
                continue
            noisy = place + self.shift[body] + self.noise * self.rng.standard_normal(3)
            if body in self.frozen:
                noisy = self.frozen[body] + 1e-6 * (self.noise > 0.0) * self.rng.standard_normal(3)
            turn = multiply(CAMERAS, exp(0.005 * (self.noise > 0.0) * self.rng.standard_normal(3)))
            self.witness.see(body, time, (rotate(CAMERAS, noisy), turn))

    def freeze(self, body: str) -> None:
        """Show a body where it is now from now on."""
        trunk = self.place(self.time)
        self.frozen[body] = trunk if body == "go1" else AHEAD + trunk * AHEAD_ONLY


@pytest.mark.parametrize("noise", [0.002, 0.0001])
@pytest.mark.parametrize("speed", [SPEED, 0.0])
def test_a_robot_that_goes_as_its_legs_say_is_believed(speed: float, noise: float) -> None:
    assert Walk(speed, noise).cycles(1.2) == ""


def test_a_way_through_lost_states_is_as_uncertain_as_it_is_long() -> None:
    """A robot stops while a busy computer loses 0.3 s of its states: legs cannot say when."""
    walk = Walk(speed=0.25)
    walk.frozen["box"] = np.array([3.0, 0.0, 0.0])
    walk.witness = Witness(6.0, 0.5, "go1", "box", SIZE)
    assert walk.cycles(1.0) == ""
    stopped, walk.deaf = walk.place(walk.time), walk.time + 0.3
    walk.place = lambda time: stopped
    assert walk.cycles(0.6) == ""
    walk.slide["go1"] = np.array([0.3, 0.0, 0.0])
    assert "contradict" in walk.cycles(0.6)


@pytest.mark.parametrize(("gap", "face", "inside"), [(0.0, 0.3, True), (0.3, 0.3, False), (0.3, 0.2, True)])
def test_feet_of_before_a_gap_are_not_inside_the_box(gap: float, face: float, inside: bool) -> None:
    """Before a gap front feet reached 4 cm into where the box is in it; a bumper is known in a gap, too."""
    robot, witness = np.zeros(10, dtype=SAMPLE), Witness(6.0, 0.5, "go1", "box", SIZE)
    robot["quaternion"], low = LEVEL, np.array([0.0, 0.0, -HOME_HEIGHT])
    ahead = (0.34 - FOOT_RADIUS - FEET[:, 0].max()) * AHEAD_ONLY
    for time in (0.0, 0.02, 0.34) if gap else np.arange(0.0, 0.35, 0.02):
        robot["time"] = time + 0.002 * np.arange(10)
        robot["joints"] = joint_angles(FEET + low + ahead * (time < 0.1 or not gap))
        witness.feel(robot)
    for time in np.arange(0.0, 0.16, 0.01):  # the first half of the gap
        witness.see("go1", time, (-low, LEVEL))
        witness.see("box", time, (np.array([face + 0.15, 0.0, 0.15]), LEVEL))
    assert ("inside the box" in witness.contradiction) == inside


@pytest.mark.parametrize("body", ["go1", "box"])
def test_a_body_that_is_out_of_sight_is_where_the_other_was_then(body: str) -> None:
    """Poses may be lost for 0.19 s; robot and box go on meanwhile, by 3 cm."""
    walk = Walk()
    assert walk.cycles(0.6) == ""
    walk.lost[body] = walk.time + 0.19
    assert walk.cycles(0.6) == ""


def test_states_that_are_lost_within_a_block_count_as_long_as_they_are() -> None:
    witness, robot = Witness(6.0, 0.5, "go1", "box", SIZE), np.zeros(10, dtype=SAMPLE)
    robot["time"] = 0.002 * np.arange(10) + 0.16 * (np.arange(10) > 6)
    robot["joints"], robot["quaternion"] = HOME, LEVEL
    witness.feel(robot)
    assert witness._felt[-1].blind >= 0.16**3


@pytest.mark.parametrize("noise", [0.002, 0.0])
@pytest.mark.parametrize(
    ("body", "message"), [("go1", "cameras and legs contradict each other"), ("box", "cm inside the box")]
)
def test_a_pose_that_freezes_is_noticed(body: str, message: str, noise: float) -> None:
    """With 1 um of noise, or equal to the last bit."""
    walk = Walk(noise=noise)
    assert walk.cycles(0.5) == ""
    walk.freeze(body)
    assert message in walk.cycles(0.4)


def test_a_robot_that_stands_does_not_hide_that_its_poses_froze() -> None:
    """Nothing moves, but cameras that are noisy all the time are not suddenly still."""
    walk = Walk(speed=0.0)
    assert walk.cycles(1.6) == ""
    walk.freeze("go1")
    began = walk.time
    assert "never so still" in walk.cycles(0.5)
    assert walk.time - began < 0.3


@pytest.mark.parametrize("noise", [0.0, 3e-6, 3e-5])
def test_cameras_that_are_quiet_are_believed(noise: float) -> None:
    """The robot leans ahead, and then stands quite still."""
    walk = Walk(noise=noise)
    assert walk.cycles(1.0) == ""
    stopped = walk.place(walk.time)
    walk.place = lambda time: stopped
    assert walk.cycles(2.0) == ""


def test_a_camera_is_never_that_still() -> None:
    """It moves by less than legs are believed for."""
    walk = Walk(speed=0.02)
    assert walk.cycles(0.5) == ""
    walk.freeze("go1")
    assert "stands still, or its poses froze" in walk.cycles(0.5)


@pytest.mark.parametrize(
    ("body", "slide", "message"),
    [
        ("go1", (0.0, 0.3, 0.0), "cameras and legs contradict"), ("go1", (0.3, 0.0, 0.0), "cameras and legs"),
        ("box", (0.3, 0.0, 0.0), "nothing touches it"), ("box", (-0.3, 0.0, 0.0), "inside the box"),
    ],
)  # fmt: skip
def test_a_pose_that_slides_is_noticed(body: str, slide: tuple[float, ...], message: str) -> None:
    walk = Walk()
    assert walk.cycles(0.5) == ""
    walk.slide[body] = np.array(slide)
    assert message in walk.cycles(0.7)


@pytest.mark.parametrize(("patience", "noticed"), [(0.045, True), (0.5, False)])
def test_states_of_a_while_ago_are_noticed(patience: float, noticed: bool) -> None:
    """What may be older, for a machine that is busy, is no contradiction."""
    walk = Walk(speed=0.25)
    walk.frozen["box"] = np.array([3.0, 0.0, 0.0])
    walk.witness = Witness(6.0, patience, "go1", "box", SIZE)
    assert walk.cycles(0.5) == ""
    walk.late = 0.2
    assert ("ms older than its poses" in walk.cycles(0.04)) == noticed


def test_states_that_wait_to_be_taken_in_are_not_old() -> None:
    walk = Walk()
    assert walk.cycles(0.5) == ""
    walk.deaf, walk.until = 1.0, walk.time
    assert walk.cycles(0.3) == ""
    walk.until = np.inf
    assert "ms older than its poses" in walk.cycles(0.04)


@pytest.mark.parametrize(("height", "inside"), [(0.0, 0.02), (0.0, 0.03), (0.4, 0.03)])
def test_a_foot_is_not_inside_the_box_beside_it(height: float, inside: float) -> None:
    """Nor in one that is over it; it may be 21 mm off."""
    witness = Witness(6.0, 0.045, "go1", "box", SIZE)
    robot = np.zeros(100, dtype=SAMPLE)
    robot["time"], robot["joints"], robot["quaternion"] = 0.002 * np.arange(100), HOME, LEVEL
    witness.feel(robot)
    x, y, _ = feet(HOME)[1]
    box = np.array([x, y + FOOT_RADIUS + 0.25 - inside, 0.15 + height])
    for time in 0.01 * np.arange(1, 16):
        witness.see("go1", time, (np.array([0.0, 0.0, HOME_HEIGHT]), LEVEL))
        witness.see("box", time, (box, LEVEL))
    assert ("inside the box" in witness.contradiction) == (inside > 0.021 and height == 0.0)


def walked(seconds: float, frozen: str = "", since: float = np.inf, noise: float = 0.0) -> tuple[float, str]:
    """A trot in the plant that pushes a box from 1 s on: when something contradicts a pose, and what."""
    rng = np.random.default_rng(4)
    box = Box(mass=4.0, floor_friction=0.6, position=(0.5, 0.0))
    plant, gait = Plant(plant_model(box), [], np.random.default_rng(3)), Gait()
    witness, kept = Witness(6.0, 0.045, "trunk", "box", SIZE), {}
    while plant.time < seconds:
        push = np.array([23.5 if plant.time > 1.0 else 0.0, 0.0])
        measured = plant.advance(
            walk(gait, plant.time + 0.01, np.array([0.2, 0.0, 0.0]), push).targets, CYCLE
        )
        robot = np.zeros(10, dtype=SAMPLE)
        robot["time"], robot["joints"] = measured["joints.position"]
        robot["joint_rates"], robot["gyro"] = (
            measured[key][1] for key in ("joints.velocity", "imu.angular_velocity")
        )
        robot["quaternion"] = plant.state.trunk.orientation
        witness.feel(robot)
        for body in ("trunk", "box"):
            (times, places), (_, turns) = measured[f"{body}.position"], measured[f"{body}.orientation"]
            for time, place, turn in zip(times.tolist(), places, turns, strict=True):
                if body == frozen and time >= since:
                    place, turn = kept.setdefault(body, (place, turn))
                    place = place + noise * rng.standard_normal(3)
                witness.see(body, time, (place, turn))
        if contradiction := witness.contradiction:
            return plant.time, contradiction
    return plant.time, ""


@pytest.mark.medium
def test_a_robot_that_walks_and_pushes_is_believed_until_a_pose_freezes() -> None:
    assert walked(4.0)[1] == ""
    for body, noise, message in (("trunk", 0.0, "froze"), ("box", 1e-6, "inside the box")):
        time, contradiction = walked(4.0, body, 3.0, noise)
        assert time < 3.5, body
        assert message in contradiction
