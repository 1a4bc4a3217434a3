"""How feet share the weight, and the force of a push, so that the robot neither falls nor turns."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.state import GRAVITY

#: Weight of the Go1's 12.743 kg [N].
WEIGHT = 12.743 * GRAVITY
#: Its centre of mass when it stands, ahead and left in the trunk's frame [m].
CENTRE_OF_MASS = sealed([-0.0023, 0.0009])


def box_friction(belief: Mapping[str, float]) -> float:
    """Force with which the box rubs on the floor when it slides, mu m g, by believed parameters [N]."""
    return belief["box_mass"] * belief["floor_friction"] * GRAVITY


def stance_weights(feet: FloatArray, load: FloatArray, centre: FloatArray) -> FloatArray:
    """Shares of the weight with which the feet balance about a point, as even as can be.

    Minimises the sum of share^2 / load subject to the equations of rest: the shares sum to one, and their
    centre is the point. Two feet cannot meet all of them: the total comes first, balance as near as it
    gets. Shares are never negative: feet do not stick.

    Args:
        feet: Places [m], shape (..., 4, 2 or 3).
        load: How much each foot may carry, 0 in the air to 1, at least one above 0; shape (..., 4).
        centre: The point that the weight acts through [m], shape (..., 2).

    Returns:
        Shares, shape (..., 4).
    """
    half_length = 0.2  # of a Go1 [m]: brings moments to the size of forces
    arms = (feet[..., :2] - centre[..., None, :]) / half_length
    equations = np.concatenate((np.ones_like(arms[..., :1]), arms), axis=-1)  # (..., 4, 3)
    weighted = equations * load[..., None]
    normal = np.swapaxes(equations, -1, -2) @ weighted + np.diag([0.0, 1e-3, 1e-3])
    multipliers = np.linalg.solve(normal, np.array([[1.0], [0.0], [0.0]]))
    shares = np.maximum((weighted @ multipliers)[..., 0], 0.0)
    return shares / shares.sum(axis=-1, keepdims=True)


def ground_forces(feet: FloatArray, load: FloatArray, push: FloatArray, height: ArrayLike) -> FloatArray:
    """Forces of the ground on the feet that carry the robot while it pushes.

    A push at some height tips the robot away from it: the feet on the far side take more.

    Args:
        feet: Places in the trunk's frame [m], shape (..., 4, 3).
        load: As in `stance_weights`.
        push: Force on what is pushed, ahead and left [N], shape (..., 2).
        height: Of the push over the floor [m], shape (...).

    Returns:
        Forces [N], shape (..., 4, 3).
    """
    shares = stance_weights(feet, load, CENTRE_OF_MASS - push * (np.asarray(height)[..., None] / WEIGHT))
    force = np.concatenate((push, np.full((*push.shape[:-1], 1), WEIGHT)), axis=-1)
    return shares[..., None] * force[..., None, :]
