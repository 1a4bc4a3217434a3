"""What targets and joints may be, whoever asks for it."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed
from amhe_cli.robots.go1.kinematics import LOWER, TORQUE_LIMIT, UPPER

#: Limits of the vendor's library and of the robot's description differ: a command keeps to both.
_VENDOR_LOWER = sealed(np.tile([-1.047, -0.663, -2.721], 4))
_VENDOR_UPPER = sealed(np.tile([1.047, 2.966, -0.837], 4))
LOWEST = sealed(np.maximum(LOWER, _VENDOR_LOWER))
HIGHEST = sealed(np.minimum(UPPER, _VENDOR_UPPER))


def allowed(targets: FloatArray, joints: FloatArray, kp: float, share: float) -> FloatArray:
    """Targets within the joints' limits, that ask for no more torque than a share of what there is.

    Torque goes first: a joint outside of its limits is led back by no more than that, and its target may
    then be outside, too. The trip `range` sees to joints that are there when they should not be.

    Args:
        targets: [rad], shape (12,).
        joints: Where they are [rad], shape (12,).
        kp: Gain [N m/rad].
        share: Of the torque limit.
    """
    reach = share * TORQUE_LIMIT / max(kp, 1e-6)
    inside = np.minimum(np.maximum(targets, LOWEST), HIGHEST)
    return np.minimum(np.maximum(inside, joints - reach), joints + reach)


def beyond(joints: FloatArray, margin: float) -> bool:
    """Whether a joint is outside the limits by more than a margin [rad]."""
    return bool(((joints < LOWEST - margin) | (joints > HIGHEST + margin)).any())
