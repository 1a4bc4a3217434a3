"""The benchmarks' own arithmetic, and small runs of them."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


def script(monkeypatch: pytest.MonkeyPatch, name: str) -> Iterator[ModuleType]:
    """A benchmark as a module; it disables warnings, which other tests need."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield import_module(name)
    logging.disable(logging.NOTSET)


@pytest.fixture
def gear(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    yield from script(monkeypatch, "gear")


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_what_constant_friction_leaves_open_is_in_the_interval_and_named(gear: ModuleType) -> None:
    found = {kind: gear.trial(6 + i) for i, kind in enumerate(gear.KINDS)}
    assert [one["kind"] for one in found.values()] == list(gear.KINDS)
    mass = {kind: one["parameters"][0] for kind, one in found.items()}
    assert mass["M5"]["held"] and mass["M5"]["verdict"] == "identified"
    assert mass["geared"]["held"] and mass["geared"]["verdict"] != "identified"
    assert mass["geared"]["assumed"] > mass["constant"]["assumed"]
    assert any(p["named"] for p in found["geared"]["parameters"])
    assert not any(p["named"] for p in found["constant"]["parameters"])
    held = [p["held"] for p in found["M5"]["parameters"]]
    assert gear.row("M5", [found["M5"]])[2] == f"{sum(held) / len(held):.0%}"


@pytest.fixture
def honesty(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    yield from script(monkeypatch, "honesty")


@pytest.mark.medium
def test_twin_is_identified_and_counted(honesty: ModuleType) -> None:
    found = honesty.trial(honesty.place("rotors", "twin", 0))
    assert (found["problem"], found["kind"]) == ("rotors", "twin")
    verdicts = [p["verdict"] for p in found["parameters"]]
    assert set(verdicts) <= {"identified", "conditional"}
    held = sum(p["held"] for p in found["parameters"])
    outside = sum(p["verdict"] == "identified" and not p["held"] for p in found["parameters"])
    assert all(p["held"] == (abs(p["estimate"] - p["truth"]) < 1.8 * p["sd"]) for p in found["parameters"])
    line = honesty.row("rotors", "twin", [found])
    named = verdicts.count("identified")
    assert line[2:4] == (f"{named / 3:.0%}", "100%") and line[5] == f"{held / 3:.0%}"
    assert line[4].startswith(f"{outside} of {named}")


@pytest.mark.medium
@pytest.mark.usefixtures("unexplained")
def test_wrong_model_is_not_identified_and_gives_reasons(honesty: ModuleType) -> None:
    found = honesty.trial(honesty.place("servo_off", "wrong", 0))
    assert (found["problem"], found["kind"]) == ("servo_off", "wrong")
    line = honesty.row("servo_off", "wrong", [found])
    assert (line[2], line[4]) == ("0%", "0 of 0")
    assert line[6], "the other verdicts by kind"
    assert " x " in honesty.reasons([found])


def test_twins_and_wrong_plants_differ_in_what_the_model_lacks(honesty: ModuleType) -> None:
    from plants import PROBLEMS  # pyright: ignore[reportMissingImports]

    problem = PROBLEMS["gain"]
    twin, again, wrong = (
        problem.robot(np.random.default_rng(1), name).logs[0]["joints.position"].values
        for name in (None, None, "gain")
    )
    assert np.array_equal(twin, again)
    assert np.abs(twin - wrong).max() > 0.05


@pytest.fixture
def sbc(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    for module in script(monkeypatch, "sbc"):
        monkeypatch.setattr(module, "DRAWS", 2000)
        yield module


def inside(sbc: ModuleType, ranks: np.ndarray) -> np.ndarray:
    """Which ECDFs of ranks (m, n) stay within the band."""
    count = ranks.shape[1]
    places = sbc.places_of(count)
    low, high = sbc.band_of(count, float(np.quantile(sbc.chance(count), 1.0 - sbc.BAND)))
    ecdf = (ranks[:, :, None] <= places).mean(axis=1)
    return ((ecdf > low - 1e-9) & (ecdf < high + 1e-9)).all(axis=1)


def test_a_band_holds_the_ecdfs_of_uniform_ranks_as_a_whole(sbc) -> None:
    assert inside(sbc, np.random.default_rng(0).random((4000, 60))).mean() == pytest.approx(0.95, abs=0.02)


def test_a_single_rank_leaves_no_band(sbc) -> None:
    assert inside(sbc, np.array([[0.0], [0.5], [1.0]])).all()


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
    plant, off, _ = sbc.plant_of(system, np.random.default_rng(0))
    names = plant.space.names[len(system.space) :]
    assert len(off) == len(names) > 0 and any("gain" in name for name in names)
    gains = [
        plant.edits.apply(plant.model, np.array([*system.space.nominal, *more])).actuator_gainprm[0, 0]
        for more in (plant.space.nominal[len(system.space) :], off)
    ]
    assert gains[0] == pytest.approx(system.model.actuator_gainprm[0, 0]) and gains[1] != gains[0]


@pytest.mark.medium
def test_a_trial_ranks_the_truth_in_its_posterior(sbc) -> None:
    result = sbc.trial("pendulum", False, 0)
    t = np.array(result["error"]) / result["sd"]
    np.testing.assert_allclose(result["pit"], np.vectorize(sbc.NormalDist().cdf)(t))
    assert 0.0 <= result["likelihood"] <= 1.0 and np.abs(t).max() < 5.0
