"""The design of an experiment: information, limits and the choice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Window
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.core.linearise import FirstStates, linearise
from amhe_cli.estimation.design.design import accuracy, criterion, ensemble
from amhe_cli.estimation.design.information import clips_of, information_at, problem_of, rescaled
from amhe_cli.logs import read_log
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.robots.go1.probing.motions import MOTIONS, Motion, probe_task
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.robots.go1.settings import TripSettings
from amhe_cli.robots.go1.tasks import Believed, find_task
from amhe_cli.system.system import System
from tests.conftest import PENDULUM_TRUTH

PRIOR = np.eye(2)


def space(correlation: float = 0.0, names: str = "ab") -> ParameterSpace:
    parameters = tuple(Parameter(name, "-", 1.0, 0.01, 100.0, True, 0.5) for name in names)
    d = len(names)
    rows = np.eye(d) + correlation * (np.ones((d, d)) - np.eye(d))
    return ParameterSpace(parameters, tuple(map(tuple, rows.tolist())))


def information_of(*matrices: list[list[float]]) -> np.ndarray:
    """One draw of the information_of of several excitations."""
    return np.array([matrices], dtype=float)


def test_what_only_the_sum_tells_loses_to_what_tells_them_apart() -> None:
    ridge, apart = information_of([[50.0, 50.0], [50.0, 50.0]]), information_of([[20.0, 0.0], [0.0, 20.0]])
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
    known = accuracy(space(), information_of([[3.0, 0.0], [0.0, 0.0]])[:, 0])
    np.testing.assert_allclose(known.sd, [0.25, 0.5])  # 0.5 / sqrt(1 + 3), and the prior's


Case = tuple[System, list[Window], Engine, FloatArray]


@pytest.fixture(scope="module")
def case(pendulum_log: Path) -> Case:
    """System, windows, engine and truth of a log whose first states are noisy."""
    system = System.load("pendulum", {"identify": {"first_state": "polish"}})
    truth = system.space.z_of(np.array([PENDULUM_TRUTH[name] for name in system.space.names]))
    return system, clips_of(system, read_log(pendulum_log, system)), open_engine(system), truth


def test_errors_of_first_states_are_no_noise_of_the_motion(case: Case) -> None:
    rng, problem, truth = np.random.default_rng, problem_of(*case[:3]), case[3]
    fitted = information_at(problem, truth, rng(0)).matrix.sum(axis=0)
    recorded = information_at(problem, truth, rng(0), recorded=True).matrix.sum(axis=0)
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


@pytest.mark.medium
@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_no_motion_takes_joint_targets_to_where_a_robots_link_trips(motion: Motion) -> None:
    own = Believed(4.0, 0.6)
    run = open_run(RunOptions("t1", "true", duration=4.0), probe_task(find_task("t1"), motion, 4.0, own, own))
    plans = [np.vstack((cycle.played, cycle.plan.targets)) for cycle in run.episode.cycles()]
    assert len(plans) == 200
    largest = max(np.abs(np.diff(rows, axis=0)).max() for rows in plans)
    assert largest < 0.95 * TripSettings().target_jump
