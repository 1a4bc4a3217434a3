"""The benchmark of the verdicts, end to end: one twin, and one wrong model."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture
def honesty(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script as a module; it disables warnings, which other tests need."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    monkeypatch.delitem(sys.modules, "honesty", raising=False)
    import honesty  # pyright: ignore[reportMissingImports]

    yield honesty
    logging.disable(logging.NOTSET)


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
