"""Residuals regressed on samples: what the samples' place and shape may not change, and what they must."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates, Linearisation, linearise
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.matching.cost import MatchingCost
from tests.estimation.conftest import TRUTH


@pytest.fixture(scope="module")
def cost(pendulum, swing) -> MatchingCost:
    windows = ClipPool(pendulum, [whole(swing(3.0))], pendulum.settings.clips).cut(0.5)
    engine = open_engine(pendulum)
    return MatchingCost(pendulum, windows, engine, pendulum.settings.cost)


def about(
    cost: MatchingCost, first: FirstStates, z: FloatArray | None = None, *, averaged: bool = False
) -> Linearisation:
    """Linearised at the truth, or at z (d,)."""
    place = cost.system.space.z_of(TRUTH) if z is None else z
    rng = np.random.default_rng(0)
    return linearise(cost, place, first, 0.02 * np.eye(place.size), 0, rng, averaged=averaged)


def test_slopes_are_of_the_first_state_whatever_the_shape_of_its_samples(cost: MatchingCost) -> None:
    clips, nx, rng = len(cost.clips.windows), cost.nx, np.random.default_rng(1)
    plain = about(cost, FirstStates.recorded(clips, nx))
    narrow = np.tril(0.3 * rng.standard_normal((clips, nx, nx))) + 0.3 * np.eye(nx)
    shaped = about(cost, FirstStates(np.zeros((clips, nx)), narrow))
    error = np.sqrt(np.mean((shaped.gain - plain.gain) ** 2, axis=(0, 2)))
    size = np.sqrt(np.mean(plain.gain**2, axis=(0, 2)))
    assert (error < 0.15 * size).all(), error / size


def test_what_is_known_of_first_states_is_their_posterior(cost: MatchingCost) -> None:
    """Its mean moves with z, and none is wider than the prior."""
    found = information(about(cost, FirstStates.recorded(len(cost.clips.windows), cost.nx)))
    step = np.array([0.1, 0.0, -0.2, 0.0])
    known = found.first_states(step, 0.0)
    covariance = known.shape @ known.shape.transpose(0, 2, 1)
    ones = np.broadcast_to(np.eye(cost.nx), covariance.shape)
    np.testing.assert_allclose(covariance @ found.nuisance_precision, ones, atol=1e-8)
    np.testing.assert_allclose(known.mean, found.first(step[None])[0])
    assert np.linalg.eigvalsh(covariance).max() <= 1.0 + 1e-9


def test_samples_of_first_states_are_no_narrower_than_asked(cost: MatchingCost) -> None:
    found = information(about(cost, FirstStates.recorded(len(cost.clips.windows), cost.nx)))
    free, held = (found.first_states(np.zeros(4), floor) for floor in (0.0, 0.7))
    sd = [np.linalg.svd(known.shape, compute_uv=False) for known in (free, held)]
    assert sd[0].min() < 0.6
    np.testing.assert_allclose(sd[1], np.maximum(sd[0], 0.7))
    np.testing.assert_array_equal(held.mean, free.mean)


def test_the_mean_of_the_samples_takes_their_common_bend_out(cost: MatchingCost) -> None:
    first = FirstStates.recorded(len(cost.clips.windows), cost.nx)
    middle, mean = about(cost, first), about(cost, first, averaged=True)
    np.testing.assert_array_equal(middle.residual, middle.centre)
    lift = mean.residual - mean.centre
    np.testing.assert_allclose(mean.bend, middle.bend - lift**2)
    assert (mean.bend > -1e-12).all()


def test_samples_that_a_bound_cuts_short_move_no_mean(cost: MatchingCost) -> None:
    """Pairs are lopsided there: that is slope, not bend."""
    nothing, (_, upper) = FirstStates.recorded(len(cost.clips.windows), 0), cost.system.space.bounds
    inside, at_bound = (cost.system.space.z_of(TRUTH) for _ in range(2))
    inside[0], at_bound[0] = upper[0] - 0.2, upper[0]
    both = [about(cost, nothing, z, averaged=True) for z in (inside, at_bound)]
    free, cut = (np.abs(found.residual - found.centre).max() for found in both)
    assert cut < 2.0 * free
