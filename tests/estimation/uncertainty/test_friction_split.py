"""Viscous and Coulomb friction that the excitation cannot split: no run claims to know either."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import amhe_cli as amhe

TRUTH = np.array([0.02, 0.28, 0.15])


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module, with logs of half the length."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
    import friction_split  # pyright: ignore[reportMissingImports]

    monkeypatch.setattr(friction_split, "SECONDS", 4.5)
    return friction_split


@pytest.mark.medium
def test_runs_at_one_speed_know_neither_friction_and_never_contradict(benchmark: ModuleType) -> None:
    system = benchmark.system()
    for seed in (0, 1):
        log = benchmark.run(system, TRUTH, np.random.default_rng(seed))
        found = amhe.identify(system, [log], seed=seed).parameters
        for name, true in zip(benchmark.FRICTION, TRUTH[1:], strict=True):
            assert found[name].verdict in ("weak", "prior"), (name, seed)
            assert found[name].interval[0] < true < found[name].interval[1]
