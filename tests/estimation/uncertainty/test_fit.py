"""The posterior of linear problems, whose covariance is known."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.agreement import difference
from amhe_cli.estimation.core.information import Information, information, marginalised
from amhe_cli.estimation.uncertainty.fit import doubled_prior, posterior

TRUTH = np.array([0.5, -0.3])


def linear(clips: int, noise: float = 1.0, seed: int = 0) -> Information:
    """Information at z = 0 of clips with residuals G (z - TRUTH) + noise, declared as noise of sd 1."""
    rng = np.random.default_rng(seed)
    gz = rng.standard_normal((clips, 2, 30)) * [[1.0], [0.3]]
    residual = noise * rng.standard_normal((clips, 30)) - np.einsum("d,cdr->cr", TRUTH, gz)
    nothing = np.zeros((clips, 0, 30)), np.zeros((clips, 0))
    return marginalised(residual, gz, nothing[0], np.ones((clips, 30)), nothing[1])


def least_squares(found: Information, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    hessian = found.matrix.sum(axis=0) + prior
    return -np.linalg.solve(hessian, found.score.sum(axis=0)), np.linalg.inv(hessian)


def test_the_estimate_is_that_of_regularised_least_squares() -> None:
    found, prior = linear(20), np.diag([1.0, 4.0])
    result = posterior(np.zeros(2), found, np.ones(20), prior)
    assert result.step == pytest.approx(least_squares(found, prior)[0])


def test_a_prior_of_twice_the_sd_weighs_a_quarter() -> None:
    """The estimate moves to that of least squares under such a prior of one parameter."""
    found, prior, z = linear(3), np.array([[40.0, 12.0], [12.0, 30.0]]), np.array([0.1, 0.2])
    own = posterior(z, found, np.ones(3), prior)
    fit: Any = SimpleNamespace(posterior=own, found=found, weight=np.ones(3), z=z)
    for i, wider in enumerate(([[10.0, 6.0], [6.0, 30.0]], [[40.0, 6.0], [6.0, 7.5]])):
        moved = posterior(z, found, np.ones(3), np.array(wider)).step[i] - own.step[i]
        assert doubled_prior(fit, np.ones(2, dtype=bool))[i] == pytest.approx(moved) and abs(moved) > 1e-3
    assert not doubled_prior(fit, np.zeros(2, dtype=bool)).any()


def test_under_white_noise_the_sandwich_is_the_inverse_of_the_information() -> None:
    found = linear(2000)
    result = posterior(np.zeros(2), found, np.ones(2000), np.eye(2))
    exact = least_squares(found, np.eye(2))[1]
    np.testing.assert_allclose(
        result.covariance, exact, rtol=0.1, atol=0.05 * np.sqrt(exact[0, 0] * exact[1, 1])
    )


def test_noise_of_twice_the_declared_sd_doubles_the_sd() -> None:
    plain, loud = (posterior(np.zeros(2), linear(2000, n), np.ones(2000), np.eye(2)) for n in (1.0, 2.0))
    assert loud.sd / plain.sd == pytest.approx(2.0, rel=0.1)


def test_with_few_clips_the_declared_noise_counts_for_more_than_their_scatter() -> None:
    few = posterior(np.zeros(2), linear(3, noise=0.0), np.ones(3), np.eye(2))
    white = np.linalg.inv(few.hessian)
    assert (few.sd > 0.8 * np.sqrt(np.diag(white))).all(), "no scatter is no proof of no noise"
    many = posterior(np.zeros(2), linear(1000, noise=0.0), np.ones(1000), np.eye(2))
    assert (many.sd < 0.3 * np.sqrt(np.diag(np.linalg.inv(many.hessian)))).all()


def test_the_sd_is_the_spread_of_estimates_over_data() -> None:
    results = [
        posterior(np.zeros(2), linear(60, 1.5, seed), np.ones(60), 1e-9 * np.eye(2)) for seed in range(200)
    ]
    spread = np.std([result.step for result in results], axis=0)
    # clips are few enough for the declared noise of 1 to hold a seventh of the weight
    assert np.mean([result.sd for result in results], axis=0) / spread == pytest.approx(0.95, abs=0.15)


def test_a_clip_of_weight_zero_is_left_out() -> None:
    found, weight = linear(10), np.ones(10)
    weight[7:] = 0.0
    part = Information(*(getattr(found, name)[:7] for name in Information.__slots__))
    left, alone = (posterior(np.zeros(2), f, w, np.eye(2)) for f, w in ((found, weight), (part, np.ones(7))))
    assert left.step == pytest.approx(alone.step)
    np.testing.assert_allclose(left.covariance, alone.covariance)


def test_independent_data_disagree_by_no_more_than_their_sd_says() -> None:
    ratios = []
    for seed in range(150):
        one, other = (
            posterior(np.zeros(2), linear(60, seed=s), np.ones(60), np.eye(2))
            for s in (2 * seed, 2 * seed + 1)
        )
        chance = difference((one.noise, other.noise), (one.pull, other.pull), np.eye(2))
        ratios.append((one.step - other.step) / np.sqrt(chance.diagonal()))
    assert np.std(ratios, axis=0) == pytest.approx(1.0, abs=0.15)


@pytest.mark.medium
@pytest.mark.parametrize("width", [1, 6])
def test_estimates_under_a_robust_loss_scatter_as_their_covariance_says(width: int) -> None:
    """With few clips, errors of their own, and a loss that counts the norm of so many columns."""
    unknowns, clips, samples, errors = 4, 12, 40, []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        gz, gx = (rng.standard_normal((clips, n, samples * width)) for n in (unknowns, 2))
        noise = rng.standard_normal((clips, samples * width))
        noise += np.einsum("cx,cxr->cr", rng.standard_normal((clips, 2)), gx)
        observed = SimpleNamespace(mask=np.ones((clips, samples), dtype=bool), width=width)
        cost = SimpleNamespace(
            clips=SimpleNamespace(observed=[observed]), settings=SimpleNamespace(huber=3.0)
        )
        z, nothing = np.zeros(unknowns), np.zeros((unknowns, unknowns))
        for _ in range(4):
            slopes: Any = SimpleNamespace(
                cost=cost, residual=noise + np.einsum("d,cdr->cr", z, gz),
                gain=np.concatenate((gz, gx), axis=1), bend=0.0,
                first=SimpleNamespace(mean=np.zeros((clips, 2))), completed=np.ones(clips, dtype=bool),
            )  # fmt: skip
            result = posterior(z, information(slopes), np.ones(clips), nothing)
            z = z + result.step
        errors.append(z @ np.linalg.solve(result.covariance, z) / unknowns)
    assert np.mean(errors) == pytest.approx(1.0, abs=0.1)
