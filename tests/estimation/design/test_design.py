"""Optimal designs whose answer can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.estimation.design.design import accuracy, criterion, ensemble

PRIOR = np.eye(2)


def space(correlation: float = 0.0, names: str = "ab") -> ParameterSpace:
    parameters = tuple(Parameter(name, "-", 1.0, 0.01, 100.0, True, 0.5) for name in names)
    d = len(names)
    rows = np.eye(d) + correlation * (np.ones((d, d)) - np.eye(d))
    return ParameterSpace(parameters, tuple(map(tuple, rows.tolist())))


def information(*matrices: list[list[float]]) -> np.ndarray:
    """One draw of the information of several excitations."""
    return np.array([matrices], dtype=float)


def test_what_only_the_sum_tells_loses_to_what_tells_them_apart() -> None:
    ridge, apart = information([[50.0, 50.0], [50.0, 50.0]]), information([[20.0, 0.0], [0.0, 20.0]])
    assert criterion(ridge[:, 0], PRIOR) == pytest.approx(np.log(101.0))
    assert criterion(apart[:, 0], PRIOR) == pytest.approx(2.0 * np.log(21.0))


def test_the_draws_are_averaged() -> None:
    strong, weak, sure = 8.0 * np.eye(2), np.zeros((2, 2)), 3.0 * np.eye(2)
    at_times = criterion(np.stack((strong, weak)), PRIOR)  # it may tell nothing: (2 ln 9 + 0) / 2
    always = criterion(np.stack((sure, sure)), PRIOR)  # 2 ln 4
    assert at_times == pytest.approx(np.log(9.0))
    assert always > at_times


def test_the_ensemble_has_the_priors_spread() -> None:
    draws = ensemble(space(0.8), 200, np.random.default_rng(0))
    np.testing.assert_array_equal(draws[0], 0.0)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cov(draws[1:].T, bias=True), [[1.0, 0.8], [0.8, 1.0]], atol=0.1)


def test_accuracy_is_prior_and_data_together_in_shares_of_the_parameter() -> None:
    known = accuracy(space(), information([[3.0, 0.0], [0.0, 0.0]])[:, 0])
    np.testing.assert_allclose(known.sd, [0.25, 0.5])  # 0.5 / sqrt(1 + 3), and the prior's
