"""Where feet land: by the capture point, and only while they fly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.robots.go1.behaviours.gait import Gait, neutral_feet, walk
from amhe_cli.robots.go1.behaviours.walking import Stepping

STANDS = np.array([True, False, False, True])


def after(stepping: Stepping, drift: float, steps: int = 20) -> np.ndarray:
    for k in range(steps):
        left = stepping.update(0.02 * k, drift, STANDS)
    return left


def test_a_flying_foot_goes_to_the_side_of_the_drift_and_a_standing_one_stays() -> None:
    left = after(Stepping(gain=0.1), 0.3)
    np.testing.assert_allclose(left[~STANDS], 0.03, rtol=1e-3)
    np.testing.assert_array_equal(left[STANDS], 0.0)


def test_what_a_foot_landed_with_it_keeps() -> None:
    stepping = Stepping(gain=0.1)
    landed = after(stepping, 0.3)
    later = stepping.update(0.5, -0.3, np.ones(4, dtype=bool))
    np.testing.assert_array_equal(later, landed)


@given(st.floats(-50.0, 50.0))
def test_never_further_than_the_limit(drift: float) -> None:
    stepping = Stepping()
    assert np.abs(after(stepping, drift)).max() <= stepping.limit


def test_the_gait_puts_its_feet_there() -> None:
    gait, left = Gait(), np.array([0.0, 0.02, -0.01, 0.05])
    there, neutral = walk(gait, 0.1, np.zeros(3), left=left), walk(gait, 0.1, np.zeros(3))
    np.testing.assert_allclose(there.feet - neutral.feet, np.outer(left, [0.0, 1.0, 0.0]), atol=1e-12)
    assert neutral_feet(gait)[1, 1] == pytest.approx(neutral.feet[1, 1])
