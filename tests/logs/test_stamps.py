"""Stamps out of order."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.arrays import BoolArray, IntArray
from amhe_cli.logs.clocks import _longest_run, increasing, timeline
from amhe_cli.logs.messages.decode import SignalSamples


def test_one_stamp_out_of_order_is_looked_for_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[int] = []

    def counted(stamps: IntArray) -> BoolArray:
        looked.append(len(stamps))
        return _longest_run(stamps)

    monkeypatch.setattr("amhe_cli.logs.clocks._longest_run", counted)
    stamps = np.arange(1000) * 10
    stamps[500] += 25
    assert not increasing(stamps)[500] and increasing(stamps).sum() == 999
    assert max(looked) < 5


def test_the_clock_that_is_off_is_the_one_that_is_named() -> None:
    log_ns = 10**18 + 10**7 * np.arange(20)
    zero = np.zeros_like(log_ns)
    samples = SignalSamples(log_ns, log_ns - 20 * 10**9, zero, zero, {}, {}, has_header=False)
    assert timeline(samples).notes == ("its publish stamps are 20 s behind the recorder's clock",)


def test_a_table_has_one_time_and_zero_is_one() -> None:
    """Nothing is said of stamps that are not set, or of another clock, where rows repeat their time."""
    times = np.array([0, 0, 10, 20, 20, 30, 40]) * 10**6
    zero = np.zeros_like(times)
    samples = SignalSamples(times, times, zero, zero, {}, {}, has_header=False)
    assert timeline(samples).notes == ("messages are dropped: 2 with a repeated stamp",)
    assert timeline(samples, "header").notes == timeline(samples).notes
    np.testing.assert_array_equal(timeline(samples).stamps_ns, np.arange(5) * 10**7)
