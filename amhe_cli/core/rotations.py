"""Unit quaternions, batched over leading axes, in MuJoCo's order w, x, y, z.

Products, logarithms and differences are computed where their arguments lie, also on a device.

Quaternions and their negatives are the same rotation; every function here gives the same answer for
both, so that a log may flip signs as it likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray, namespace_of


def conjugate(q: FloatArray) -> FloatArray:
    """Inverse of unit quaternions, shape (..., 4)."""
    return q * namespace_of(q).asarray(np.array([1.0, -1.0, -1.0, -1.0]))


def multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton product a b: rotate by b, then by a; shape (..., 4)."""
    aw, ax, ay, az = _components(a)
    bw, bx, by, bz = _components(b)
    return _joined(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(q: FloatArray, v: FloatArray) -> FloatArray:
    """Rotate vectors v (..., 3) by unit quaternions q (..., 4): child frame to parent frame."""
    w, xyz = q[..., :1], q[..., 1:]
    t = 2.0 * cross(xyz, v)
    return v + w * t + cross(xyz, t)


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of vectors (..., 3); `np.cross` takes five times as long for a single vector."""
    ax, ay, az = _components(a)
    bx, by, bz = _components(b)
    return _joined(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _components(a: FloatArray) -> Sequence[Any]:
    """What the last axis holds; of one vector as plain numbers, whose products take a tenth of the time."""
    alone = isinstance(a, np.ndarray) and a.ndim == 1
    return a.tolist() if alone else [a[..., i] for i in range(a.shape[-1])]


def _joined(*components: Any) -> FloatArray:
    """The inverse of `_components`."""
    if isinstance(components[0], float):
        return np.array(components)
    return namespace_of(components[0]).stack(components, axis=-1)


def log(q: FloatArray) -> FloatArray:
    """Rotation vector [rad], shape (..., 3), of unit quaternions; its norm is at most pi."""
    xp, w, xyz = namespace_of(q), q[..., :1], q[..., 1:]
    xyz = xp.where(w < 0.0, -xyz, xyz)
    sine = xp.linalg.norm(xyz, axis=-1, keepdims=True)
    angle = 2.0 * xp.arctan2(sine, xp.abs(w))
    return xyz * xp.where(sine > 1e-12, angle / xp.maximum(sine, 1e-12), 2.0)


def yaw_of(q: FloatArray) -> FloatArray:
    """Heading [rad] of unit quaternions (..., 4), shape (...)."""
    w, x, y, z = _components(q)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def exp(rotation: FloatArray) -> FloatArray:
    """Unit quaternions, shape (..., 4), of rotation vectors [rad] (..., 3)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    half = 0.5 * angle
    return np.concatenate((np.cos(half), 0.5 * np.sinc(half / np.pi) * rotation), axis=-1)


def of_rpy(angles: FloatArray) -> FloatArray:
    """Unit quaternions, shape (..., 4), of roll, pitch and yaw [rad] (..., 3): about x, then y, then z."""
    roll, pitch, yaw = (exp(angles[..., [i]] * np.eye(3)[i]) for i in range(3))
    return multiply(yaw, multiply(pitch, roll))


def difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Rotation vector [rad], in b's frame, that takes b to a: log(b^-1 a), shape (..., 3)."""
    return log(multiply(conjugate(b), a))


def slerp(a: FloatArray, b: FloatArray, fraction: FloatArray) -> FloatArray:
    """Interpolate along the shorter arc; fraction 0 gives a, 1 gives b, shape (...)."""
    return multiply(a, exp(fraction[..., None] * difference(b, a)))


def normalised(q: FloatArray) -> FloatArray:
    """Quaternions (..., 4) scaled to unit length."""
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def mean(q: FloatArray | Sequence[FloatArray]) -> FloatArray:
    """Mean (4,) of unit quaternions (n, 4) that are close to each other, of either sign."""
    turns = np.asarray(q)
    return normalised((turns * np.sign(turns @ turns[0])[:, None]).mean(axis=0))
