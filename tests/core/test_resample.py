"""How long a silence may be filled, and slopes of long logs."""

import tracemalloc

import numpy as np
import pytest

from amhe_cli.core.resample import derivative, longest_bridge, resample


def test_a_latched_command_stays_in_force():
    grid = np.arange(0.0, 10.0, 0.1)
    for times in ([0.0], [0.0, 0.3], [0.0, 2.0, 2.5, 6.0]):
        stamps = np.array(times)
        bridge = longest_bridge(stamps, 0.2, hold=True)
        series = resample(stamps, stamps[:, None], ("u",), grid, bridge=bridge, hold=True)
        assert series.valid.all()
        assert series.values[-1, 0] == times[-1]


def test_a_streamed_command_that_stops_is_a_gap():
    stamps = np.concatenate((np.arange(0.0, 2.0, 0.02), np.arange(4.0, 6.0, 0.02)))
    grid = np.arange(0.0, 6.0, 0.01)
    series = resample(
        stamps,
        stamps[:, None],
        ("u",),
        grid,
        bridge=longest_bridge(stamps, 0.2, hold=True),
        hold=True,
    )
    assert not series.valid[(grid > 2.3) & (grid < 3.9)].any()
    assert series.valid[(grid < 1.9) | (grid > 4.1)].all()


def test_a_slow_state_is_given_five_of_its_periods():
    assert longest_bridge(np.arange(0.0, 10.0, 0.5), 0.2) == 2.5
    assert longest_bridge(np.arange(0.0, 10.0, 0.01), 0.2) == 0.2


@pytest.mark.parametrize("hold", [False, True], ids=["states", "commands"])
def test_samples_at_each_instant_of_the_clock_are_taken_over_as_they_are(hold: bool) -> None:
    rng = np.random.default_rng(0)
    times = 0.002 * np.arange(50) + rng.uniform(-1e-7, 1e-7, 50)
    values = rng.normal(size=(50, 3))
    series = resample(times, values, ("a", "b", "c"), np.linspace(0.014, 0.058, 23), bridge=0.01, hold=hold)
    np.testing.assert_array_equal(series.values, values[7:30])
    assert series.valid.all() and series.sampled.all()
    assert not np.shares_memory(series.values, values)


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
    monkeypatch.setattr("amhe_cli.core.resample._ROWS", 300)
    parts, less = found()
    np.testing.assert_array_equal(parts, whole)
    assert less < 0.6 * peak
