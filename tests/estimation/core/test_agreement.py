"""Estimates that share a prior: pooled they are one fit to all data, and differ as noise makes them."""

import numpy as np
import pytest

from amhe_cli.core.statistics import among, mean_within
from amhe_cli.estimation.core.agreement import agreement, beyond_chance, difference, exceeded, pooled

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


def rotated(d: int, seed: int) -> np.ndarray:
    """A random rotation (d, d)."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(d, d)))[0]


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


def test_a_difference_of_posteriors_has_the_covariance_of_its_equation() -> None:
    """C_i + C_j - C_i P C_j - C_j P C_i, from noise and pull of each."""
    _, (one, other), prior, *_ = beliefs(4, np.zeros((2, 3)))
    noise, pull = zip(*((c - c @ prior @ c, c @ prior) for c in (one, other)), strict=True)
    found = difference(noise, pull, np.linalg.inv(prior))
    np.testing.assert_allclose(found, one + other - one @ prior @ other - other @ prior @ one, atol=1e-12)
    assert found[2] == pytest.approx(np.zeros(3), abs=1e-12), "neither says anything of it"


def test_estimates_differ_as_the_equation_says_though_they_know_other_combinations() -> None:
    """One knows the first unknown, the other its sum with the second."""
    rng, prior, apart = np.random.default_rng(2), np.eye(2), []
    rows = np.array([[10.0, 0.0], [7.0, 7.0]])
    inverses = [np.linalg.inv(np.outer(row, row) + prior) for row in rows]
    noise = tuple(c @ np.outer(row, row) @ c for c, row in zip(inverses, rows, strict=True))
    expected = difference(noise, tuple(inverses), np.eye(2))  # type: ignore[arg-type]
    for truth in rng.normal(size=(4000, 2)):  # drawn from the prior
        estimates = [c @ row * (row @ truth + rng.normal()) for c, row in zip(inverses, rows, strict=True)]
        apart.append(estimates[0] - estimates[1])
    np.testing.assert_allclose(np.cov(np.array(apart).T), expected, rtol=0.1, atol=0.02)


@pytest.mark.parametrize("comparisons", [1, 10])
def test_what_exceeds_chance_begins_at_nothing_and_ends_at_all(comparisons: int) -> None:
    limit, sd = among(comparisons, 3.0), 0.2
    sizes = np.linspace(0.0, 40.0, 2000)
    kept = np.array([beyond_chance(np.array([s * sd]), np.array([[sd**2]]), comparisons)[0] for s in sizes])
    np.testing.assert_allclose(kept, sd * np.sqrt(np.maximum(sizes**2 - limit**2, 0.0)), atol=1e-12)
    # it rises as a root: sqrt(2 limit step) at most in one step, and no jump
    assert np.diff(kept).max() < 1.01 * sd * np.sqrt((2.0 * limit + sizes[1]) * sizes[1])
    assert not beyond_chance(np.array([5.0]), np.zeros((1, 1))).any(), "neither part says anything"


def test_one_that_drifts_is_found_among_many() -> None:
    rng, covariance = np.random.default_rng(0), 0.01 * (0.5 * np.eye(49) + 0.5)
    noise = np.linalg.cholesky(covariance) @ rng.normal(size=49)
    assert not beyond_chance(noise, covariance).any()
    noise[17] += 1.5
    kept = beyond_chance(noise, covariance)
    assert kept[17] == pytest.approx(1.5, rel=0.1)
    # the root of the correlation has the eigenvalues sqrt(0.5) and, along (1, ..., 1), sqrt(25)
    beside = (5.0 - np.sqrt(0.5)) / 49.0
    assert np.delete(kept, 17) == pytest.approx(kept[17] * beside / (np.sqrt(0.5) + beside))


def test_a_combination_that_is_known_is_found_among_unknown_factors() -> None:
    """The product is known to 0.01, its factors to 1; it differs by 0.2, which no factor would show."""
    covariance = np.array([[1.0, -1.0], [-1.0, 1.0]]) + 1e-4 * np.eye(2)
    kept = beyond_chance(np.array([0.1, 0.1]), covariance)
    # each of two independent coordinates is 10 sd off
    assert kept == pytest.approx(0.1 * np.sqrt(1.0 - (among(2, 3.0) / 10.0) ** 2), rel=1e-3)
    assert not beyond_chance(np.array([1.0, -1.0]), covariance).any(), "along the ridge it is chance"


def test_what_exceeds_chance_follows_units() -> None:
    """A parameter in other units differs as much."""
    rng = np.random.default_rng(1)
    roots, scale = rng.normal(size=(4, 4)), np.array([1.0, 1e-3, 50.0, 0.2])
    covariance, apart = roots @ roots.T, 12.0 * rng.normal(size=4)
    kept, scaled = (
        beyond_chance(apart, covariance),
        beyond_chance(scale * apart, covariance * np.outer(scale, scale)),
    )
    assert kept.any()
    np.testing.assert_allclose(scaled, scale * kept, rtol=1e-9)
