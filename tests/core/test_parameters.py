"""The search coordinates z, and what a belief does to a prior."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core.belief import belief_of
from amhe_cli.core.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace(
    (Parameter("mass", "kg", 4.0, 0.5, 20.0, True, 0.5), Parameter("offset", "m", 0.1, -1.0, 1.0, False, 0.2))
)


BOX: Any = SimpleNamespace(name="box", space=SPACE, fixed={}, parts={}, sets={})


@given(st.floats(0.5, 20.0), st.floats(-1.0, 1.0))
def test_theta_survives_the_way_to_z_and_back(mass, offset):
    theta = np.array([mass, offset])
    assert SPACE.theta_of(SPACE.z_of(theta)) == pytest.approx(theta, rel=1e-12, abs=1e-12)


def test_one_prior_sd_is_one():
    assert SPACE.theta_of(np.array([1.0, -1.0])) == pytest.approx([4.0 * np.exp(0.5), -0.1])


def test_a_belief_becomes_the_prior_of_what_it_knows():
    belief = belief_of(BOX, np.array([1.0, 0.5]), np.diag([0.04, 0.25]))
    space = SPACE.with_prior(belief)
    assert space.nominal == pytest.approx(belief.estimate)
    assert space.prior_sd == pytest.approx([0.5 * 0.2, 0.2 * 0.5])


def test_what_a_belief_owes_to_the_model_is_known_of_the_prior():
    belief = belief_of(BOX, np.zeros(2), np.diag([0.04, 0.25]), systematic=np.diag([0.03, 0.0]))
    space = SPACE.with_prior(belief)
    assert np.array(space.prior_systematic) == pytest.approx(np.diag([0.75, 0.0]))
    assert np.diag(space.loose_precision) == pytest.approx([1.0 / (1.0 + 75.0), 1.0])
    assert space.systematic_of(belief) == pytest.approx(np.diag([0.75, 0.0]))
    one = space.without([SPACE.names[1]])
    assert one.prior_systematic == ((pytest.approx(0.75),),)
    assert SPACE.loose_precision is SPACE.prior_precision


def test_nobody_can_change_what_a_space_keeps():
    for kept in (SPACE.log, SPACE.prior_covariance):
        with pytest.raises(ValueError, match="read-only"):
            kept[0] = 0


def test_a_belief_has_sd_and_interval_in_units():
    belief = belief_of(BOX, np.zeros(2), np.diag([0.04, 0.25]))
    assert belief.sd == pytest.approx([0.4, 0.1])
    lower, upper = belief.interval
    assert lower == pytest.approx([4.0 * np.exp(-0.16448536), 0.1 - 0.16448536])
    assert upper == pytest.approx([4.0 * np.exp(0.16448536), 0.1 + 0.16448536])
