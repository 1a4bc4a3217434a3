"""Multisines within their limits, and the windows in which a rehearsal is asked."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.trajectory import Series, Trajectory
from amhe_cli.probing.multisine import candidates, slow_sine
from amhe_cli.probing.rehearsal import windows_of

REST, LOWER, UPPER = np.array([0.0, 1.0]), np.array([-3.0, 0.0]), np.array([3.0, 1.5])


def log(seconds: float, start: float = 0.0) -> Trajectory:
    """A log of nothing, every 2 ms."""
    rows = round(seconds / 0.002) + 1
    yes = np.ones(rows, dtype=bool)
    series = {"a.value": Series(np.zeros((rows, 1)), yes, yes, ("a",))}
    return Trajectory(0.002, series, "nothing", round(1e9 * start))


def test_a_multisine_fades_in_from_rest_and_stays_within_the_limits() -> None:
    times = np.linspace(0.0, 30.0, 3001)
    for one in (slow_sine(REST, LOWER, UPPER), *candidates(REST, LOWER, UPPER, 5, np.random.default_rng(0))):
        controls = one.at(times)
        np.testing.assert_allclose(controls[0], REST)
        assert (controls > LOWER).all()
        assert (controls < UPPER).all()
        assert np.ptp(controls, axis=0).min() > 0.05


def test_a_seed_gives_the_same_candidates_and_another_gives_others() -> None:
    first, again, other = (candidates(REST, LOWER, UPPER, 1, np.random.default_rng(s))[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first.size, again.size)
    assert not np.allclose(first.size, other.size)


def test_a_part_of_a_run_is_cut_into_windows_by_the_runs_own_clock() -> None:
    windows = windows_of(log(10.0, start=0.02), start=3.0, seconds=2.0)
    assert [w.duration for w in windows] == pytest.approx([0.5] * 4)
    assert [w.start * 0.002 + 0.02 for w in windows] == pytest.approx([3.0, 3.5, 4.0, 4.5])


def test_what_the_log_does_not_hold_whole_is_not_asked() -> None:
    assert windows_of(log(4.9), start=3.0, seconds=2.0) == []
    assert len(windows_of(log(5.0), start=3.0, seconds=2.0)) == 4
