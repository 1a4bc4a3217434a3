"""The ten numbers of a body's inertia: always a real body, exactly invertible."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from amhe_cli.core.rotations import rotate
from amhe_cli.system.parameters.inertia import (
    body_numbers,
    inertia_about_com,
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


def test_a_body_in_kg_and_m_is_that_of_its_mass_points() -> None:
    """A cloud of mass points: mass, centre of mass and inertia matrix by their definitions."""
    rng = np.random.default_rng(0)
    weights, points = rng.uniform(0.1, 1.0, 20), rng.normal(0.0, [0.1, 0.2, 0.3], (20, 3))
    homogeneous = np.concatenate((points, np.ones((20, 1))), axis=1)
    factor = upper_factor((weights[:, None] * homogeneous).T @ homogeneous)
    found = {name: value[0] for name, value in inertia_about_com(factor[None]).items()}
    com = weights @ points / weights.sum()
    x, _, z = (points - com).T
    assert found["mass"] == pytest.approx(weights.sum())
    assert [found[f"com_{axis}"] for axis in "xyz"] == pytest.approx(com)
    assert found["I_yy"] == pytest.approx(weights @ (x**2 + z**2))
    assert found["I_xz"] == pytest.approx(-weights @ (x * z))
    assert list(found)[4:] == ["I_xx", "I_yy", "I_zz", "I_xy", "I_xz", "I_yz"]
