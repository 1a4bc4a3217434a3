"""A value at its bound stops no other: the search goes where the cost is least within the bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.parameters import ParameterSpace
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.information import step_within
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.system.system import System

#: The true armature is 0.006 kg m^2, a third below.
LOWEST = 0.009


def searched(system: System, log: Log) -> SearchState:
    problem = Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)
    state = search.start(problem)
    while not state.done:
        state = search.advance(problem, state)
    return state


@pytest.fixture(scope="module")
def bounded(pendulum: System) -> System:
    """The pendulum, its armature bounded to more than it is."""
    *others, armature = pendulum.space.parameters
    space = ParameterSpace((*others, replace(armature, nominal=0.015, lower=LOWEST)))
    return replace(pendulum, space=space)


@pytest.mark.medium
def test_a_search_with_a_value_at_its_bound_settles_where_the_others_fit_best(
    bounded: System, swing: Callable[..., Log]
) -> None:
    log = swing(6.0)
    found = searched(bounded, log)
    assert found.settled
    theta = bounded.space.theta_of(found.z)
    assert theta[3] == pytest.approx(LOWEST)
    fixed = bounded.fixing({"armature": LOWEST})
    others = fixed.space.theta_of(searched(fixed, log).z)
    np.testing.assert_allclose(theta[:3], others, rtol=0.05)  # a search settles within 0.3 sd


@pytest.mark.medium
def test_a_value_at_its_bound_is_no_search_cut_short(
    bounded: System, swing: Callable[..., Log], caplog: pytest.LogCaptureFixture
) -> None:
    identify(bounded, [swing(6.0)], None, IdentifyOptions())
    assert "stopped before it settled" not in caplog.text


def test_others_follow_what_a_bound_holds(pendulum: System) -> None:
    """Of two coupled values, one may not follow its step: the other minimises the cost beside it."""
    space = ParameterSpace(tuple(replace(p, lower=p.nominal / 2.0) for p in pendulum.space.parameters[:2]))
    hessian = np.array([[4.0, 3.0], [3.0, 9.0]])
    step = np.array([-3.0, 1.0])
    held = step_within(np.zeros(2), step, hessian, space)
    assert held[0] == pytest.approx(space.bounds[0][0])
    assert (hessian @ (held - step))[1] == pytest.approx(0.0, abs=1e-9)
