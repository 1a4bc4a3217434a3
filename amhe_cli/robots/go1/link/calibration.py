"""Calibration of the two rigid bodies: robot and box are put where they should be, and looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import exp, mean, multiply, yaw_of
from amhe_cli.robots.go1.link.clock import Clock
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.poses.calibration import Offset, average, check_pivot, offset_of
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.poses.frame import up
from amhe_cli.robots.go1.poses.source import Pose, PoseError
from amhe_cli.robots.go1.resting import trunk_height
from amhe_cli.robots.go1.settings import Go1Settings

#: Length, width and height of a Go1's trunk, hips and head included [m].
_TRUNK = np.array([0.6, 0.3, 0.12])
#: A robot that lies on level ground leans no more than this [rad], and is so high at most [m].
_LEVEL, _LYING = float(np.deg2rad(5.0)), 0.15
#: Time between two looks [s], and the fewest poses or states that make an average.
_STEP, _FEWEST = 0.02, 20

#: Asks the operator to do something, and returns when it is done.
Ask = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Offsets:
    """What a calibration has found.

    Args:
        trunk, box: Offsets as in `go1.trunk_offset` and `go1.box_offset`: place [m], rotation vector [rad].
        height: Height of the trunk's centre over the floor while it lay there [m].
        tilt: Angle by which the trunk leant [rad].
    """

    trunk: Offset
    box: Offset
    height: float
    tilt: float


class Calibration:
    """Use it as a context manager; nothing moves.

    Args:
        link: Link to the robot, whose joints and IMU tell how it lies.
        feed: Source of poses.
        settings: Settings of the robot.
        clock: The program's clock.
        box: Box of the task, and where it is to be put down.
    """

    def __init__(self, link: Link, feed: PoseFeed, settings: Go1Settings, clock: Clock, box: Box) -> None:
        self._link, self._feed, self._settings, self._clock, self._box = link, feed, settings, clock, box
        self._opened = ExitStack()

    def __enter__(self) -> Calibration:
        with ExitStack() as opening:  # what is open already is closed again where the next step fails
            opening.enter_context(self._feed)
            opening.enter_context(self._link)
            self._opened = opening.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def offsets(self, ask: Ask, seconds: float) -> Offsets:
        """Guide the operator through the calibration.

        Args:
            ask: Is called with each request to the operator.
            seconds: How long each body is observed [s].

        Raises:
            LinkError: The robot does not answer as it should.
            PoseError: Poses do not come, or cannot be true.
        """
        self._link.connect()
        self._feed.first()
        s = self._settings
        ask(
            "let the robot lie on the level floor, legs folded, the middle of its trunk over the origin of "
            "motion capture, its head along the x axis"
        )
        seen, states = self._look(s.trunk, seconds)
        trunk, tilt = _lying(states)
        check_pivot(seen, trunk, _TRUNK, s.trunk)
        x, y = self._box.position
        ask(
            f"put the box down with its centre at x = {x:.2f} m, y = {y:.2f} m of motion capture, its faces "
            f"along the axes{_turned(self._box.yaw)}"
        )
        (box, _), there = self._look(s.box, seconds), _standing(self._box)
        check_pivot(box, there, np.array(self._box.size), s.box)
        return Offsets(offset_of(seen, trunk), offset_of(box, there), float(trunk[0][2]), tilt)

    def _look(self, body: str, seconds: float) -> tuple[Pose, list[Any]]:
        """The mean pose of a body, and the states of the robot meanwhile."""
        self._feed.poses()  # what came while the operator was busy is old
        self._link.samples()
        begun, seen, states = self._clock.now(), [], []
        while self._clock.now() - begun < seconds:
            self._clock.sleep_until(self._clock.now() + _STEP)
            states += self._link.samples()
            seen += [(pose.position, pose.orientation) for pose in self._feed.poses() if pose.body == body]
        for what, some in ((f"poses of {body!r}", seen), ("states of the robot", states)):
            if len(some) < _FEWEST:
                raise PoseError(
                    f"{len(some)} {what} came in {seconds:g} s, and {_FEWEST} are needed: look longer "
                    "(`seconds`), or see that its markers are in view and the robot is on"
                )
        return average(seen, body), states


def _lying(states: Sequence[Any]) -> tuple[Pose, float]:
    """Pose of the trunk over the origin, headed along x, by joints and IMU; and how far it leans.

    The means of all states: the lowest point of a single noisy one is lower than that of the robot.
    """
    imu = _level_heading(mean([state["quaternion"] for state in states]))
    tilt = float(np.arccos(np.clip(up(imu)[2], -1.0, 1.0)))
    if tilt > _LEVEL:
        raise PoseError(
            f"by its IMU the trunk leans {np.rad2deg(tilt):.0f} degrees: put the robot on its belly, on "
            "level ground"
        )
    height = trunk_height(imu, np.mean([state["joints"] for state in states], axis=0))
    if height > _LYING:
        raise PoseError(f"by its joints the trunk is {height:.2f} m over the floor: let the robot lie")
    return (np.array([0.0, 0.0, height]), imu), tilt


def _level_heading(turn: FloatArray) -> FloatArray:
    """An orientation (4,) turned about the vertical until it heads along x."""
    return multiply(exp(np.array([0.0, 0.0, -float(yaw_of(turn))])), turn)


def _standing(box: Box) -> Pose:
    place = np.array([*box.position, 0.5 * box.size[2]])
    return place, exp(np.array([0.0, 0.0, box.yaw]))


def _turned(yaw: float) -> str:
    return f", turned by {np.rad2deg(yaw):.0f} degrees" if yaw else ""
