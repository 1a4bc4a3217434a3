"""What is held and not quite known widens the online estimates as far as it moves them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.replay import replay, windows
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
