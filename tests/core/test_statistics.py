"""Losses, trimming and autocorrelation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core import statistics


@given(st.floats(0.0, 1e6), st.floats(0.5, 10.0))
def test_pseudo_huber_lies_between_nothing_and_the_square(squared, delta):
    loss = statistics.pseudo_huber(np.array(squared), delta)
    assert 0.0 <= loss <= squared * (1.0 + 1e-9)


def test_pseudo_huber_is_square_near_zero_and_linear_far_out():
    assert statistics.pseudo_huber(np.array(1e-4), 3.0) == pytest.approx(1e-4, rel=1e-3)
    far = statistics.pseudo_huber(np.array([1e8, 4e8]), 3.0)
    assert far[1] / far[0] == pytest.approx(2.0, rel=1e-2)


def test_the_weight_is_the_slope_of_the_loss():
    s, h = np.array(5.0), 1e-6
    slope = (statistics.pseudo_huber(s + h, 2.0) - statistics.pseudo_huber(s - h, 2.0)) / (2 * h)
    assert statistics.pseudo_huber_weight(s, 2.0) == pytest.approx(slope, rel=1e-6)


def test_trimming_drops_the_worst_and_only_those():
    costs = np.array([[1.0, 2.0, np.inf, 3.0], [np.inf, 2.0, np.inf, 3.0]])
    trimmed = statistics.trimmed_mean(costs, 0.25)
    assert trimmed[0] == 2.0
    assert np.isinf(trimmed[1])


def test_autocorrelation_time_of_white_and_of_red_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(20, 4000))
    red = np.zeros_like(white)
    for t in range(1, 4000):
        red[:, t] = 0.8 * red[:, t - 1] + white[:, t]
    assert statistics.autocorrelation_time(white) == pytest.approx(1.0, abs=0.05)
    assert statistics.autocorrelation_time(red) == pytest.approx(9.0, rel=0.15)  # (1 + 0.8) / (1 - 0.8)


def test_white_noise_is_measured_on_top_of_motion():
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 5.0, 1000)[:, None]
    assert statistics.white_noise_sd(np.sin(3 * time) + rng.normal(0, 0.01, (1000, 1))) == pytest.approx(
        0.01, rel=0.15
    )


def test_among_many_numbers_one_must_be_farther_out_to_surprise():
    assert statistics.among(1, 3.0) == pytest.approx(3.0)
    limit = statistics.among(49, 2.0)  # one of 44 logs of one parameter, so one of 44 logs of 49
    beyond = (np.abs(np.random.default_rng(0).standard_normal((20_000, 49))) > limit).any(axis=1).mean()
    assert beyond == pytest.approx(0.0455, abs=0.006)


@pytest.mark.parametrize(("freedom", "square"), [(1, 9.0), (2, 11.829), (10, 26.90), (98, 141.5)])
def test_a_chi_square_value_is_an_sd_of_one_number_that_is_as_unlikely(freedom: int, square: float) -> None:
    """Each of these is exceeded with the probability of 3 sd, 0.27 %."""
    assert statistics.sd_of_one(square, freedom) == pytest.approx(3.0, abs=0.05)


def test_one_number_keeps_its_sd_and_what_is_no_surprise_has_none() -> None:
    assert [statistics.sd_of_one(x**2, 1.0) for x in (0.0, 0.5, 3.0, 12.0)] == pytest.approx(
        [0.0, 0.5, 3.0, 12.0]
    )
    assert statistics.sd_of_one(30.0, 98.0) == 0.0
