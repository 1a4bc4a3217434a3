"""What is added beyond noise: each direction gets its variance, and what is known together stays known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.statistics import correlation
from amhe_cli.estimation.core.information import information, marginalised
from amhe_cli.estimation.offline.posterior import Disagreement, posterior
from amhe_cli.estimation.offline.widening import (
    along_vectors,
    beyond_chance,
    contradicted,
    directions,
    in_directions,
    repeated,
    scattered,
    variances,
)

ALL = np.ones(2, dtype=bool)
NONE = np.zeros((2, 2))


def known(slopes: FloatArray) -> FloatArray:
    """Posterior covariance of two log parameters, prior sd 0.5, from residuals of slopes (2, R)."""
    scaled = 0.5 * slopes[None]
    nothing = np.zeros((1, 0, slopes.shape[1])), np.zeros((1, 0))
    found = marginalised(np.zeros((1, slopes.shape[1])), scaled, nothing[0], np.ones((1, 1)), nothing[1])
    return np.asarray(np.linalg.inv(posterior(np.zeros(2), found, np.ones(1), np.eye(2)).hessian), float)


def quadrotor() -> FloatArray:
    """Mass and thrust: a = k u / m - g, measured 500 times to 0.02 m/s^2."""
    thrust = 10.0 + 3.0 * np.sin(np.arange(500))
    return known(np.stack((-thrust, thrust)) / 0.02)


def pushed_box() -> FloatArray:
    """Mass and friction: F = m a + mu m g of a push that is nearly steady, measured 500 times to 0.2 N."""
    pulled, slowed = 4.0 * 0.1 * np.sin(np.arange(500)), np.full(500, 4.0 * 0.6 * 9.81)
    return known(np.stack((pulled + slowed, slowed)) / 0.2)


def sharp(covariance: FloatArray) -> tuple[float, FloatArray]:
    """Sd of the combination of two parameters that is known best, and its exponents."""
    values, vectors = np.linalg.eigh(covariance)
    return float(np.sqrt(values[0])), vectors[:, 0] / vectors[0, 0]


@pytest.mark.parametrize(("case", "exponent"), [(quadrotor, -1.0), (pushed_box, 1.0)])
@pytest.mark.parametrize("wrong", [0, 1])
def test_an_error_of_one_factor_leaves_the_combination_known(case, exponent, wrong):
    own = case()
    found = directions(own, ALL)
    assert len(found.rows) == 3, "two parameters, and what is known of both"
    wanted = np.zeros(3)
    wanted[wrong] = own[wrong, wrong]
    total = own + in_directions(found, wanted, NONE)
    assert np.diag(total)[wrong] == pytest.approx(2.0 * own[wrong, wrong])
    assert sharp(total)[0] == pytest.approx(sharp(own)[0], rel=0.01)
    assert sharp(total)[1] == pytest.approx([1.0, exponent], abs=0.02)


def test_a_contradiction_about_the_combination_widens_it_and_not_its_factors():
    own = pushed_box()
    found = directions(own, ALL)
    size, (_, exponent) = sharp(own)
    against = 20.0 * size * np.array([1.0, exponent]) / np.hypot(1.0, exponent)
    wanted = contradicted(found.rows, [Disagreement(against, 2.0 * own)])
    total = own + in_directions(found, wanted, NONE)
    assert sharp(total)[0] == pytest.approx(10.0 * size, rel=0.1)
    assert np.diag(total) == pytest.approx(np.diag(own), rel=0.05)


def test_contradictions_count_beyond_three_sd_and_by_half():
    rows, covariance = np.eye(2), np.diag([0.01, 0.01])
    within, beyond = (Disagreement(np.array([d, 0.0]), covariance) for d in (0.29, 0.5))
    assert contradicted(rows, [within]) == pytest.approx(0.0)
    assert contradicted(rows, [beyond, within]) == pytest.approx([0.25 * (0.25 - 0.09), 0.0])


def test_parts_that_disagree_again_and_again_widen_by_all_of_it():
    difference = Disagreement(np.array([0.5, 0.0]), 1e-4 * np.eye(2), share=1.0)
    assert contradicted(np.eye(2), [difference]) == pytest.approx([0.25 - 9e-4, 0.0])


def test_a_bootstrap_counts_where_it_is_wider_than_its_own_scatter():
    rows, noise = np.eye(2), 0.044**2 * np.eye(2)
    steps = np.random.default_rng(0).standard_normal((2000, 2))
    assert not scattered(rows, 1.15 * 0.044 * steps, noise).any()
    wider = scattered(rows, steps * [0.11, 0.044], noise)
    assert np.sqrt(noise.diagonal() + wider) == pytest.approx([0.106, 0.044], rel=0.05)
    lost = np.where(np.arange(2000)[:, None] % 10, 0.044, 4.4) * steps
    assert not scattered(rows, lost, noise).any(), "a tenth of the resamples misses what is informative"
    assert not scattered(rows, np.full((1, 2), np.nan), noise).any(), "none was computed"


def test_what_is_not_known_together_does_not_follow():
    own = 0.01 * np.array([[1.0, 0.5], [0.5, 1.0]])
    found = directions(own, ALL)
    assert len(found.rows) == 2
    added = in_directions(found, np.array([0.25, 0.01]), NONE)
    np.testing.assert_allclose(added, np.diag([0.25, 0.01]), atol=1e-12)


def test_a_parameter_without_data_is_not_widened():
    found = directions(np.diag([0.01, 1.0]), np.array([True, False]))
    assert in_directions(found, np.array([0.04]), NONE)[1] == pytest.approx([0.0, 0.0])


def test_each_direction_gets_what_it_lacks_and_shares_what_others_bring():
    own = pushed_box()
    found = directions(own, ALL)
    wanted = 0.3 * found.known
    wanted[2] = 0.0
    added = in_directions(found, wanted, NONE)
    assert (variances(found.rows, added) >= wanted - 1e-12).all()
    assert np.diag(added) == pytest.approx(wanted[:2], rel=0.05), "once, not once for each factor"


def test_a_shift_adds_its_own_direction():
    own, shift = np.diag([0.01, 0.04]), np.array([0.5, -0.3])
    added = along_vectors(own, [shift])
    np.testing.assert_allclose(added, np.outer(shift, shift))
    both = along_vectors(own, [-0.7 * shift, shift])
    np.testing.assert_allclose(both, added, err_msg="to and fro on one line, the larger counts")
    across = np.array([0.3, 0.5])
    total = along_vectors(own, [shift, across])
    assert (np.linalg.eigvalsh(total - np.outer(across, across)) > -0.01).all()
    assert np.trace(total) == pytest.approx(shift @ shift + across @ across, rel=0.1)
    assert not along_vectors(own, [np.zeros(2)]).any()


def test_a_shift_counts_beyond_three_sd():
    own = np.diag([0.01, 0.04])
    assert not beyond_chance(own, np.array([0.29, 0.0])).any()
    assert beyond_chance(own, np.array([0.5, 0.0])) == pytest.approx([np.sqrt(0.25 - 0.09), 0.0])
    far = beyond_chance(own, np.array([50.0, 20.0]))
    assert far == pytest.approx([50.0, 20.0], rel=1e-4), "along the shift itself"


def test_directions_grow_no_correlation_of_their_own():
    own = np.diag([0.01, 0.04])
    total = own + in_directions(directions(own, ALL), np.array([0.3, 0.2]), NONE)
    np.testing.assert_allclose(correlation(total), np.eye(2), atol=1e-12)


def fit_of(residual: FloatArray) -> Any:
    """A final fit of one parameter that moves every residual (c, R) alike, prior sd 1."""
    clips, samples = residual.shape
    observed = SimpleNamespace(mask=np.ones((clips, samples), dtype=bool), width=1)
    cost = SimpleNamespace(clips=SimpleNamespace(observed=[observed]), settings=SimpleNamespace(huber=100.0))
    first = SimpleNamespace(mean=np.zeros((clips, 0)))
    slopes: Any = SimpleNamespace(
        cost=cost,
        residual=residual,
        gain=np.ones((clips, 1, samples)),
        bend=np.zeros_like(residual),
        first=first,
        completed=np.ones(clips, dtype=bool),
    )
    weight = np.ones(clips)
    found = posterior(np.zeros(1), information(slopes), weight, np.eye(1))
    return SimpleNamespace(slopes=slopes, weight=weight, posterior=found)


def test_errors_that_repeat_count_once_for_all_clips():
    rng = np.random.default_rng(0)
    slow = np.sin(np.arange(60) / 20.0 + rng.uniform(0.0, 6.0, (12, 1))) + 0.1 * rng.standard_normal((12, 60))
    one, twelve = (float(repeated(fit_of(r), np.eye(1))[0, 0]) for r in (slow[:1], slow))
    information_of_twelve = float(fit_of(slow).posterior.hessian[0, 0]) - 1.0
    left = 1.0 / (twelve + 1.0 / (information_of_twelve + 1.0)) - 1.0
    assert one == pytest.approx(0.0, abs=0.01), "one clip is what it counts for"
    assert left == pytest.approx(information_of_twelve / 12.0, rel=0.15), "twelve know no more than one"


def test_white_residuals_add_nothing():
    fit = fit_of(np.random.default_rng(1).standard_normal((12, 60)))
    assert repeated(fit, np.eye(1))[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_what_repeats_leaves_no_less_than_the_prior_that_it_is_judged_under():
    fit = fit_of(np.repeat(np.sin(np.arange(60) / 20.0)[None], 12, axis=0) * 1e3)
    assert 0.0 < 1.0 / fit.posterior.hessian[0, 0] + repeated(fit, np.eye(1))[0, 0] <= 1.0
