"""Errors against the horizon: what a prediction misses, in the joint's own unit, at the right instant."""

from pathlib import Path

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.validation.horizon import STARTS, clip_errors, starts, stretches
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.report.held_out import horizon_table
from tests.conftest import PENDULUM_TRUTH


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum")


@pytest.fixture(scope="module")
def log(system: amhe.System, pendulum_log: Path) -> amhe.Log:
    return amhe.read_log(pendulum_log, system)


def test_clips_side_by_side_are_one_stretch(log: amhe.Log) -> None:
    windows = [Window(log, start, 100) for start in (400, 0, 100, 700)]
    assert [(one.start, one.stop) for one in stretches(windows)] == [(0, 200), (400, 500), (700, 800)]


def test_starts_are_spread_and_few(system: amhe.System, log: amhe.Log) -> None:
    windows = [Window(log, 0, log.steps - 1)]
    short = starts(system, windows, 0.1)
    assert len(short) == STARTS
    assert short[-1].stop > 0.8 * log.steps
    assert starts(system, windows, 20.0) == []
    assert [one.length for one in starts(system, windows, np.inf)] == [log.steps - 1]


def test_the_truth_misses_by_noise_and_the_prior_by_more(system: amhe.System, log: amhe.Log) -> None:
    truth = system.space.z_of(np.array([PENDULUM_TRUTH[name] for name in system.space.names]))
    windows = starts(system, [Window(log, 0, log.steps - 1)], 0.5)
    cost = MatchingCost(system, windows, open_engine(system), system.settings.cost)
    (found,) = clip_errors(cost, np.stack((truth, np.zeros(4))))
    assert (found.channel, found.column, found.unit) == ("joints.position", "hinge", "rad")
    assert np.median(found.errors[0]) < 0.004  # sensors have 0.002 rad
    assert np.median(found.errors[1]) > 10.0 * np.median(found.errors[0])
    assert found.moved.max() > 0.1


@pytest.mark.medium
def test_the_table_is_in_degrees(system: amhe.System, log: amhe.Log) -> None:
    result = amhe.identify(system, log, only=["load_mass"], fix={k: PENDULUM_TRUTH[k] for k in ("damping",)})
    held_out = result.found.held_out
    assert held_out is not None
    assert [one.to_end for one in held_out.horizons] == [False] * (len(held_out.horizons) - 1) + [True]
    table = horizon_table(held_out.horizons)
    assert table.head[2].startswith("after 0.1 s, n = ")
    assert " (end), n = 1" in table.head[-1]
    assert table.rows[0][0] == "hinge"
    assert "°" in table.rows[0][2]
    assert all(one.identified < one.initial for one in held_out.horizons)
    assert result.record()["held_out"]["horizons"][0]["column"] == "hinge"
