"""The ten numbers of a body's inertia: always a real body, exactly invertible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from amhe_cli.core.rotations import rotate
from amhe_cli.system.inertia import (
    body_numbers,
    log_cholesky,
    principal_axis,
    pseudo_inertia,
    quaternion_of,
    rotation_matrix,
    upper_factor,
)

numbers = arrays(np.float64, 10, elements=st.floats(-1.0, 1.0))
quaternions = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(numbers)
def test_every_vector_is_a_real_body(p: np.ndarray) -> None:
    mass, _, quaternion, inertia = body_numbers(log_cholesky(p)[None])
    assert mass[0] > 0.0
    assert np.all(inertia > 0.0)
    assert inertia[0].sum() - 2.0 * inertia[0].max() > -1e-12 * inertia.sum()  # triangle inequality
    assert np.linalg.norm(quaternion[0]) == pytest.approx(1.0)


@given(numbers)
def test_pseudo_inertia_round_trip(p: np.ndarray) -> None:
    factor = log_cholesky(p)
    mass, com, quaternion, inertia = (x[0] for x in body_numbers(factor[None]))
    j = pseudo_inertia(float(mass), com, quaternion, inertia)
    assert np.all(np.linalg.eigvalsh(j) > 0.0)
    np.testing.assert_allclose(j, factor @ factor.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(upper_factor(j), factor, atol=1e-7)


@given(quaternions)
def test_rotation_matrix_and_back(q: np.ndarray) -> None:
    q = q / np.linalg.norm(q)
    matrix = rotation_matrix(q)
    np.testing.assert_allclose(matrix @ [1.0, 2.0, 3.0], rotate(q, np.array([1.0, 2.0, 3.0])), atol=1e-12)
    back = quaternion_of(matrix)
    np.testing.assert_allclose(back * np.sign(back @ q), q, atol=1e-9)


def test_an_impossible_inertia_has_no_factor() -> None:
    bent = np.array([1.0, 1.0, 3.0])  # 3 > 1 + 1
    with pytest.raises(np.linalg.LinAlgError):
        upper_factor(pseudo_inertia(1.0, np.zeros(3), np.array([1.0, 0, 0, 0]), bent))


def test_principal_axes_are_found_whatever_their_order() -> None:
    quarter_about_y = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])  # x -> -z, z -> x
    assert [principal_axis(quarter_about_y, axis) for axis in range(3)] == [2, 1, 0]
