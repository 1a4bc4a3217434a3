"""Quaternion arithmetic against its own group axioms and MuJoCo."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core import rotations

numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.filter(lambda v: np.linalg.norm(v) < 3.1)


@given(turns)
def test_log_undoes_exp(turn):
    assert rotations.log(rotations.exp(turn)) == pytest.approx(turn, abs=1e-9)


@given(turns, turns)
def test_difference_does_not_see_the_sign(a, b):
    qa, qb = rotations.exp(a), rotations.exp(b)
    expected = rotations.difference(qa, qb)
    if np.linalg.norm(expected) < np.pi - 1e-6:  # at half a turn the axis may flip
        assert rotations.difference(-qa, qb) == pytest.approx(expected, abs=1e-7)
        assert rotations.difference(qa, -qb) == pytest.approx(expected, abs=1e-7)


@given(turns, vectors)
def test_rotate_is_mujocos(turn, vector):
    quaternion, expected = rotations.exp(turn), np.zeros(3)
    mujoco.mju_rotVecQuat(expected, vector, quaternion)
    assert rotations.rotate(quaternion, vector) == pytest.approx(expected, abs=1e-9)


@pytest.mark.medium
@given(turns, turns, st.floats(0.0, 1.0))
def test_slerp_divides_the_angle(a, b, share):
    qa, qb = rotations.exp(a), rotations.exp(b)
    whole = np.linalg.norm(rotations.difference(qb, qa))
    part = np.linalg.norm(rotations.difference(rotations.slerp(qa, qb, np.array(share)), qa))
    assert part == pytest.approx(share * whole, abs=1e-7)


@given(turns, turns)
def test_mean_of_a_turn_and_its_inverse_about_it_is_it(middle, off):
    small = 0.1 * off
    around = [rotations.multiply(rotations.exp(middle), rotations.exp(way)) for way in (small, -small)]
    for signed in (around, [around[0], -around[1]]):
        assert rotations.difference(rotations.mean(signed), rotations.exp(middle)) == pytest.approx(
            0.0, abs=1e-9
        )
