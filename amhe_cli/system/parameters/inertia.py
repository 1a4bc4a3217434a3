"""Inertia of a rigid body as ten free numbers that are always physically consistent.

The pseudo-inertia J (4, 4) of a body is positive definite exactly when its mass is positive and its
rotational inertia belongs to some distribution of positive mass (triangle inequality included). Here
J = L L^T with L = L0 U(p), where L0 is the nominal body's own factor and U the log-Cholesky matrix of
Rucker & Wensing, "Smooth Parameterization of Rigid-Body Inertia", IEEE RA-L 7(2), 2022, eq. 14:

    U(p) = e^alpha [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]]

p = 0 is the nominal body, every p is a valid one, and all ten numbers are without unit: lengths are in
units of the nominal body's own extent.
"""

from __future__ import annotations

import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray

#: The ten numbers p, in column order.
PSEUDO_NAMES = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")


def inertia_of(name: str) -> str:
    """The `pseudo_inertia` of which a parameter is a coordinate, 'link' of 'link.alpha'; '' of others."""
    whole, _, last = name.rpartition(".")
    return whole if last in PSEUDO_NAMES else ""


def rotation_matrix(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of unit quaternions w, x, y, z (..., 4)."""
    turned = rotations.rotate(np.asarray(quaternion, dtype=np.float64)[..., None, :], np.eye(3))
    return np.swapaxes(turned, -1, -2)


def quaternion_of(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    Shepperd's method, from the largest of the four candidates, so that no division is by a small number.
    """
    r = np.asarray(rotation, dtype=np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 1, 0] + r[..., 0, 1], r[..., 0, 2] + r[..., 2, 0], r[..., 2, 1] + r[..., 1, 2]
    candidates = np.stack(  # each row is 4 q_k q
        [
            np.stack([1 + xx + yy + zz, a, b, c], axis=-1),
            np.stack([a, 1 + xx - yy - zz, d, e], axis=-1),
            np.stack([b, d, 1 - xx + yy - zz, f], axis=-1),
            np.stack([c, e, f, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )
    largest = np.argmax(np.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(candidates, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0.0, -q, q)


def pseudo_inertia(mass: float, com: FloatArray, quaternion: FloatArray, inertia: FloatArray) -> FloatArray:
    """Pseudo-inertia (4, 4) of MuJoCo's numbers for one body.

    Args:
        mass: Mass of the body [kg].
        com: Centre of mass in the body frame [m], shape (3,).
        quaternion: Principal axes in the body frame, shape (4,).
        inertia: Principal moments about the centre of mass [kg m^2], shape (3,).
    """
    axes = rotation_matrix(quaternion)
    second = axes @ np.diag(0.5 * inertia.sum() - inertia) @ axes.T + mass * np.outer(com, com)
    j = np.empty((4, 4))
    j[:3, :3], j[:3, 3], j[3, :3], j[3, 3] = second, mass * com, mass * com, mass
    return j


def upper_factor(j: FloatArray) -> FloatArray:
    """Upper triangular L (4, 4) with j = L L^T.

    Raises:
        numpy.linalg.LinAlgError: `j` is not positive definite: no real body has this inertia.
    """
    return np.asarray(np.linalg.cholesky(j[::-1, ::-1])[::-1, ::-1], dtype=np.float64)


def log_cholesky(p: FloatArray) -> FloatArray:
    """Matrices U (..., 4, 4) of numbers p (..., 10)."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = np.moveaxis(np.asarray(p, dtype=np.float64), -1, 0)
    u = np.zeros((*np.shape(alpha), 4, 4))
    u[..., 0, 0], u[..., 1, 1], u[..., 2, 2], u[..., 3, 3] = np.exp(d1), np.exp(d2), np.exp(d3), 1.0
    u[..., 0, 1], u[..., 1, 2], u[..., 0, 2] = s12, s23, s13
    u[..., 0, 3], u[..., 1, 3], u[..., 2, 3] = t1, t2, t3
    return np.exp(alpha)[..., None, None] * u


def log_cholesky_of(u: FloatArray) -> FloatArray:
    """Numbers p (..., 10) of matrices U (..., 4, 4): the inverse of `log_cholesky`."""
    scale = u[..., 3, 3]
    diagonal = [np.log(u[..., i, i] / scale) for i in range(3)]
    above = [u[..., i, j] / scale for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    return np.stack([np.log(scale), *diagonal, *above], axis=-1)


def body_numbers(factor: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """MuJoCo's numbers for pseudo-inertias L L^T.

    Args:
        factor: Upper triangular factor L, shape (n, 4, 4).

    Returns:
        Mass (n,), centre of mass (n, 3), principal quaternion (n, 4), principal moments (n, 3).
    """
    mass, com, second = _moments_of(factor)
    moments, axes = np.linalg.eigh(second)
    handed = np.linalg.det(axes)  # eigh may return a reflection
    axes = axes * np.where(handed < 0.0, -1.0, 1.0)[..., None, None]
    inertia = moments.sum(axis=-1, keepdims=True) - moments
    return mass, com, quaternion_of(axes), inertia


def _moments_of(factor: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mass, centre of mass and second moments about it of L L^T."""
    j = factor @ np.swapaxes(factor, -1, -2)
    mass = j[..., 3, 3]
    com = j[..., :3, 3] / mass[..., None]
    return mass, com, j[..., :3, :3] - mass[..., None, None] * com[..., :, None] * com[..., None, :]


def inertia_about_com(factor: FloatArray) -> dict[str, FloatArray]:
    """Mass [kg], centre of mass [m] and inertia about it [kg m^2], in the body's axes, of L L^T.

    Args:
        factor: Upper triangular factor L, shape (n, 4, 4).

    Returns:
        mass, com_x to com_z, I_xx, I_yy, I_zz, I_xy, I_xz, I_yz, each (n,); products of inertia have the sign
        of the inertia matrix, -integral of x y dm.
    """
    mass, com, second = _moments_of(factor)
    inertia = np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second
    numbers = {"mass": mass} | {f"com_{axis}": com[..., i] for i, axis in enumerate("xyz")}
    for pair in ("xx", "yy", "zz", "xy", "xz", "yz"):
        numbers[f"I_{pair}"] = inertia[..., "xyz".index(pair[0]), "xyz".index(pair[1])]
    return numbers


def principal_axis(quaternion: FloatArray, axis: int) -> int:
    """Which principal axis lies closest to body axis 0 (x), 1 (y) or 2 (z).

    MuJoCo orders principal axes by size, so that 'x' of a body is often its third principal moment.
    """
    alignment = np.abs(rotation_matrix(quaternion))
    orders = ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0))
    best = max(orders, key=lambda order: sum(alignment[row, column] for row, column in enumerate(order)))
    return best[axis]
