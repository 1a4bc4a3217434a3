"""What a log tells, and that it does not hang on what its first states were recorded as."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates, linearise
from amhe_cli.estimation.design.information import clips_of, information_at, rescaled
from amhe_cli.logs import read_log
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System
from tests.conftest import PENDULUM_TRUTH

Case = tuple[System, list[Window], Engine, FloatArray]


@pytest.fixture(scope="module")
def case(pendulum_log: Path) -> Case:
    """System, windows, engine and truth of a log whose first states are noisy."""
    system = System.load("pendulum", {"identify": {"first_state": "polish"}})
    truth = system.space.z_of(np.array([PENDULUM_TRUTH[name] for name in system.space.names]))
    return system, clips_of(system, read_log(pendulum_log, system)), open_engine(system), truth


def test_errors_of_first_states_are_no_noise_of_the_motion(case: Case) -> None:
    rng = np.random.default_rng
    fitted = information_at(*case, rng=rng(0)).matrix.sum(axis=0)
    recorded = information_at(*case, rng=rng(0), recorded=True).matrix.sum(axis=0)
    assert np.linalg.slogdet(fitted)[1] > np.linalg.slogdet(recorded)[1]


def test_twice_the_noise_is_a_quarter_of_the_information(case: Case) -> None:
    system, windows, engine, z = case
    cost = MatchingCost(system, windows, engine, system.settings.cost)
    first, shape = FirstStates.recorded(len(windows), 0), 0.01 * np.eye(z.size)
    found = linearise(cost, z, first, shape, 0, np.random.default_rng(0))
    twice = rescaled(found, {o.channel.key: 2.0 for o in cost.clips.observed})
    np.testing.assert_allclose(twice.residual, 0.5 * found.residual)
    ratio = np.diag(information(twice).matrix.sum(axis=0)) / np.diag(information(found).matrix.sum(axis=0))
    np.testing.assert_allclose(ratio, 0.25, rtol=0.3)  # robust weights and the bend move it a little
