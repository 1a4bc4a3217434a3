"""The small mathematics: rotations, resampling, samples, statistics, rows that are left out."""

from __future__ import annotations

import tracemalloc

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.core import rotations, statistics
from amhe_cli.core.arrays import sealed
from amhe_cli.core.log import Log, Samples, Thinner, merged, sampled, since
from amhe_cli.core.resample import derivative, longest_bridge, resample
from amhe_cli.core.signals import Series


def test_what_can_still_be_written_to_is_copied() -> None:
    values = np.arange(6.0)
    part = values[2:]
    part.setflags(write=False)  # its memory is that of `values`
    for array in (values, part, np.broadcast_to(values, (2, 6)), [1.0, 2.0], np.arange(3)):
        found = sealed(array)
        assert not np.shares_memory(found, values)
        assert found.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            found[...] = 0.0
    assert sealed(values > 1.0, np.bool_).dtype == np.bool_


def test_what_was_handed_over_is_not_copied() -> None:
    values, mask = np.arange(6.0), np.ones(3, dtype=bool)
    for one in (values, mask):
        one.setflags(write=False)
    assert sealed(values) is values
    assert sealed(mask, np.bool_) is mask
    assert np.shares_memory(sealed(values[2:]), values)
    assert sealed(sealed([1.0, 2.0])).base is None


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
        stamps, stamps[:, None], ("u",), grid, bridge=longest_bridge(stamps, 0.2, hold=True), hold=True
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


numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.filter(lambda v: np.linalg.norm(v) < 3.1)


@given(turns)
def test_log_undoes_exp(turn):
    assert rotations.log(rotations.exp(turn)) == pytest.approx(turn, abs=1e-9)


@given(turns, turns)
def test_difference_does_not_see_the_sign(a, b):
    qa, qb = rotations.exp(a), rotations.exp(b)
    expected = rotations.difference(qa, qb)
    if np.linalg.norm(expected) < np.pi - 1e-6:  # at half a turn the axis may flip
        assert rotations.difference(-qa, qb) == pytest.approx(expected, abs=1e-7)
        assert rotations.difference(qa, -qb) == pytest.approx(expected, abs=1e-7)


@given(turns, vectors)
def test_rotate_is_mujocos(turn, vector):
    quaternion, expected = rotations.exp(turn), np.zeros(3)
    mujoco.mju_rotVecQuat(expected, vector, quaternion)
    assert rotations.rotate(quaternion, vector) == pytest.approx(expected, abs=1e-9)


@pytest.mark.medium
@given(turns, turns, st.floats(0.0, 1.0))
def test_slerp_divides_the_angle(a, b, share):
    qa, qb = rotations.exp(a), rotations.exp(b)
    whole = np.linalg.norm(rotations.difference(qb, qa))
    part = np.linalg.norm(rotations.difference(rotations.slerp(qa, qb, np.array(share)), qa))
    assert part == pytest.approx(share * whole, abs=1e-7)


@given(turns, turns)
def test_mean_of_a_turn_and_its_inverse_about_it_is_it(middle, off):
    small = 0.1 * off
    around = [rotations.multiply(rotations.exp(middle), rotations.exp(way)) for way in (small, -small)]
    for signed in (around, [around[0], -around[1]]):
        assert rotations.difference(rotations.mean(signed), rotations.exp(middle)) == pytest.approx(
            0.0, abs=1e-9
        )


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


@given(st.floats(0.0, 1e6), st.floats(0.5, 10.0))
def test_pseudo_huber_lies_between_nothing_and_the_square(squared, delta):
    loss = statistics.pseudo_huber(np.array(squared), delta)
    assert 0.0 <= loss <= squared * (1.0 + 1e-9)


def test_pseudo_huber_is_square_near_zero_and_linear_far_out():
    assert statistics.pseudo_huber(np.array(1e-4), 3.0) == pytest.approx(1e-4, rel=1e-3)
    far = statistics.pseudo_huber(np.array([1e8, 4e8]), 3.0)
    assert far[1] / far[0] == pytest.approx(2.0, rel=1e-2)


def test_the_weight_is_the_slope_of_the_loss():
    s, h = np.array(5.0), 1e-6
    slope = (statistics.pseudo_huber(s + h, 2.0) - statistics.pseudo_huber(s - h, 2.0)) / (2 * h)
    assert statistics.pseudo_huber_weight(s, 2.0) == pytest.approx(slope, rel=1e-6)


def test_trimming_drops_the_worst_and_only_those():
    costs = np.array([[1.0, 2.0, np.inf, 3.0], [np.inf, 2.0, np.inf, 3.0]])
    trimmed = statistics.trimmed_mean(costs, 0.25)
    assert trimmed[0] == 2.0
    assert np.isinf(trimmed[1])


def test_autocorrelation_time_of_white_and_of_red_noise():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(20, 4000))
    red = np.zeros_like(white)
    for t in range(1, 4000):
        red[:, t] = 0.8 * red[:, t - 1] + white[:, t]
    assert statistics.autocorrelation_time(white) == pytest.approx(1.0, abs=0.05)
    assert statistics.autocorrelation_time(red) == pytest.approx(9.0, rel=0.15)  # (1 + 0.8) / (1 - 0.8)


def test_white_noise_is_measured_on_top_of_motion():
    rng = np.random.default_rng(1)
    time = np.linspace(0.0, 5.0, 1000)[:, None]
    assert statistics.white_noise_sd(np.sin(3 * time) + rng.normal(0, 0.01, (1000, 1))) == pytest.approx(
        0.01, rel=0.15
    )


def test_among_many_numbers_one_must_be_farther_out_to_surprise():
    assert statistics.among(1, 3.0) == pytest.approx(3.0)
    limit = statistics.among(49, 2.0)  # one of 44 logs of one parameter, so one of 44 logs of 49
    beyond = (np.abs(np.random.default_rng(0).standard_normal((20_000, 49))) > limit).any(axis=1).mean()
    assert beyond == pytest.approx(0.0455, abs=0.006)


@pytest.mark.parametrize(("freedom", "square"), [(1, 9.0), (2, 11.829), (10, 26.90), (98, 141.5)])
def test_a_chi_square_value_is_an_sd_of_one_number_that_is_as_unlikely(freedom: int, square: float) -> None:
    """Each of these is exceeded with the probability of 3 sd, 0.27 %."""
    assert statistics.sd_of_one(square, freedom) == pytest.approx(3.0, abs=0.05)


def test_one_number_keeps_its_sd_and_what_is_no_surprise_has_none() -> None:
    assert [statistics.sd_of_one(x**2, 1.0) for x in (0.0, 0.5, 3.0, 12.0)] == pytest.approx(
        [0.0, 0.5, 3.0, 12.0]
    )
    assert statistics.sd_of_one(30.0, 98.0) == 0.0
