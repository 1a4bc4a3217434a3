"""Draws by annealing: Gaussians whose moments are known, a bent ridge, two minima."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.estimation.core.annealed import draw

WIDE = 50.0


def within(d: int) -> tuple[np.ndarray, np.ndarray]:
    return np.full(d, -WIDE), np.full(d, WIDE)


@pytest.mark.parametrize("d", [1, 4, 12])
def test_draws_of_a_linear_problem_have_its_mean_and_covariance(d: int) -> None:
    """The likelihood is that of linear residuals: the posterior is Gaussian."""
    rng = np.random.default_rng(d)
    slopes, truth = rng.normal(size=(3 * d, d)) / 0.3, rng.normal(size=d)
    hessian = slopes.T @ slopes + np.eye(d)
    mean, covariance = np.linalg.solve(hessian, slopes.T @ slopes @ truth), np.linalg.inv(hessian)
    found = draw(
        lambda z: -0.5 * (((z - truth) @ slopes.T) ** 2).sum(axis=1), np.eye(d), within(d), 1000, rng
    )
    assert found.effective > 800
    white = (found.z - mean) @ np.linalg.cholesky(np.linalg.inv(covariance))
    assert np.abs(white.mean(axis=0)).max() < 4.0 / np.sqrt(found.effective)
    assert np.abs(white.std(axis=0) - 1.0).max() < 4.0 / np.sqrt(2.0 * found.effective)


def test_what_is_known_only_by_a_product_follows_the_hyperbola() -> None:
    def likelihood(z: np.ndarray) -> np.ndarray:
        return -0.5 * (((1.0 + 0.5 * z[:, 0]) * (1.0 + 0.5 * z[:, 1]) - 1.0) / 0.05) ** 2

    bounds = np.full(2, -1.8), np.full(2, 4.0)
    found = draw(likelihood, np.eye(2), bounds, 1000, np.random.default_rng(0))
    one, other = np.linspace(-1.8, 4.0, 600), np.linspace(-1.8, 4.0, 6000)
    grid = np.stack(np.meshgrid(one, other, indexing="ij"), axis=-1).reshape(-1, 2)
    density = np.exp(likelihood(grid) - 0.5 * (grid**2).sum(axis=1)).reshape(600, 6000).sum(axis=1)
    share = np.cumsum(density) / density.sum()
    exact = [float(one[np.searchsorted(share, q)]) for q in (0.05, 0.5, 0.95)]
    assert exact[0] > -0.85 and exact[2] > 1.25, "a Gaussian of the slopes at 0 gives -1.17 to 1.17"
    assert np.quantile(found.z[:, 0], (0.05, 0.5, 0.95)) == pytest.approx(exact, abs=0.12)


def test_both_of_two_minima_are_drawn() -> None:
    found = draw(
        lambda z: -0.5 * ((z[:, 0] ** 2 - 1.0) / 0.02) ** 2, np.eye(1), within(1), 1000,
        np.random.default_rng(0),
    )  # fmt: skip
    assert 0.4 < (found.z > 0.0).mean() < 0.6
    np.testing.assert_allclose(np.abs(found.z), 1.0, atol=0.06)


def test_draws_stay_within_bounds_and_away_from_where_rollouts_diverge() -> None:
    def likelihood(z: np.ndarray) -> np.ndarray:
        assert (np.abs(z) <= 1.0).all(), "nothing is evaluated beyond the bounds"
        return np.where(z[:, 0] > 0.5, -np.inf, 0.0)

    found = draw(likelihood, np.eye(2), (-np.ones(2), np.ones(2)), 500, np.random.default_rng(0))
    assert found.z[:, 0].max() <= 0.5
    assert found.effective > 300


def test_draws_under_a_cost_that_jitters_are_worth_little() -> None:
    """Each place has a misfit of its own, as behind chaotic contacts: the lowest that is found is kept."""

    def jagged(z: np.ndarray) -> np.ndarray:
        waves = np.sin(1e6 * z.sum(axis=1)[:, None] * np.sqrt(np.arange(2.0, 22.0)))
        return -0.5 * (z / 0.1) ** 2 @ np.ones(2) + 5.0 * waves.sum(axis=1)

    found = draw(jagged, np.eye(2), within(2), 500, np.random.default_rng(0))
    assert found.effective < 0.3 * 500


def test_a_likelihood_that_is_zero_everywhere_has_no_draws() -> None:
    found = draw(lambda z: np.full(len(z), -np.inf), np.eye(2), within(2), 100, np.random.default_rng(0))
    assert found.effective == 0.0
