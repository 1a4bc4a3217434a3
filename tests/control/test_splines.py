"""Splines against their definition: cubic pieces, two continuous derivatives, straight ends."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.control.mpopi import shift_matrix, spline_basis
from amhe_cli.core.arrays import FloatArray

FEW = settings(max_examples=25, deadline=None)

KNOTS = st.integers(2, 9)
ANYWHERE = st.lists(st.floats(-0.5, 1.5), min_size=1, max_size=20)


def natural_spline(values: FloatArray, at: FloatArray) -> FloatArray:
    """Coefficients of all pieces at once, from the conditions that define a natural cubic spline."""
    pieces = len(values) - 1
    gap = 1.0 / pieces
    rows: list[FloatArray] = []
    sides: list[float] = []

    def condition(side: float, *parts: tuple[int, list[float]]) -> None:
        row = np.zeros((pieces, 4))
        for piece, coefficients in parts:
            row[piece] += coefficients
        rows.append(row.ravel())
        sides.append(side)

    end = [[1.0, gap, gap**2, gap**3], [0.0, 1.0, 2.0 * gap, 3.0 * gap**2], [0.0, 0.0, 2.0, 6.0 * gap]]
    for piece in range(pieces):
        condition(values[piece], (piece, [1.0, 0.0, 0.0, 0.0]))
        condition(values[piece + 1], (piece, end[0]))
    for piece in range(pieces - 1):
        condition(0.0, (piece, end[1]), (piece + 1, [0.0, -1.0, 0.0, 0.0]))
        condition(0.0, (piece, end[2]), (piece + 1, [0.0, 0.0, -2.0, 0.0]))
    condition(0.0, (0, [0.0, 0.0, 2.0, 0.0]))
    condition(0.0, (pieces - 1, end[2]))
    coefficients = np.linalg.solve(np.array(rows), np.array(sides)).reshape(pieces, 4)
    piece = np.minimum((at / gap).astype(int), pieces - 1)
    local = at - piece * gap
    return (coefficients[piece] * local[:, None] ** np.arange(4)).sum(axis=1)


@FEW
@given(seed=st.integers(0, 999), knots=KNOTS)
def test_it_is_the_natural_cubic_spline(seed: int, knots: int) -> None:
    values, at = np.random.default_rng(seed).normal(size=knots), np.linspace(0.0, 1.0, 41)
    np.testing.assert_allclose(spline_basis(at, knots) @ values, natural_spline(values, at), atol=1e-10)


@FEW
@given(knots=KNOTS, level=st.floats(-5.0, 5.0), slope=st.floats(-5.0, 5.0))
def test_lines_are_reproduced_and_held_outside(knots: int, level: float, slope: float) -> None:
    at = np.linspace(-0.3, 1.3, 33)
    values = level + slope * np.linspace(0.0, 1.0, knots)
    expected = level + slope * np.clip(at, 0.0, 1.0)
    np.testing.assert_allclose(spline_basis(at, knots) @ values, expected, atol=1e-12)


@FEW
@given(seed=st.integers(0, 999), horizon=st.integers(5, 40), knots=KNOTS, steps=st.floats(0.0, 50.0))
def test_shifted_knots_are_the_spline_later(seed: int, horizon: int, knots: int, steps: float) -> None:
    """The spline's values so many steps later, and past its end the last one."""
    values = np.random.default_rng(seed).normal(size=knots)
    later = np.minimum(np.linspace(0.0, 1.0, knots) + steps / (horizon - 1), 1.0)
    np.testing.assert_allclose(
        shift_matrix(horizon, knots, steps) @ values, natural_spline(values, later), atol=1e-9
    )
