"""The benchmark of geared servos, end to end: friction found, friction missing and said, friction missing."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def gear(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The script as a module; it disables warnings, which other tests need."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    monkeypatch.delitem(sys.modules, "gear", raising=False)
    import gear  # pyright: ignore[reportMissingImports]

    yield gear
    logging.disable(logging.NOTSET)


@pytest.mark.medium
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
