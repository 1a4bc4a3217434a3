"""Samples put together, cut and thinned."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core.log import Log, Samples, Thinner, merged, sampled, since
from amhe_cli.core.signals import Series


def series(*times: float) -> tuple[np.ndarray, np.ndarray]:
    return np.array(times), 10.0 * np.array(times)[:, None]


def assert_equal(found: Samples, expected: Samples) -> None:
    assert list(found) == list(expected)
    for key, (times, values) in expected.items():
        np.testing.assert_array_equal(found[key][0], times)
        np.testing.assert_array_equal(found[key][1], values)


def test_parts_are_merged_in_the_order_of_time_whichever_came_first() -> None:
    late, early = {"a.x": series(0.3, 0.4), "b.y": series(0.5)}, {"a.x": series(0.1, 0.35)}
    assert_equal(merged([late, early]), {"a.x": series(0.1, 0.3, 0.35, 0.4), "b.y": series(0.5)})


def test_of_equal_times_the_first_part_s_sample_comes_first() -> None:
    one, other = ({"a.x": (np.array([0.1]), np.array([[value]]))} for value in (1.0, 2.0))
    assert merged([one, other])["a.x"][1].tolist() == [[1.0], [2.0]]


def test_what_is_older_is_left_out() -> None:
    assert_equal(since({"a.x": series(0.1, 0.2, 0.3), "b.y": series(0.1)}, 0.2),
                 {"a.x": series(0.2, 0.3), "b.y": series()})  # fmt: skip


def test_only_measured_rows_of_a_log_are_samples() -> None:
    values, yes = np.arange(4.0)[:, None], np.ones(4, dtype=bool)
    one = Series(values, yes, np.array([True, False, True, False]), ("x",))
    assert_equal(sampled(Log(0.5, {"a.x": one}, "a log")), {"a.x": (np.array([0.0, 1.0]), values[[0, 2]])})


@given(jitter=st.floats(0.0, 4e-4), lost=st.floats(0.0, 0.2), seed=st.integers(0, 2**31))
def test_one_sample_is_kept_of_each_period_whatever_the_stamps(jitter: float, lost: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    times = 0.002 * np.arange(1000) + rng.uniform(0.0, jitter, 1000)
    times = times[rng.random(1000) >= lost]
    thinner = Thinner(0.01)
    parts = [thinner.thinned({"a.x": (part, part[:, None])}) for part in np.array_split(times, 100)]
    kept = merged(parts)["a.x"][0]
    periods = np.floor(times / 0.01 + 1e-6)
    np.testing.assert_array_equal(np.floor(kept / 0.01 + 1e-6), np.unique(periods))
