"""Offsets of rigid bodies, from poses of what stands where it should."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.rotations import conjugate, difference, exp, log, mean, multiply, rotate
from amhe_cli.robots.go1.poses.source import Pose, PoseError

#: Place [m] and rotation vector [rad] of the body that carries the markers, in the rigid body's frame.
Offset = tuple[float, float, float, float, float, float]
NO_OFFSET: Offset = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

#: Between two halves of an observation, what stands still moves and turns by no more than this [m, rad].
_STILL = (0.002, 0.01)
#: A pivot lies within its body, or as far outside as markers stand off it [m].
_STAND_OFF = 0.15
#: The least height of a pivot over the floor [m]: below, another axis is upward, or the origin is another
#: one.
_LOWEST = 0.02


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
    """The offset that leads from a rigid body's pose to the true one: the inverse of `frame.offset_pose`."""
    back = conjugate(body[1])
    place, turn = rotate(back, true[0] - body[0]), log(multiply(back, true[1]))
    return tuple(float(value) for value in (*place, *turn))  # type: ignore[return-value]


def rigid_body(true: Pose, offset: Sequence[float]) -> Pose:
    """The pose that a rigid body has, whose offset leads to the true pose."""
    turn = multiply(true[1], conjugate(exp(np.array(offset[3:]))))
    return true[0] - rotate(turn, np.array(offset[:3])), turn


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
