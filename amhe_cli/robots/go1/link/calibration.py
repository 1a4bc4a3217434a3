"""Calibration of the two rigid bodies: robot and box are put where they should be, and looked at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import conjugate, difference, exp, log, mean, multiply, rotate, yaw_of
from amhe_cli.robots.go1.link.link import Link
from amhe_cli.robots.go1.link.process import Clock, Opened
from amhe_cli.robots.go1.model import Box, layout, plant_model
from amhe_cli.robots.go1.poses.feed import PoseFeed
from amhe_cli.robots.go1.poses.gate import up
from amhe_cli.robots.go1.poses.sources import Pose, PoseError
from amhe_cli.robots.go1.settings import Go1Settings, Offset

#: Length, width and height of a Go1's trunk, hips and head included [m].
_TRUNK = np.array([0.6, 0.3, 0.12])
#: A robot that lies on level ground leans no more than this [rad], and is so high at most [m].
_LEVEL, _LYING = float(np.deg2rad(5.0)), 0.15
#: Between two halves of an observation, what stands still moves and turns by no more than this [m, rad].
_STILL = (0.002, 0.01)
#: A pivot lies within its body, or as far outside as markers stand off it [m].
_STAND_OFF = 0.15
#: The least height of a pivot over the floor [m]: below, another axis is upward, or the origin elsewhere.
_LOWEST = 0.02
#: Higher than any part of the robot is over another [m].
_ABOVE = 1.0
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


class Calibration(Opened):
    """Use it as a context manager; nothing moves.

    Args:
        link: Link to the robot, whose joints and IMU show how it lies.
        feed: Source of poses.
        box: Box of the task, and where it is to be put down.
    """

    def __init__(self, link: Link, feed: PoseFeed, settings: Go1Settings, clock: Clock, box: Box) -> None:
        self._link, self._feed, self._settings, self._clock, self._box = link, feed, settings, clock, box

    def _open(self, opening: ExitStack) -> None:
        opening.enter_context(self._feed)
        opening.enter_context(self._link)

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
        (x, y), yaw = self._box.position, self._box.yaw
        turned = f", turned by {np.rad2deg(yaw):.0f} degrees" if yaw else ""
        ask(
            f"put the box down with its centre at x = {x:.2f} m, y = {y:.2f} m of motion capture, its faces "
            f"along the axes{turned}"
        )
        box, _ = self._look(s.box, seconds)
        there = np.array([x, y, 0.5 * self._box.size[2]]), exp(np.array([0.0, 0.0, yaw]))
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
    imu = mean([state["quaternion"] for state in states])
    imu = multiply(exp(np.array([0.0, 0.0, -float(yaw_of(imu))])), imu)
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


def average(poses: Sequence[Pose], of: str) -> Pose:
    """The mean of poses of a body that stands still.

    Args:
        poses: Poses of the body, at least two.
        of: Name of the body.

    Raises:
        PoseError: It moved.
    """
    half = len(poses) // 2
    first, second = (_mean(part) for part in (poses[:half], poses[half:]))
    moved = float(np.linalg.norm(second[0] - first[0]))
    turned = float(np.linalg.norm(difference(second[1], first[1])))
    if moved > _STILL[0] or turned > _STILL[1]:
        raise PoseError(
            f"{of!r} does not stand still: {1e3 * moved:.1f} mm, {np.rad2deg(turned):.1f} degrees meanwhile; "
            "let go of it, and check that motion capture sees its markers well"
        )
    return _mean(poses)


def _mean(poses: Sequence[Pose]) -> Pose:
    return np.mean([place for place, _ in poses], axis=0), mean([turn for _, turn in poses])


def offset_of(body: Pose, true: Pose) -> Offset:
    """The offset that leads from a rigid body's pose to the true one: the inverse of `offset_pose`."""
    back = conjugate(body[1])
    place, turn = rotate(back, true[0] - body[0]), log(multiply(back, true[1]))
    return tuple(float(value) for value in (*place, *turn))  # type: ignore[return-value]


def check_pivot(body: Pose, true: Pose, size: FloatArray, of: str) -> None:
    """Refuse a rigid body that cannot be on the body that stands there.

    Args:
        body: Pose of the rigid body by motion capture.
        true: True pose of the body that carries it.
        size: Edge lengths of that body [m], shape (3,).
        of: Name of that body.

    Raises:
        PoseError: It is elsewhere; the text says what to check.
    """
    if not body[0][2] > _LOWEST:
        raise PoseError(
            f"by motion capture {of!r} is {body[0][2]:.3g} m over the floor: is its up axis z, and its "
            "origin on the floor? (Motive: Settings > Streaming > Up Axis: Z)"
        )
    inside = np.abs(rotate(conjugate(true[1]), body[0] - true[0])) - 0.5 * size
    if inside.max() > _STAND_OFF:
        at, to = (", ".join(f"{value:.2f}" for value in place) for place in (body[0], true[0]))
        raise PoseError(
            f"the pivot of {of!r} is at ({at}) m of motion capture, but what it is on was to stand at ({to}):"
            " check its name (`go1.trunk=NAME` `go1.box=NAME`), metres, and where you put it"
        )


def trunk_height(orientation: FloatArray, joints: FloatArray) -> float:
    """Height of the trunk's centre when the lowest of all collision shapes touches the floor [m].

    Args:
        orientation: Unit quaternion of the trunk (4,); its heading does not matter.
        joints: Joint angles [rad], shape (12,).
    """
    model, robot = _robot()
    data, at, floor = mujoco.MjData(model), layout(model), model.geom("floor").id
    data.qpos[at.trunk] = (0.0, 0.0, _ABOVE, *orientation)
    data.qpos[at.joints] = joints
    mujoco.mj_kinematics(model, data)
    gaps = [mujoco.mj_geomDistance(model, data, floor, shape, 2.0 * _ABOVE, None) for shape in robot]
    return _ABOVE - min(gaps)


@cache
def _robot() -> tuple[mujoco.MjModel, list[int]]:
    """The plant's model, and the robot's shapes that touch the floor."""
    model = plant_model()
    floor, box = model.geom("floor").id, model.geom("box").id
    pairs = np.stack((model.pair_geom1, model.pair_geom2), axis=1)
    touching = pairs[(pairs == floor).any(axis=1)].ravel().tolist()
    return model, sorted(set(touching) - {floor, box})
