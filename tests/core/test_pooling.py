"""Pooling: what one fit to all data says, and differences as large as noise makes them."""

import numpy as np
import pytest

from amhe_cli.core.pooling import agreement, exceeded, pooled
from amhe_cli.core.statistics import mean_within

UNBOUNDED = np.full(3, -np.inf), np.full(3, np.inf)


def beliefs(seed: int, shifts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Posteriors of linear data of each run about the same three unknowns; the third is not in the data.

    Args:
        seed: Seed of the noise.
        shifts: What each run adds to the unknowns, shape (k, 3).

    Returns:
        Means, covariances, prior precision, and the sums of information and score over all data.
    """
    rng = np.random.default_rng(seed)
    prior = np.linalg.inv(np.array([[1.0, 0.3, 0.0], [0.3, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    truth = np.array([0.4, -0.7, 1.2])
    means, covariances, information, score = [], [], np.zeros((3, 3)), np.zeros(3)
    for shift in shifts:
        slopes = rng.normal(size=(20, 3)) * np.array([3.0, 1.0, 0.0])
        data = slopes @ (truth + shift) + rng.normal(size=20)
        covariance = np.linalg.inv(slopes.T @ slopes + prior)
        means.append(covariance @ slopes.T @ data)
        covariances.append(covariance)
        information += slopes.T @ slopes
        score += slopes.T @ data
    return np.array(means), np.array(covariances), prior, information, score


def test_pooling_is_the_fit_to_all_data() -> None:
    means, covariances, prior, information, score = beliefs(0, np.zeros((4, 3)))
    mean, covariance, shared = pooled(means, covariances, np.zeros((4, 3, 3)), np.zeros(3), prior, UNBOUNDED)
    np.testing.assert_allclose(covariance, np.linalg.inv(information + prior), atol=1e-9)
    np.testing.assert_allclose(mean, covariance @ score, atol=1e-9)
    np.testing.assert_array_equal(shared, 0.0)


def test_what_comes_from_the_model_is_not_narrowed_by_more_runs() -> None:
    """All runs measure x + b with a common b ~ N(0, 0.1^2), and a weak prior."""
    rng, noise, runs = np.random.default_rng(1), 0.02, 9
    bounds = np.full(1, -np.inf), np.full(1, np.inf)
    prior, systematic = np.array([[0.01]]), np.full((runs, 1, 1), 0.01)
    covariances = np.full((runs, 1, 1), 1.0 / (noise**-2 + 0.01)) + systematic
    errors = []
    for _ in range(400):
        means = rng.normal(0.0, 0.1) + noise * rng.standard_normal((runs, 1))
        mean, covariance, shared = pooled(means, covariances, systematic, np.zeros(1), prior, bounds)
        errors.append(mean[0] / np.sqrt(covariance[0, 0]))
    assert np.std(errors) == pytest.approx(1.0, abs=0.1)
    assert covariance[0, 0] == pytest.approx(0.01 + noise**2 / runs, rel=1e-3)
    assert shared[0, 0] == pytest.approx(0.01, rel=1e-3)


def test_a_pooled_belief_can_be_pooled_again() -> None:
    """Two and two runs are as good as four at once."""
    means, covariances, prior, *_ = beliefs(3, np.zeros((4, 3)))
    systematic = np.tile(0.05 * np.diag([1.0, 2.0, 0.0]), (4, 1, 1))
    runs = (means, covariances + systematic, systematic)

    def of(one: np.ndarray, other: np.ndarray, third: np.ndarray) -> tuple[np.ndarray, ...]:
        return pooled(one, other, third, np.zeros(3), prior, UNBOUNDED)

    halves = [of(*(each[rows] for each in runs)) for rows in (slice(0, 2), slice(2, 4))]
    both = of(*(np.array(each) for each in zip(*halves, strict=True)))
    once = of(*runs)
    assert (np.abs(both[0] - once[0]) < 0.3 * np.sqrt(once[1].diagonal())).all()
    for twice, at_once in zip(both[1:], once[1:], strict=True):
        np.testing.assert_allclose(twice, at_once, rtol=0.1, atol=0.01)


def test_a_run_that_rests_on_the_model_does_not_widen_one_that_hardly_does() -> None:
    """Less noise is worth nothing where the model's error is five times that of the other run."""
    systematic = np.array([[[0.1**2]], [[0.5**2]]])
    covariances = systematic + np.array([[[0.01**2]], [[0.005**2]]])
    bounds = np.full(1, -np.inf), np.full(1, np.inf)
    means = np.array([[0.3], [-0.4]])
    mean, covariance, _ = pooled(means, covariances, systematic, np.zeros(1), np.array([[1e-4]]), bounds)
    assert mean[0] == pytest.approx(0.27, abs=0.02)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(0.116, abs=0.005)


@pytest.mark.parametrize("seed", range(40))
def test_the_mean_within_bounds_is_where_the_density_is_highest(seed: int) -> None:
    """No value that stands inside is pulled, and none on a bound is pulled inwards."""
    rng, d = np.random.default_rng(seed), int(2 + seed % 12)
    roots = rng.normal(size=(d, d + 2))
    covariance, mean = roots @ roots.T, 2.0 * rng.normal(size=d)
    low, high = -rng.uniform(0.1, 2.0, d), rng.uniform(0.1, 2.0, d)
    found = mean_within(mean, covariance, (low, high))
    assert ((low <= found) & (found <= high)).all()
    pull = np.linalg.solve(covariance, mean - found)
    assert (pull[found < high - 1e-9] < 1e-7).all() and (pull[found > low + 1e-9] > -1e-7).all()


def test_chi_square_is_that_of_noise() -> None:
    found = []
    for seed in range(200):
        means, covariances, prior, *_ = beliefs(seed, np.zeros((3, 3)))
        found.append(agreement(means, covariances, prior))
    assert {one.freedom for one in found} == {4}  # two unknowns, two differences; the third is the prior's
    assert np.mean([one.chi_square for one in found]) == pytest.approx(4.0, abs=0.5)
    assert np.mean([one.chance < 0.1 for one in found]) == pytest.approx(0.1, abs=0.06)


def test_the_run_that_differs_is_named() -> None:
    shifts = np.zeros((3, 3))
    shifts[1, 0] = 1.0
    means, covariances, prior, *_ = beliefs(5, shifts)
    found = agreement(means, covariances, prior)
    assert found.chance < 1e-4
    one, other, size = found.farthest(0)
    assert 1 in (one, other)
    assert size > 5.0
    assert found.farthest(2)[2] == 0.0


@pytest.mark.parametrize(
    ("value", "freedom", "share"), [(3.841, 1, 0.05), (11.07, 5, 0.05), (23.21, 10, 0.01)]
)
def test_tail_of_chi_square(value: float, freedom: int, share: float) -> None:
    assert exceeded(value, freedom) == pytest.approx(share, abs=0.003)


def test_a_mean_beyond_a_bound_stands_on_it_and_others_follow() -> None:
    covariance = np.array([[4.0, 3.0], [3.0, 9.0]])
    low, high = np.array([-1.0, -5.0]), np.array([1.0, 5.0])
    found = mean_within(np.array([2.0, 1.0]), covariance, (low, high))
    np.testing.assert_allclose(found, [1.0, 1.0 - 3.0 / 4.0])
    np.testing.assert_array_equal(mean_within(np.zeros(2), covariance, (low, high)), 0.0)
    # what would leave its bound by itself does not where it follows the other
    coupled = np.array([[1.0, 0.6], [0.6, 1.0]])
    above = np.zeros(2), np.full(2, np.inf)
    np.testing.assert_allclose(mean_within(np.array([-1.0, -0.1]), coupled, above), [0.0, 0.5])
    # the second follows the first beyond its own bound, and is held there
    np.testing.assert_allclose(mean_within(np.array([9.0, -2.0]), covariance, (low, high)), [1.0, -5.0])
