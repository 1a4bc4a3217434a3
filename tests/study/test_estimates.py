"""Errors and intervals of online estimates, on runs that are made up."""

import numpy as np
import pytest

from amhe_cli.study.cells import Cell
from amhe_cli.study.estimates import estimates
from amhe_cli.study.results import CellResult
from amhe_cli.study.summary import Group

TIME = np.round(0.2 * np.arange(1, 61), 2)


def run(seed: int, mass: float, sd: float, changes: bool = True) -> CellResult:
    """Friction is right, and so is the mass up to 6.2 s, where it changes; then `mass` is believed."""
    after = changes * (TIME > 6.1)
    trace = {
        "time": TIME,
        "truth/box_mass": 4.0 + 2.0 * after,
        "truth/floor_friction": np.full(60, 0.4),
        "belief/box_mass": np.where(TIME > 6.1, mass, 4.0),
        "belief/floor_friction": np.full(60, 0.4),
        "belief_sd/box_mass": np.where(TIME > 6.1, sd, np.nan),
        "belief_sd/floor_friction": np.full(60, 0.01),
    }
    return CellResult(Cell("t3", "adaptive", seed), {}, None, {}, trace, 1.0)


def of(*results: CellResult):
    found = estimates(Group("t3", "adaptive", (), results, 0))
    assert found
    return found


def test_errors_count_from_a_while_after_the_change() -> None:
    found = of(run(0, mass=5.4, sd=0.1))
    assert (found.mass, found.friction, found.product) == pytest.approx((0.1, 0.0, 0.1))
    assert (found.mass_held, found.friction_held, found.resolved) == (0.0, 1.0, 1.0), "10 % is near enough"


def test_an_error_is_held_by_an_interval_that_is_wide_enough() -> None:
    far, wide = run(0, mass=4.5, sd=0.1), run(1, mass=4.5, sd=0.9)
    assert of(far).resolved == 0.0
    assert of(wide).mass_held == of(wide).resolved == 1.0
    assert (of(far, wide).mass_held, of(far, wide).resolved, of(far, wide).n) == (0.5, 0.5, 2)


def test_where_nothing_changes_it_counts_from_the_start() -> None:
    found = of(run(0, mass=4.4, sd=1.0, changes=False))
    late = TIME >= 3.0
    assert found.mass == pytest.approx(0.1 * np.sqrt((TIME[late] > 6.1).mean()), rel=1e-6)


def test_without_an_estimator_there_is_nothing_to_judge() -> None:
    known = run(0, 6.0, 0.1)
    trace = {name: values for name, values in known.trace.items() if "sd" not in name}
    bare = CellResult(known.cell, {}, None, {}, trace, 1.0)
    assert estimates(Group("t3", "true", (), (bare,), 0)) is None
