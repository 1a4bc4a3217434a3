"""Bounds of parameters and of bodies, and residuals that are not smooth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.states import touching
from amhe_cli.estimation.core.information import marginalised, step_within
from amhe_cli.estimation.core.result import Against
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline import problem as module
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.uncertainty.derived import body_numbers
from amhe_cli.estimation.uncertainty.ledger import Ledger, Source, Term, term_of
from amhe_cli.report.identification import identification_record, parameter_table
from amhe_cli.system.system import System
from amhe_cli.view.page import parameter_rows
from tests.estimation.conftest import CHEAP
from tests.estimation.test_identification import fall
from tests.report.synthetic import identification
from tests.report.test_identification import page

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


XML = """
<mujoco><worldbody><body name="link"><joint name="hinge" axis="0 1 0"/>
  <inertial pos="0.1 0 0.02" mass="2" diaginertia="0.01 0.02 0.015"/><geom size="0.05" mass="0"/>
</body></worldbody></mujoco>
"""


def system(**targets: object) -> System:
    return System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={"link": {"targets": [{"body": "link", "set": "pseudo_inertia"}]}} | targets,
        signals={"hinge": {"joints": ["hinge"], "noise": {"position": 0.01}}},
    )


def noise(covariance: np.ndarray) -> Ledger:
    """A ledger of noise alone."""
    return Ledger((term_of("noise", covariance),))


def test_numbers_of_a_body_have_verdicts_as_parameters_have() -> None:
    made, rng = system(), np.random.default_rng(3)
    known = np.diag(np.r_[1e-6, np.ones(9)])  # the mass's coordinate, and nothing else
    found = {b.name: b for b in body_numbers(made, np.zeros(10), noise(known), rng, ())}
    assert found["link.mass"].verdict == "identified" and found["link.mass"].budget == {"noise": 1.0}
    assert found["link.com_x"].verdict == "prior" and found["link.com_x"].shrinkage == pytest.approx(0.0)
    other = Term("prior", np.eye(10)[:, :1] * 0.3, (Source("your prior of x", parameter="x"),))
    owing = Ledger((*noise(known).terms, other))
    mass = next(b for b in body_numbers(made, np.zeros(10), owing, rng, ()) if b.name == "link.mass")
    assert (mass.verdict, mass.given) == ("conditional", "your prior of x")
    assert [reason.text for reason in mass.reasons] == ["given your prior of x"]
    missed = {
        b.name: b
        for b in body_numbers(made, np.zeros(10), noise(known), rng, (Against("misfit", "it misses"),))
    }
    assert missed["link.mass"].verdict == "model-sensitive"
    assert [reason.text for reason in missed["link.mass"].reasons] == ["it misses"]


def test_the_spread_of_draws_is_that_of_first_order_propagation_where_it_is_small() -> None:
    made, rng = system(), np.random.default_rng(3)
    root = 1e-3 * rng.normal(size=(10, 10))
    covariance = root @ root.T
    found = {b.name: b for b in body_numbers(made, np.zeros(10), noise(covariance), rng, ())}
    own = {"mass": 2.0, "com_x": 0.1, "com_y": 0.0, "com_z": 0.02, "I_xx": 0.01, "I_yy": 0.02, "I_zz": 0.015}
    assert list(found)[:4] == ["link.mass", "link.com_x", "link.com_y", "link.com_z"] and len(found) == 10
    for label, value in own.items():
        assert found[f"link.{label}"].estimate == pytest.approx(value)
        assert found[f"link.{label}"].prior == pytest.approx(value)
    step, scale = 1e-4, made.space.prior_sd
    for label in ("mass", "com_x", "I_yy", "I_xz"):
        (_, at), *_ = made.edits.inertias(np.concatenate((step * np.eye(10) * scale, np.zeros((1, 10)))))
        slope = (at[label][:10] - at[label][10]) / step
        sd = float(np.sqrt(slope @ covariance @ slope))
        assert found[f"link.{label}"].sd == pytest.approx(sd, rel=0.1)
        half = 0.5 * (found[f"link.{label}"].upper - found[f"link.{label}"].lower)
        assert half == pytest.approx(1.645 * sd, rel=0.15)


def test_a_fixed_coordinate_and_one_that_is_not_searched_have_their_values() -> None:
    made = system().fixing({"link.alpha": 0.1})
    made = replace(made, space=made.space.without(["link.t1"]))
    rng, known = np.random.default_rng(0), noise(1e-8 * np.eye(8))
    found = {b.name: b for b in body_numbers(made, np.zeros(8), known, rng, ())}
    assert (found["link.mass"].verdict, found["link.mass"].shrinkage) == ("prior", 0.0)
    assert found["link.mass"].estimate == pytest.approx(2.0 * np.exp(0.2))
    assert found["link.com_x"].estimate == pytest.approx(0.1)


def test_rounding_is_no_slope() -> None:
    """A factor on the whole inertia leaves the centre of mass where it is, but for the last digit."""
    made = system()
    made = replace(made, space=made.space.without([one for one in made.space.names if one != "link.alpha"]))
    rng, known = np.random.default_rng(0), noise(1e-6 * np.eye(1))
    found = {b.name: b for b in body_numbers(made, np.full(1, 0.3), known, rng, ())}
    assert {name for name, b in found.items() if b.verdict == "identified"} == {"link.mass"} | {
        f"link.I_{pair}" for pair in ("xx", "yy", "zz")
    }
    assert (found["link.com_x"].shrinkage, found["link.com_x"].sd) == (0.0, 0.0)


@pytest.mark.medium
def test_table_record_and_page_have_them() -> None:
    result = replace(
        identification(),
        bodies=body_numbers(system(), np.zeros(10), noise(1e-4 * np.eye(10)), np.random.default_rng(0), ()),
    )
    named = replace(result, parameters=tuple(replace(p, name=f"link.{p.name}") for p in result.parameters))
    assert named.lines == named.parameters + named.bodies, "these are no coordinates of its inertia"
    record = identification_record(result, {})
    assert record["bodies"][0].keys() == record["parameters"][0].keys()
    assert "link.mass" in [row[0] for row in parameter_table(result.lines).rows]
    assert "link.I_xz" in page(result)
    damping = Parameter("link.damping", "N m s", 1.0, 0.1, 10.0, True, 1.0)
    space = ParameterSpace((*system().space.parameters, damping))
    known = {damping.name: (1.0, 0.05, 20.0)}
    rows = parameter_rows(space, dict.fromkeys(space.names, 0.0), known, {}, record["bodies"])
    own, *shown = [row for row in rows if "hidden" not in row]  # of the view: nobody knows the coordinates
    assert own["name"] == damping.name, "a joint may be called as its body"
    assert (own["lower"], own["upper"]) == (damping.lower, damping.upper), "no value lies beyond its bounds"
    assert [row["name"] for row in shown] == [one.name for one in result.bodies]
    assert all(row["lower"] <= row["estimate"] <= row["upper"] and "low" not in row for row in shown)


def problem(system: System, log: Log) -> Problem:
    pool = ClipPool(system, [whole(log)], system.settings.clips)
    return Problem(system, pool, open_engine(system), 0)


def test_a_model_without_contacts_is_smooth_however_its_response_bends(monkeypatch, pendulum, swing):
    cube = System.load("cube_toss", {**CHEAP, "clips": {"count": 4, "length": [0.1, 0.2]}})
    monkeypatch.setattr(module, "NON_SMOOTH", -1.0)  # any response passes for bent
    assert not problem(pendulum, swing(2.0)).non_smooth
    assert problem(cube, fall(cube)).non_smooth


def test_the_kink_of_a_command_delay_on_the_command_grid_is_no_roughness(monkeypatch, delayed, swing):
    """At a delay of ten time steps the even response is 0.0025 of the odd one; between them it vanishes."""
    monkeypatch.setattr(Problem, "touches", True)
    monkeypatch.setattr(module, "NON_SMOOTH", 1e-4)
    monkeypatch.setattr(Problem, "active", np.array([False, False, False, False, True]))
    found = problem(delayed, swing(3.0))
    assert not found.non_smooth
    monkeypatch.setattr(Problem, "_off_grid", np.zeros(5))
    assert problem(delayed, swing(3.0)).non_smooth, "on the grid it is"


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
