"""Standing on three legs while the front right one is free to push.

The trunk first moves over the triangle of the other feet, then the leg is lifted: in the other order the
robot falls towards it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.behaviours.gait import Gait, LegTargets, ground_forces, leg_targets, neutral_feet

#: Places of the free leg among the four, and of the two at the ends of the long side of their triangle.
FREE, _FRONT, _REAR = 0, 1, 2
#: How far the trunk goes ahead and left, away from the free leg [m].
SHIFT = sealed([-0.05, 0.04])


@dataclass(frozen=True, slots=True)
class Tripod:
    """How a front leg becomes free.

    Args:
        shift_time: The trunk moves over the other three feet in this time [s].
        lift_time: The free foot then goes to its first place in this time [s].
    """

    shift_time: float = 1.0
    lift_time: float = 0.6


def stand_on_three(
    gait: Gait,
    tripod: Tripod,
    time: ArrayLike,
    foot: ArrayLike,
    trunk: ArrayLike = (0.0, 0.0, 0.0),
    push: ArrayLike = (0.0, 0.0),
    trunk_now: ArrayLike | None = None,
    planted: FloatArray | None = None,
) -> LegTargets:
    """Shift the trunk, lift the leg, and from then on put the free foot where `foot` says.

    Places are in the frame of the trunk *before* the shift: that frame stays with the three feet. Those of
    the result are in the trunk's frame, as always.

    Args:
        gait: Height and servo gain; the rest is not used.
        tripod: How fast the leg becomes free.
        time: Time since the start of the shift [s], shape (...).
        foot: Place of the free foot [m], shape (..., 3).
        trunk: Further movement of the trunk: ahead, left [m], turn [rad], shape (..., 3).
        push: Force of the free foot on what it touches, ahead and left [N], shape (..., 2).
        trunk_now: Where the trunk really is: ahead, left [m], turn [rad], shape (3,). The free foot is
            placed, and the weight spread, as seen from there: a trunk that lags its target by a tenth of a
            radian would put the foot 3 cm astray. None: where it should be.
        planted: Where the feet stand [m], shape (4, 3); that of the free leg is where it is lifted from.
            None: they are neutral.
    """
    time, foot, trunk, push = (np.asarray(x, dtype=np.float64) for x in (time, foot, trunk, push))
    batch = np.broadcast_shapes(time.shape, foot.shape[:-1], trunk.shape[:-1], push.shape[:-1])
    shifted = _smooth(time / tripod.shift_time)
    lifted = _smooth((time - tripod.shift_time) / tripod.lift_time)[..., None]
    planted = neutral_feet(gait) if planted is None else planted
    places = np.broadcast_to(planted, (*batch, 4, 3)).copy()
    places[..., FREE, :] += lifted * (foot - places[..., FREE, :])
    moved = shifted[..., None] * SHIFT + trunk[..., :2]
    feet = _from_trunk(places, np.broadcast_to(moved, (*batch, 2)), np.broadcast_to(trunk[..., 2], batch))
    seen = feet
    if trunk_now is not None:
        now = np.asarray(trunk_now, dtype=np.float64)
        seen = _from_trunk(places, now[:2], now[2])
        feet[..., FREE, :] = seen[..., FREE, :]

    load = np.ones((*batch, 4))
    load[..., FREE] = 1.0 - shifted
    height = gait.height + places[..., FREE, 2]
    forces = _forces(gait, seen, load, np.broadcast_to(push, (*batch, 2)), height)
    contact = np.ones((*batch, 4), dtype=np.bool_)
    contact[..., FREE] = np.broadcast_to(time < tripod.shift_time, batch)
    return leg_targets(gait, feet, np.zeros_like(feet), forces, contact)


def support_margin(planted: FloatArray, trunk: FloatArray) -> float:
    """How far the trunk is inside the triangle of the other feet, from the side of the free leg [m].

    Args:
        planted: See `stand_on_three`, shape (4, 3).
        trunk: Place ahead and left of neutral [m], shape (2,) or more.
    """
    front, rear = planted[[_FRONT, _REAR], :2]
    along = (front - rear) / np.linalg.norm(front - rear)
    place = np.asarray(trunk)[:2] - rear
    return float(along[0] * place[1] - along[1] * place[0])


def _forces(
    gait: Gait, feet: FloatArray, load: FloatArray, push: FloatArray, height: FloatArray
) -> FloatArray:
    """Three feet carry the robot and push back on the floor; the free one has the push upon it."""
    forces = ground_forces(gait, feet, load, push, height)
    free = load[..., FREE] == 0.0
    forces[..., FREE, :2] = np.where(free[..., None], -push, forces[..., FREE, :2])
    return forces


def _from_trunk(places: FloatArray, moved: FloatArray, turn: FloatArray) -> FloatArray:
    """Places (..., 4, 3) as a trunk sees them that has moved (..., 2) and turned (...) in their frame."""
    c, s = np.cos(turn)[..., None], np.sin(turn)[..., None]
    x, y = (places[..., i] - moved[..., None, i] for i in (0, 1))
    return np.stack((c * x + s * y, c * y - s * x, places[..., 2]), axis=-1)


def _smooth(share: FloatArray) -> FloatArray:
    """A smooth step from 0 to 1, clipped outside."""
    x = np.clip(share, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
