import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amhe_cli.study.summary import bootstrap, paired, rate, spread, wilson


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def mean(x: np.ndarray) -> np.ndarray:
    return x[..., 0].mean(axis=-1)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [(15, 15, 0.796, 1.0), (0, 15, 0.0, 0.204), (13, 15, 0.621, 0.963), (5, 10, 0.237, 0.763)],
)
def test_wilson_has_the_published_values(successes: int, n: int, low: float, high: float) -> None:
    assert wilson(successes, n) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))


@given(st.integers(1, 400).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_stays_within_0_and_1_and_holds_the_share(pair: tuple[int, int]) -> None:
    low, high = wilson(*pair)
    assert 0.0 <= low <= pair[0] / pair[1] + 1e-12
    assert pair[0] / pair[1] - 1e-12 <= high <= 1.0


def test_the_bootstrap_of_a_mean_is_that_of_the_normal_theory() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, (200, 1))
    low, high = bootstrap(values, mean, rng())
    half = 1.96 * values.std(ddof=1) / np.sqrt(200)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.03)


def test_few_rows_widen_the_interval() -> None:
    low, high = bootstrap(np.array([[0.0], [1.0]]), mean, rng())
    assert (low, high) == pytest.approx((0.5 - 0.5 * np.sqrt(2.0), 0.5 + 0.5 * np.sqrt(2.0)))


def test_its_interval_covers_as_often_as_it_says() -> None:
    draws = np.random.default_rng(2)
    hits = 0
    for _ in range(120):
        low, high = bootstrap(draws.normal(size=(15, 1)), mean, draws)
        hits += low <= 0.0 <= high
    assert 0.88 <= hits / 120 <= 0.99


def test_the_same_generator_gives_the_same_interval() -> None:
    values = np.arange(9.0)
    assert spread(values, rng()) == spread(values, rng())


def test_a_spread_leaves_missing_values_out() -> None:
    found = spread(np.array([1.0, np.nan, 3.0]), rng())
    assert (found.n, found.mean, found.sd, found.median) == (2, 2.0, pytest.approx(np.sqrt(2.0)), 2.0)
    assert np.isnan(spread(np.array([]), rng()).mean)
    assert np.isnan(spread(np.array([1.0]), rng()).low)


def test_a_rate_is_a_share_with_the_papers_sd() -> None:
    found = rate(np.array([1.0] * 13 + [0.0] * 2))
    assert (found.n, found.mean, found.sd) == (
        15,
        pytest.approx(0.867, abs=1e-3),
        pytest.approx(0.352, abs=1e-3),
    )


def test_pairs_take_out_what_seeds_have_in_common() -> None:
    common = np.random.default_rng(3).normal(10.0, 5.0, 15)
    found = paired(common + 0.1, common, rng())
    assert (found.n, found.mean) == (15, pytest.approx(0.1))
    assert (found.low, found.high) == (pytest.approx(0.1), pytest.approx(0.1))
    assert found.ratio == pytest.approx(0.1 / common.mean())


def test_a_pair_that_lacks_one_value_does_not_count() -> None:
    assert paired(np.array([1.0, np.nan, 2.0]), np.array([1.0, 1.0, 1.0]), rng()).n == 2
    assert paired(np.array([]), np.array([]), rng()).n == 0
