"""Which models are rough: those whose residuals jitter because something touches."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.states import touching
from amhe_cli.estimation.core.information import marginalised
from amhe_cli.estimation.offline import problem as module
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP
from tests.estimation.test_identification import fall


def problem(system: System, log: Log) -> Problem:
    pool = ClipPool(system, [whole(log)], system.settings.clips)
    return Problem(system, pool, open_engine(system), 0)


def test_a_model_without_contacts_is_smooth_however_its_response_bends(monkeypatch, pendulum, swing):
    cube = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    monkeypatch.setattr(module, "ROUGH", -1.0)  # any response passes for bent
    assert not problem(pendulum, swing(2.0)).rough
    assert problem(cube, fall(cube)).rough


def test_the_kink_of_a_command_delay_on_the_command_grid_is_no_roughness(monkeypatch, delayed, swing):
    """At a delay of ten time steps the even response is 0.0025 of the odd one; between them it vanishes."""
    monkeypatch.setattr(Problem, "touches", True)
    monkeypatch.setattr(module, "ROUGH", 1e-4)
    monkeypatch.setattr(Problem, "active", np.array([False, False, False, False, True]))
    found = problem(delayed, swing(3.0))
    assert not found.rough
    monkeypatch.setattr(Problem, "_off_grid", np.zeros(5))
    assert problem(delayed, swing(3.0)).rough, "on the grid it is"


@pytest.mark.parametrize(("height", "touches"), [(0.5, False), (0.04, True)])
def test_a_cube_touches_where_it_stands_and_not_in_the_air(height, touches):
    model = System.load("cube_toss").model
    positions = np.array([[0, 0, 0.6, 1, 0, 0, 0], [0, 0, height, 1, 0, 0, 0.0]])
    assert touching(model, positions) == touches


@pytest.mark.parametrize("digits", [7, 16])
def test_first_states_are_sampled_no_finer_than_parameters(monkeypatch, pendulum, swing, digits):
    """Beside wide samples of parameters, narrow ones of first states measure the bend of the others."""
    monkeypatch.setattr("amhe_cli.engine.cpu.CpuEngine.precision", 10.0**-digits)
    found = problem(pendulum, swing(2.0))
    nx = 2
    known = marginalised(np.zeros((1, 5)), np.zeros((1, 1, 5)), 1e9 * np.eye(5)[None, :nx], np.ones((1, 5)),
                         np.zeros((1, nx)))  # fmt: skip
    shape = found.first_states(known, np.zeros(1)).shape[0]
    assert np.linalg.svd(shape, compute_uv=False).min() == pytest.approx(found.finest)
    assert found.finest == pytest.approx({7: 10.0 ** (-7 / 3), 16: 1e-4}[digits])
