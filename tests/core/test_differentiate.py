"""Velocities from positions: memory that does not grow faster than the log."""

from __future__ import annotations

import tracemalloc

import numpy as np

from amhe_cli.core import resample
from amhe_cli.core.resample import derivative


def test_long_logs_are_differentiated_in_parts_to_the_same_numbers(monkeypatch) -> None:
    rng = np.random.default_rng(0)
    stamps = np.array(np.cumsum(rng.uniform(0.001, 0.004, 4000)), dtype=np.float64)
    stamps[2000:] += 3.0  # a silence
    values = rng.standard_normal((4000, 12)).cumsum(axis=0)

    def found() -> tuple[np.ndarray, int]:
        tracemalloc.start()
        slopes = derivative(stamps, values, 0.1)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return slopes, peak

    whole, peak = found()
    monkeypatch.setattr(resample, "_ROWS", 300)
    parts, less = found()
    np.testing.assert_array_equal(parts, whole)
    assert less < 0.6 * peak
