"""The bundled pushers: one log, whose force is compared in one system and drives the other."""

from __future__ import annotations

import json

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.cost import MatchingCost

LOG = bundled_root() / "examples" / "logs" / "pusher.mcap"


@pytest.mark.parametrize("name", ["pusher", "pushed_box"])
def test_the_truth_explains_the_push(name: str) -> None:
    """Mass and friction with the same product push the box with the same force: both must be right."""
    system = amhe.System.load(name)
    log = amhe.read_log(LOG, system)
    truth = json.loads(log.metadata["truth"])
    true = np.array([truth[p] for p in system.space.names])
    candidates = np.array([true, true * [0.6, 1.0], true * [1.0, 0.6], true * [1.5, 1.0], true * [1.0, 1.5]])
    windows = [Window(log, start, 200) for start in range(200, log.steps - 250, 500)]
    cost = MatchingCost(system, windows, open_engine(system), system.settings.cost)
    costs = cost.costs(system.space.z_of(candidates))
    assert (costs[1:] > 1.5 * costs[0]).all(), costs


def test_the_log_shows_the_friction_of_the_floor() -> None:
    """While the box slides, the force along x is friction times weight, on average over its accelerations."""
    log = amhe.read_log(LOG, amhe.System.load("pusher"))
    truth = json.loads(log.metadata["truth"])
    force = log["wrist.force"].values[:, 0]
    speed = log["box.linear_velocity"].values[:, 0]
    expected = truth["floor_friction"] * truth["box_mass"] * 9.81
    assert force[speed > 0.05].mean() == pytest.approx(expected, rel=0.1)
