"""Multisines within their limits."""

from __future__ import annotations

import numpy as np

from amhe_cli.estimation.design.excitation import candidates, slow_sine

REST, LOWER, UPPER = np.array([0.0, 1.0]), np.array([-3.0, 0.0]), np.array([3.0, 1.5])


def test_a_multisine_fades_in_from_rest_and_stays_within_the_limits() -> None:
    times = np.linspace(0.0, 30.0, 3001)
    for one in (slow_sine(REST, LOWER, UPPER), *candidates(REST, LOWER, UPPER, 5, np.random.default_rng(0))):
        controls = one.at(times)
        np.testing.assert_allclose(controls[0], REST)
        assert (controls > LOWER).all()
        assert (controls < UPPER).all()
        assert np.ptp(controls, axis=0).min() > 0.05


def test_a_seed_gives_the_same_candidates_and_another_gives_others() -> None:
    first, again, other = (candidates(REST, LOWER, UPPER, 1, np.random.default_rng(s))[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first.size, again.size)
    assert not np.allclose(first.size, other.size)
