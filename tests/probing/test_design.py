"""Optimal designs whose answer can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.probing.design import accuracy, best_counts, best_product, criterion, ensemble, spread_out

PRIOR = np.eye(2)


def space(correlation: float = 0.0, names: str = "ab") -> ParameterSpace:
    parameters = tuple(Parameter(name, "-", 1.0, 0.01, 100.0, True, 0.5) for name in names)
    d = len(names)
    rows = np.eye(d) + correlation * (np.ones((d, d)) - np.eye(d))
    return ParameterSpace(parameters, tuple(map(tuple, rows.tolist())))


def told(*matrices: list[list[float]]) -> np.ndarray:
    """One draw of the information of several excitations."""
    return np.array([matrices], dtype=float)


def test_an_excitation_that_tells_more_is_chosen() -> None:
    much, little = [[5.0, 0.0], [0.0, 5.0]], [[1.0, 0.0], [0.0, 1.0]]
    counts = best_counts(told(little, much), np.array([1.0, 1.0]), PRIOR, 4.0)
    np.testing.assert_array_equal(counts, [0, 4])


def test_two_that_tell_of_one_parameter_each_are_mixed() -> None:
    first, second = [[9.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 9.0]]
    counts = best_counts(told(first, second), np.array([1.0, 1.0]), PRIOR, 6.0)
    np.testing.assert_array_equal(counts, [3, 3])  # (1 + 9 n)(1 + 9 (6 - n)) is largest at n = 3


def test_what_only_the_sum_tells_loses_to_what_tells_them_apart() -> None:
    ridge, apart = [[50.0, 50.0], [50.0, 50.0]], [[20.0, 0.0], [0.0, 20.0]]
    counts = best_counts(told(ridge, apart), np.array([1.0, 1.0]), PRIOR, 2.0)
    # log det: two ridges 5.3, one of each 7.53, two of the other 7.43
    np.testing.assert_array_equal(counts, [1, 1])


def test_the_draws_are_averaged() -> None:
    strong, weak = [[8.0, 0.0], [0.0, 8.0]], [[0.0, 0.0], [0.0, 0.0]]
    sure = [[3.0, 0.0], [0.0, 3.0]]
    information = np.concatenate((told(strong, sure), told(weak, sure)))  # the first may tell nothing
    counts = best_counts(information, np.array([1.0, 1.0]), PRIOR, 1.0)
    np.testing.assert_array_equal(counts, [0, 1])  # 2 ln 4 = 2.77 against (2 ln 9 + 0) / 2 = 2.20


@pytest.mark.parametrize("limit", [0.0, 0.9, 1.0, 3.7, 10.0])
def test_the_time_is_never_exceeded_and_never_left_unused(limit: float) -> None:
    rng = np.random.default_rng(3)
    roots = rng.standard_normal((2, 4, 3, 3))
    information = roots @ roots.swapaxes(-1, -2)
    seconds = np.array([1.0, 1.5, 2.0, 0.9])
    counts = best_counts(information, seconds, np.eye(3), limit)
    assert counts.min() >= 0
    assert counts @ seconds <= limit + 1e-9
    assert limit - counts @ seconds < seconds.min()


def test_no_sequence_of_the_same_length_is_better_than_the_one_found() -> None:
    rng = np.random.default_rng(4)
    roots = rng.standard_normal((2, 3, 3, 2))  # each tells of two directions of three
    information = roots @ roots.swapaxes(-1, -2)
    counts = best_counts(information, np.ones(3), np.eye(3), 4.0)

    def value(n: np.ndarray) -> float:
        return criterion(np.einsum("n,enij->eij", n.astype(float), information), np.eye(3))

    every = [np.array([i, j, 4 - i - j]) for i in range(5) for j in range(5 - i)]
    assert value(counts) == pytest.approx(max(map(value, every)))


def test_equal_excitations_are_kept_apart() -> None:
    assert spread_out(np.array([2, 1])) == [0, 1, 0]
    assert sorted(spread_out(np.array([3, 0, 2]))) == [0, 0, 0, 2, 2]


def test_the_ensemble_has_the_priors_spread() -> None:
    draws = ensemble(space(0.8), 200, np.random.default_rng(0))
    np.testing.assert_array_equal(draws[0], 0.0)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cov(draws[1:].T, bias=True), [[1.0, 0.8], [0.8, 1.0]], atol=0.1)


def test_accuracy_is_prior_and_data_together_in_shares_of_the_parameter() -> None:
    known = accuracy(space(), told([[3.0, 0.0], [0.0, 0.0]])[:, 0])
    np.testing.assert_allclose(known.sd, [0.25, 0.5])  # 0.5 / sqrt(1 + 3), and the prior's


def test_what_is_known_together_is_the_product_along_the_ridge() -> None:
    ridge = accuracy(
        space(names="abc"), told([[900.0, 900.0, 0.0], [900.0, 900.0, 0.0], [0.0, 0.0, 1.0]])[:, 0]
    )
    powers = best_product(ridge)
    assert powers is not None
    np.testing.assert_array_equal(powers, [1.0, 1.0, 0.0])
    assert ridge.sd_along(powers) < 0.1 * ridge.sd[0]


def test_independent_parameters_are_not_known_together() -> None:
    assert best_product(accuracy(space(), told([[3.0, 0.0], [0.0, 3.0]])[:, 0])) is None
