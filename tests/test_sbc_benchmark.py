"""Simulation-based calibration: its bands hold what they say, and find posteriors that are too narrow."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture
def sbc(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script as a module; it disables warnings, which other tests need."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    monkeypatch.delitem(sys.modules, "sbc", raising=False)
    import sbc  # pyright: ignore[reportMissingImports]

    monkeypatch.setattr(sbc, "DRAWS", 2000)
    yield sbc
    logging.disable(logging.NOTSET)


def inside(sbc: ModuleType, ranks: np.ndarray) -> np.ndarray:
    """Which ECDFs of ranks (m, n) stay within the band."""
    count = ranks.shape[1]
    places = sbc.places_of(count)
    low, high = sbc.band_of(count, float(np.quantile(sbc.chance(count), 1.0 - sbc.BAND)))
    ecdf = (ranks[:, :, None] <= places).mean(axis=1)
    return ((ecdf > low - 1e-9) & (ecdf < high + 1e-9)).all(axis=1)


def test_a_band_holds_the_ecdfs_of_uniform_ranks_as_a_whole(sbc) -> None:
    assert inside(sbc, np.random.default_rng(0).random((4000, 60))).mean() == pytest.approx(0.95, abs=0.02)


def test_ranks_of_a_posterior_that_is_too_narrow_leave_both_bands(sbc) -> None:
    t = 1.5 * np.random.default_rng(0).standard_normal((50, 200))
    ranks = np.vectorize(sbc.NormalDist().cdf)(t)
    assert inside(sbc, ranks).mean() < 0.1
    low, high = sbc.coverage_band(200, 0.9)
    assert low < 0.9 < high
    assert np.mean((np.abs(2.0 * ranks - 1.0) < 0.9).mean(axis=1) < low) > 0.9


@pytest.mark.parametrize("case", ["pendulum", "arm"])
def test_an_assumed_value_that_is_off_moves_the_plant_and_not_the_model(sbc, case: str) -> None:
    system = sbc.system_of(case, assumed=True)
    plant, off = sbc.plant_of(system, np.random.default_rng(0))
    names = plant.space.names[len(system.space) :]
    assert len(off) == len(names) > 0 and any("gain" in name for name in names)
    gains = [
        plant.edits.apply(plant.model, np.array([*system.space.nominal, *more])).actuator_gainprm[0, 0]
        for more in (plant.space.nominal[len(system.space) :], off)
    ]
    assert gains[0] == pytest.approx(system.model.actuator_gainprm[0, 0]) and gains[1] != gains[0]


def test_a_trial_ranks_the_truth_in_its_posterior(sbc) -> None:
    result = sbc.trial("pendulum", False, 0)
    t = np.array(result["error"]) / result["sd"]
    np.testing.assert_allclose(result["pit"], np.vectorize(sbc.NormalDist().cdf)(t))
    assert 0.0 <= result["likelihood"] <= 1.0 and np.abs(t).max() < 5.0
