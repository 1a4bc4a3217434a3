"""Kinematics of a Go1's legs in closed form, for all legs and any number of instants at once.

Frames: the trunk's, x forward, y left, z up. Legs in Unitree's order FR FL RR RL, joints of a leg hip
(abduction, about x), thigh and calf (about y); a vector of twelve joints is the legs one after the other.
Numbers: Unitree's go1_description, as in MuJoCo Menagerie's unitree_go1.
"""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray, sealed

LEGS = ("FR", "FL", "RR", "RL")
KINDS = ("hip", "thigh", "calf")
#: Names of the twelve joints and of their servos in every model of this package.
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in KINDS)
SERVOS = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)

#: +1 left, -1 right.
SIDE = sealed([-1.0, 1.0, -1.0, 1.0])
#: Hip joints in the trunk [m], shape (4, 3).
HIPS = sealed([[0.1881, -0.04675, 0], [0.1881, 0.04675, 0], [-0.1881, -0.04675, 0], [-0.1881, 0.04675, 0]])
#: From the hip joint sideways to the leg's plane [m].
HIP_OFFSET = 0.08
#: Length of thigh, and of calf [m].
LINK = 0.213
FOOT_RADIUS = 0.023

#: One leg at home [rad], and all legs.
HOME_LEG = sealed([0.0, 0.9, -1.8])
HOME = sealed(np.tile(HOME_LEG, 4))
#: Height of the trunk over the floor with straight-standing legs at home [m].
HOME_HEIGHT = 2.0 * LINK * float(np.cos(0.9)) + FOOT_RADIUS

#: Joint limits [rad], torque limits [N m], shape (12,).
LOWER = sealed(np.tile([-0.863, -0.686, -2.818], 4))
UPPER = sealed(np.tile([0.863, 4.501, -0.888], 4))
TORQUE_LIMIT = sealed(np.tile([23.7, 23.7, 35.55], 4))

#: From thigh joint to foot with the knee at its limits [m].
_SHORTEST, _LONGEST = (2.0 * LINK * float(np.cos(0.5 * limit)) for limit in (LOWER[2], UPPER[2]))


def feet(joints: FloatArray) -> FloatArray:
    """Forward kinematics.

    Args:
        joints: Angles [rad], shape (..., 12).

    Returns:
        Centres of the feet in the trunk's frame [m], shape (..., 4, 3).
    """
    hip, thigh, knee = _angles(joints)
    down = -LINK * (np.cos(thigh) + np.cos(knee))
    side = HIP_OFFSET * SIDE
    c, s = np.cos(hip), np.sin(hip)
    ahead = -LINK * (np.sin(thigh) + np.sin(knee))
    return HIPS + np.stack((ahead, c * side - s * down, s * side + c * down), axis=-1)


def joint_angles(feet: FloatArray) -> FloatArray:
    """Inverse kinematics, knees backward; the inverse of `feet` within reach and within joint limits.

    A foot out of reach is met in its direction as far as the leg goes; angles are clipped to the limits.

    Args:
        feet: Centres of the feet in the trunk's frame [m], shape (..., 4, 3).

    Returns:
        Angles [rad], shape (..., 12).
    """
    x, y, z = np.moveaxis(feet - HIPS, -1, 0)
    side = HIP_OFFSET * SIDE
    down = -np.sqrt(np.maximum(y**2 + z**2 - HIP_OFFSET**2, 1e-6))
    hip = np.arctan2(z, y) - np.arctan2(down, side)
    hip = np.mod(hip + np.pi, 2.0 * np.pi) - np.pi
    length = np.clip(np.hypot(x, down), _SHORTEST, _LONGEST)
    # Thigh and calf are equally long: the line from hip to foot halves the knee's angle.
    calf = -2.0 * np.arccos(length / (2.0 * LINK))
    thigh = np.arctan2(-x, -down) - 0.5 * calf
    angles = np.stack((hip, thigh, calf), axis=-1)
    return np.clip(angles.reshape(*angles.shape[:-2], 12), LOWER, UPPER)


def jacobian(joints: FloatArray) -> FloatArray:
    """Velocity of each foot per velocity of its own joints, in the trunk's frame.

    Args:
        joints: Angles [rad], shape (..., 12).

    Returns:
        Matrices [m/rad], shape (..., 4, 3, 3): leg, direction, joint.
    """
    hip, thigh, knee = _angles(joints)
    c, s = np.cos(hip), np.sin(hip)
    side = HIP_OFFSET * SIDE
    down = -LINK * (np.cos(thigh) + np.cos(knee))
    # What thigh and calf do to the leg's reach ahead and down, in the leg's plane.
    thigh_ahead, calf_ahead = down, -LINK * np.cos(knee)
    thigh_down, calf_down = LINK * (np.sin(thigh) + np.sin(knee)), LINK * np.sin(knee)
    by_hip = np.stack((np.zeros_like(c), -s * side - c * down, c * side - s * down), axis=-1)
    by_thigh = np.stack((thigh_ahead, -s * thigh_down, c * thigh_down), axis=-1)
    by_calf = np.stack((calf_ahead, -s * calf_down, c * calf_down), axis=-1)
    return np.stack((by_hip, by_thigh, by_calf), axis=-1)


def joint_rates(joints: FloatArray, velocity: FloatArray) -> FloatArray:
    """Joint velocities [rad/s], shape (..., 12), that move the feet so [m/s], shape (..., 4, 3)."""
    rates = np.linalg.solve(jacobian(joints), velocity[..., None])
    return np.asarray(rates, dtype=np.float64).reshape(*rates.shape[:-3], 12)


def holding_torques(joints: FloatArray, ground_forces: FloatArray) -> FloatArray:
    """Joint torques with which legs of no weight answer forces of the ground, -J^T f.

    Args:
        joints: Angles [rad], shape (..., 12).
        ground_forces: On each foot, in the trunk's frame [N], shape (..., 4, 3).

    Returns:
        Torques [N m], shape (..., 12).
    """
    torques = -np.einsum("...lij,...li->...lj", jacobian(joints), ground_forces)
    return torques.reshape(*torques.shape[:-2], 12)


def _angles(joints: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Hip, thigh and thigh + calf angles, each (..., 4)."""
    q = np.asarray(joints, dtype=np.float64)
    q = q.reshape(*q.shape[:-1], 4, 3)
    return q[..., 0], q[..., 1], q[..., 1] + q[..., 2]
