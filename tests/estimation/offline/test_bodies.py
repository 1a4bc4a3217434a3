"""Log-Cholesky inertias in kg, m and kg m^2."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from amhe_cli.estimation.uncertainty.derived import body_numbers
from amhe_cli.report.identification import identification_record
from amhe_cli.report.parameters import body_table
from amhe_cli.system.system import System
from tests.report.synthetic import identification
from tests.report.test_identification import page

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


def test_the_spread_of_draws_is_that_of_first_order_propagation_where_it_is_small() -> None:
    made, rng = system(), np.random.default_rng(3)
    root = 1e-3 * rng.normal(size=(10, 10))
    covariance = root @ root.T
    found = {b.name: b for b in body_numbers(made, np.zeros(10), covariance, rng)}
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
    found = {b.name: b for b in body_numbers(made, np.zeros(8), 1e-8 * np.eye(8), np.random.default_rng(0))}
    assert found["link.mass"].estimate == pytest.approx(2.0 * np.exp(0.2))
    assert found["link.com_x"].estimate == pytest.approx(0.1)


@pytest.mark.medium
def test_table_record_and_page_have_them() -> None:
    result = replace(
        identification(),
        bodies=body_numbers(system(), np.zeros(10), 1e-4 * np.eye(10), np.random.default_rng(0)),
    )
    record = identification_record(result, {})
    assert record["bodies"][0].keys() == {"name", "unit", "estimate", "sd", "lower", "upper", "prior"}
    assert body_table(result.bodies).rows[0][0] == "link.mass"
    html = page(result)
    assert "Inertias in the axes of their bodies" in html and "link.I_xz" in html
