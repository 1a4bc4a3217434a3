"""Cubic splines over a horizon as matrices: a plan is H x K numbers times K knots."""

from __future__ import annotations

import numpy as np

from amhe_cli.core.arrays import FloatArray


def spline_basis(at: FloatArray, knots: int) -> FloatArray:
    """Matrix that takes the values at K even knots over [0, 1] to those of their natural cubic spline.

    Outside of [0, 1] the spline keeps its end values.

    Args:
        at: Where to evaluate, between 0 and 1, shape (H,).
        knots: K, at least 2.

    Returns:
        Matrix of shape (H, K); rows sum to one.
    """
    x = np.clip(at, 0.0, 1.0)
    gap = 1.0 / (knots - 1)
    left = np.minimum((x / gap).astype(int), knots - 2)
    b = x / gap - left
    a = 1.0 - b
    curvature = _second_derivatives(knots, gap)
    rows = np.arange(x.size)
    basis = np.zeros((x.size, knots))
    basis[rows, left] = a
    basis[rows, left + 1] = b
    bend = gap**2 / 6.0 * (np.stack((a**3 - a, b**3 - b)))[..., None]
    return basis + bend[0] * curvature[left] + bend[1] * curvature[left + 1]


def shift_matrix(horizon: int, knots: int, steps: float) -> FloatArray:
    """Matrix (K, K) that moves a spline over H instants ahead by some steps; its end is held."""
    return spline_basis(np.linspace(0.0, 1.0, knots) + steps / (horizon - 1), knots)


def _second_derivatives(knots: int, gap: float) -> FloatArray:
    """Matrix (K, K) from values at the knots to second derivatives there, zero at both ends."""
    system, differences = np.eye(knots), np.zeros((knots, knots))
    for i in range(1, knots - 1):
        system[i, i - 1 : i + 2] = np.array([1.0, 4.0, 1.0]) * gap / 6.0
        differences[i, i - 1 : i + 2] = np.array([1.0, -2.0, 1.0]) / gap
    return np.asarray(np.linalg.solve(system, differences), dtype=np.float64)
