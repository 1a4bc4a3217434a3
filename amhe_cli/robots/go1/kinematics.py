"""Kinematics of a Go1's legs in closed form, for all legs and any number of instants at once.

Frames: the trunk's, x forward, y left, z up. Legs in Unitree's order FR FL RR RL, joints of a leg hip
(abduction, about x), thigh and calf (about y); a vector of twelve joints is the legs one after the other.
Numbers: Unitree's go1_description, as in MuJoCo Menagerie's unitree_go1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import FloatArray, columns, sealed

LEGS = ("FR", "FL", "RR", "RL")
KINDS = ("hip", "thigh", "calf")
#: Names of the twelve joints and of their servos in every model of this package.
JOINTS = tuple(f"{leg}_{kind}_joint" for leg in LEGS for kind in KINDS)
SERVOS = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)

#: Sides of the legs: +1 left, -1 right.
SIDE = sealed([-1.0, 1.0, -1.0, 1.0])
#: Hip joints in the trunk [m], shape (4, 3).
HIPS = sealed([[0.1881, -0.04675, 0], [0.1881, 0.04675, 0], [-0.1881, -0.04675, 0], [-0.1881, 0.04675, 0]])
#: Distance from the hip joint sideways to the leg's plane [m].
HIP_OFFSET = 0.08
_ASIDE = sealed(HIP_OFFSET * SIDE)
#: Length of thigh, and of calf [m].
LINK = 0.213
FOOT_RADIUS = 0.023

#: Joint angles at home [rad], shape (12,).
HOME = sealed(np.tile([0.0, 0.9, -1.8], 4))
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
    at = posture(joints)
    return HIPS + columns(
        at.c.shape, at.ahead, at.c * _ASIDE - at.s * at.down, at.s * _ASIDE + at.c * at.down
    )


def joint_angles(feet: FloatArray) -> FloatArray:
    """Inverse kinematics, knees backward; the inverse of `feet` within reach and within joint limits.

    A foot out of reach is met in its direction as far as the leg goes; angles are clipped to the limits.

    Args:
        feet: Centres of the feet in the trunk's frame [m], shape (..., 4, 3).

    Returns:
        Angles [rad], shape (..., 12).
    """
    from_hip = feet - HIPS
    x, y, z = from_hip[..., 0], from_hip[..., 1], from_hip[..., 2]
    square = np.maximum(y * y + z * z - HIP_OFFSET**2, 1e-6)
    down = -np.sqrt(square)
    hip = np.arctan2(z * _ASIDE - y * down, y * _ASIDE + z * down)  # from (aside, down) to (y, z)
    length = np.minimum(np.maximum(np.sqrt(x * x + square), _SHORTEST), _LONGEST)
    # Thigh and calf are equally long: the line from hip to foot halves the knee's angle.
    half = np.arccos(length / (2.0 * LINK))
    angles = _by_leg(hip, np.arctan2(-x, -down) + half, -2.0 * half)
    return np.minimum(np.maximum(angles, LOWER), UPPER)


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """Legs in their own planes, which the hips turn about x by an angle of cosine c, sine s; each (..., 4).

    `ahead` and `down` lead from thigh joint to foot [m] (down is negative), `calf_...` from knee to foot.
    """

    c: FloatArray
    s: FloatArray
    ahead: FloatArray
    down: FloatArray
    calf_ahead: FloatArray
    calf_down: FloatArray

    def rates(self, velocity: FloatArray) -> FloatArray:
        """Joint velocities that give the feet these velocities: J^-1 v by hand, faster than LAPACK.

        Args:
            velocity: Velocities of the feet in the trunk's frame [m/s], shape (..., 4, 3); knees are bent.

        Returns:
            Rates [rad/s], shape (..., 12).
        """
        ahead, across, along = self._in_plane(velocity)
        hip = -across / self.down
        along = along - _ASIDE * hip
        determinant = self.ahead * self.calf_down - self.down * self.calf_ahead
        thigh = (-self.calf_ahead * ahead - self.calf_down * along) / determinant
        calf = (self.ahead * ahead + self.down * along) / determinant
        return _by_leg(hip, thigh, calf)

    def holding_torques(self, ground_forces: FloatArray) -> FloatArray:
        """Joint torques with which legs of no weight answer forces of the ground, -J^T f.

        Args:
            ground_forces: Forces of the ground on the feet, in the trunk's frame [N], shape (..., 4, 3).

        Returns:
            Torques [N m], shape (..., 12).
        """
        ahead, across, along = self._in_plane(ground_forces)
        return _by_leg(
            self.down * across - _ASIDE * along,
            self.ahead * along - self.down * ahead,
            self.calf_ahead * along - self.calf_down * ahead,
        )

    def _in_plane(self, vectors: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Components of vectors (..., 4, 3) ahead, across the leg's plane, and upwards in it."""
        x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
        return x, self.c * y + self.s * z, self.c * z - self.s * y


def posture(joints: FloatArray) -> Posture:
    """The legs at joint angles [rad], shape (..., 12)."""
    q = np.asarray(joints, dtype=np.float64)
    q = q.reshape(*q.shape[:-1], 4, 3)
    hip, thigh, knee = q[..., 0], q[..., 1], q[..., 1] + q[..., 2]
    calf_ahead, calf_down = -LINK * np.sin(knee), -LINK * np.cos(knee)
    ahead, down = calf_ahead - LINK * np.sin(thigh), calf_down - LINK * np.cos(thigh)
    return Posture(np.cos(hip), np.sin(hip), ahead, down, calf_ahead, calf_down)


def _by_leg(hip: FloatArray, thigh: FloatArray, calf: FloatArray) -> FloatArray:
    """Numbers of hips, thighs and calves, each (..., 4), in the order of joints (..., 12)."""
    return columns(hip.shape, hip, thigh, calf).reshape(*hip.shape[:-1], 12)
