"""The paper's log-rank update, and held parameters that are considered, not estimated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.replay import replay, windows
from amhe_cli.estimation.online.updates import learned
from amhe_cli.logs import read_log
from amhe_cli.system.system import System

#: Mass of the load that is held, and how well somebody claims to know it [kg].
HELD, SD = 0.5, 0.02


def last(path: Path, **held: float) -> Estimate:
    """The last estimate of all but the load's mass."""
    given = {
        "unknowns": ["damping", "friction_loss", "armature"],
        "parameters": {"load_mass": held},
        "mhe": {"systematic": {}, "iterations": 1},
    }
    system = System.load("pendulum", given, warn=False)
    estimator = MovingHorizon(system, open_engine(system, threads=1), np.random.default_rng(0))
    return list(replay(estimator, windows(system, read_log(path, system))))[-1]


@pytest.mark.medium
def test_an_error_of_a_held_number_is_in_the_interval_as_far_as_it_acts(pendulum_log: Path) -> None:
    exact, considered = last(pendulum_log, held=HELD), last(pendulum_log, held=HELD, held_sd=SD)
    off = last(pendulum_log, held=HELD + SD)
    np.testing.assert_array_equal(exact.theta, considered.theta)
    added = np.sqrt(np.diag(considered.belief.covariance) - np.diag(exact.belief.covariance))
    moved = np.abs(np.log(off.theta / exact.theta))
    assert moved[1] > 0.4, "the load's weight is mistaken for dry friction"
    np.testing.assert_allclose(added[1], moved[1], rtol=0.3)
    assert (added > 0.3 * moved).all()


def test_by_hand() -> None:
    samples = np.array([[1.0], [3.0], [-2.0], [9.0]])
    costs = np.array([2.0, 1.0, 7.0, np.inf])
    mean, sigma = learned(samples, costs, np.array([0.0]), np.array([2.0]), share=0.5, rate=0.5)
    first, second = np.log(2.5), np.log(2.5) - np.log(2.0)
    weights = np.array([first, second]) / (first + second)
    assert mean == pytest.approx([0.5 * (weights @ [3.0, 1.0])])
    assert sigma == pytest.approx([np.sqrt(0.5 * 4.0 + 0.5 * (weights @ [9.0, 1.0]))])


def test_only_diverged_samples_teach_nothing() -> None:
    mean, sigma = learned(np.ones((4, 2)), np.full(4, np.inf), np.zeros(2), np.ones(2), 0.3, 0.5)
    assert mean == pytest.approx([0.0, 0.0]) and sigma == pytest.approx([1.0, 1.0])


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 1.0), st.floats(0.1, 1.0))
def test_the_mean_stays_among_the_samples(seed: int, share: float, rate: float) -> None:
    rng = np.random.default_rng(seed)
    samples, costs = rng.standard_normal((12, 3)), rng.random(12)
    centre = samples.mean(axis=0)
    mean, sigma = learned(samples, costs, centre, np.ones(3), share, rate)
    assert (mean >= samples.min(axis=0) - 1e-12).all() and (mean <= samples.max(axis=0) + 1e-12).all()
    # a mixture of the old variance and the elites' mean square distance from the old mean
    furthest = ((samples - centre) ** 2).max(axis=0)
    assert (sigma > 0.0).all()
    assert (sigma**2 >= 1.0 - rate - 1e-12).all() and (sigma**2 <= 1.0 - rate + rate * furthest + 1e-12).all()
