"""The sampler on costs whose answer is known; no simulation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.control.mpopi import JOINTS, Mpopi, Scores, Step, mppi_weights
from amhe_cli.control.splines import shift_matrix
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import ControlSettings
from amhe_cli.core.statistics import log_rank_weights

FEW = settings(max_examples=25, deadline=None)

CHANNEL_SIGMA = np.array([0.1, 2.0])
SETTINGS = ControlSettings(
    samples=32, horizon=12, knots=3, loops=2, elites=0.3, learning_rate=0.5, sigma_range=(0.2, 1.5),
    temperature=0.1, sigma_hip=0.02, sigma_thigh=0.03, sigma_calf=0.05,
)  # fmt: skip
START_SIGMA = np.concatenate((np.tile([0.02, 0.03, 0.05], 4 * 3), CHANNEL_SIGMA))
Cost = Callable[[FloatArray], FloatArray]


class Recorder:
    """Scores plans, and keeps them."""

    def __init__(self, cost: Cost) -> None:
        self.cost, self.seen = cost, list[FloatArray]()

    def __call__(self, x: FloatArray) -> Scores:
        self.seen.append(x.copy())
        cost = self.cost(x)
        return Scores(cost, {"whole": cost, "first": x[:, 0]})


def sampler(seed: int = 0, **changes: object) -> Mpopi:
    settings = SETTINGS.model_copy(update=changes)
    return Mpopi(settings, CHANNEL_SIGMA, np.random.default_rng(seed))


def bowl(target: FloatArray) -> Cost:
    """Squared distance in units of the start's sigma."""
    return lambda x: (((x - target) / START_SIGMA) ** 2).sum(axis=1)


def steady(joints: FloatArray, channels: FloatArray) -> FloatArray:
    """A plan that does not change when time goes on: the same at all knots."""
    return np.concatenate((np.tile(joints, 3), channels))


def moved_ahead(x: FloatArray) -> FloatArray:
    knots = shift_matrix(SETTINGS.horizon, SETTINGS.knots, 1.0) @ x[:36].reshape(3, JOINTS)
    return np.concatenate((knots.ravel(), x[36:]))


def failed(x: FloatArray) -> FloatArray:
    return np.full(len(x), np.inf)


def test_refined_sampling_finds_all_numbers_of_a_plan() -> None:
    rng = np.random.default_rng(3)
    target = steady(rng.uniform(-2.0, 2.0, 12) * START_SIGMA[:12], np.array([0.15, -3.0]))
    mpopi, cost = sampler(samples=64), bowl(target)
    first = cost(mpopi.mean[None])[0]
    for _ in range(150):
        step = mpopi.step(Recorder(cost), refine=True)
    assert cost(step.mean[None])[0] < 0.05 * first
    assert (np.abs(step.mean - target) < 0.6 * START_SIGMA).all()
    np.testing.assert_array_equal(step.mean, mpopi.mean)


def test_without_refinement_the_mean_goes_to_where_the_cost_is_least() -> None:
    """A last knot and the channels; in all directions at once the noise, which stays, sets a floor."""
    matters = [25, 36, 37]
    target = np.array([1.5, 1.5, -1.5]) * START_SIGMA[matters]
    mpopi = sampler(samples=64)

    def cost(x: FloatArray) -> FloatArray:
        return (((x[:, matters] - target) / START_SIGMA[matters]) ** 2).sum(axis=1)

    means = [mpopi.step(Recorder(cost), refine=False).mean for _ in range(60)]
    found = np.mean(means[20:], axis=0)[matters]
    np.testing.assert_allclose(found / START_SIGMA[matters], target / START_SIGMA[matters], atol=0.25)


def test_refinement_narrows_sigma_down_to_its_bound_and_no_further() -> None:
    mpopi = sampler()
    for _ in range(60):
        mpopi.step(Recorder(bowl(np.zeros(38))), refine=True)
        assert (mpopi.sigma >= 0.2 * START_SIGMA * (1.0 - 1e-12)).all()
        assert (mpopi.sigma <= 1.5 * START_SIGMA * (1.0 + 1e-12)).all()
    assert (mpopi.sigma < 0.8 * START_SIGMA).all()
    assert np.isclose(mpopi.sigma, 0.2 * START_SIGMA).any()


def test_sigma_widens_towards_what_is_far_off_but_not_beyond_its_bound() -> None:
    mpopi = sampler(learning_rate=1.0, samples=200)
    for _ in range(3):
        mpopi.step(Recorder(lambda x: -x[:, 0]), refine=True)
    assert mpopi.sigma[0] == pytest.approx(1.5 * START_SIGMA[0])
    assert (mpopi.sigma <= 1.5 * START_SIGMA * (1.0 + 1e-12)).all()


def test_without_refinement_sigma_stays() -> None:
    mpopi = sampler()
    for _ in range(5):
        mpopi.step(Recorder(bowl(np.zeros(38))), refine=False)
    np.testing.assert_array_equal(mpopi.sigma, START_SIGMA)


def test_the_variance_is_that_of_the_elites_about_the_old_mean() -> None:
    target = steady(3.0 * START_SIGMA[:12], np.array([0.2, 4.0]))
    mpopi, evaluate = sampler(learning_rate=0.7), Recorder(bowl(target))
    mpopi.step(evaluate, refine=False)
    old = moved_ahead(mpopi.mean)
    mpopi.step(evaluate, refine=True)
    x = evaluate.seen[1]
    elites = x[np.argsort(evaluate.cost(x))[: round(0.3 * len(x))]]
    weights = log_rank_weights(len(elites))

    def expected(centre: FloatArray) -> FloatArray:
        variance = 0.3 * START_SIGMA**2 + 0.7 * (weights @ (elites - centre) ** 2)
        return np.clip(np.sqrt(variance), 0.2 * START_SIGMA, 1.5 * START_SIGMA)

    np.testing.assert_allclose(mpopi.sigma, expected(old))
    assert np.abs(mpopi.sigma / expected(weights @ elites) - 1.0).max() > 0.05
    np.testing.assert_allclose(evaluate.seen[2][0], weights @ elites, err_msg="mean of the second loop")


def test_plans_without_noise_are_among_the_candidates() -> None:
    mpopi, evaluate = sampler(), Recorder(lambda x: -x[:, 0])
    mpopi.step(evaluate, refine=False)
    x = evaluate.seen[0]
    best, mean = x[np.argmin(evaluate.cost(x))], mpopi.mean
    assert not np.allclose(best, mean) and not np.allclose(best, moved_ahead(best))
    mpopi.step(evaluate, refine=False)
    for name, plan in (("mean", moved_ahead(mean)), ("best", moved_ahead(best)), ("zero", np.zeros(38))):
        assert np.isclose(evaluate.seen[1], plan, rtol=0.0, atol=1e-12).all(axis=1).any(), name


def test_the_previous_best_is_not_lost() -> None:
    """A steady plan that only luck finds: once seen, it is tried again in every step."""
    mpopi, evaluate = sampler(seed=5), Recorder(lambda x: -x[:, 36])
    best = np.inf
    for _ in range(8):
        found = mpopi.step(evaluate, refine=False).best
        assert found <= best
        best = found


def test_a_channel_does_not_run_away_however_cheap_that_is() -> None:
    mpopi, evaluate = sampler(), Recorder(lambda x: -x[:, 36] - x[:, 0])
    for _ in range(100):
        mpopi.step(evaluate, refine=False)
    tried = np.abs(np.concatenate(evaluate.seen)[:, 36])
    assert tried.max() == pytest.approx(tried[-32:].max())
    assert tried.max() < 5.0 * CHANNEL_SIGMA[0]


def test_diverged_rollouts_never_win_and_are_counted() -> None:
    """What goes to the left diverges; what goes to the right costs more the further it goes."""
    mpopi = sampler()
    evaluate = Recorder(lambda x: np.where(x[:, 0] < -1e-9, np.inf, x[:, 0] + 1.0))
    step = mpopi.step(evaluate, refine=True)
    lost = sum(int((x[:, 0] < -1e-9).sum()) for x in evaluate.seen)
    assert step.diverged == lost > 0
    assert step.mean[0] >= 0.0
    last = evaluate.cost(evaluate.seen[-1])
    assert step.best == last.min() and step.terms["whole"] == step.best
    assert step.average == pytest.approx(last[np.isfinite(last)].mean())
    assert np.isfinite(step.mean).all() and np.isfinite(mpopi.sigma).all()


@pytest.mark.parametrize("refine", [False, True])
def test_where_all_diverge_the_mean_only_moves_on(refine: bool) -> None:
    mpopi = sampler()
    mpopi.step(Recorder(bowl(steady(np.full(12, 0.05), np.array([0.1, 1.0])))), refine=False)
    mean, sigma = mpopi.mean, mpopi.sigma
    step = mpopi.step(Recorder(failed), refine)
    np.testing.assert_allclose(step.mean, moved_ahead(mean))
    np.testing.assert_array_equal(mpopi.sigma, sigma)
    assert step.diverged == step.rollouts > 0
    assert step.effective_samples == 0.0
    assert step.best == step.average == np.inf


def test_the_same_source_of_randomness_gives_the_same_plans() -> None:
    def run(seed: int) -> Step:
        mpopi = sampler(seed)
        for index in range(6):
            step = mpopi.step(Recorder(bowl(np.full(38, 0.03))), refine=index % 2 == 0)
        return step

    np.testing.assert_array_equal(run(1).mean, run(1).mean)
    assert np.abs(run(1).mean - run(2).mean).max() > 1e-4


@FEW
@given(samples=st.integers(4, 50), loops=st.integers(1, 6), refine=st.booleans())
def test_the_budget_of_rollouts_is_kept(samples: int, loops: int, refine: bool) -> None:
    evaluate = Recorder(bowl(np.zeros(38)))
    step = sampler(samples=samples, loops=loops).step(evaluate, refine)
    assert step.rollouts == sum(map(len, evaluate.seen))
    assert len(evaluate.seen) == (loops if refine else 1)
    assert min(map(len, evaluate.seen)) >= 4
    if not refine:
        assert step.rollouts == samples
    elif samples >= 4 * loops:
        assert samples - loops < step.rollouts <= samples
    else:
        assert step.rollouts == 4 * loops


COSTS = st.lists(st.floats(0.0, 100.0), min_size=2, max_size=30)


@FEW
@given(cost=COSTS, scale=st.floats(0.01, 100.0), shift=st.floats(-100.0, 100.0))
def test_weights_do_not_depend_on_units_or_on_what_all_share(
    cost: list[float], scale: float, shift: float
) -> None:
    costs = np.round(cost, 3)
    if np.median(costs) == costs.min():
        costs = np.arange(costs.size, dtype=float)
    weights = mppi_weights(costs, 0.3)
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(mppi_weights(scale * costs + shift, 0.3), weights, atol=1e-6)


@FEW
@given(cost=COSTS, temperature=st.floats(0.01, 10.0))
def test_cheaper_plans_weigh_more_and_failed_ones_nothing(cost: list[float], temperature: float) -> None:
    costs = np.array([*cost, np.inf])
    weights = mppi_weights(costs, temperature)
    assert weights.sum() == pytest.approx(1.0)
    assert weights[-1] == 0.0
    assert (np.diff(weights[np.argsort(costs)]) <= 0.0).all()


def test_weights_by_hand() -> None:
    """Excess 0, 1, 3: the median is 1; at temperature 0.5 the weights are as 1 : e^-2 : e^-6."""
    expected = np.exp([0.0, -2.0, -6.0])
    np.testing.assert_allclose(mppi_weights(np.array([4.0, 5.0, 7.0]), 0.5), expected / expected.sum())
    np.testing.assert_allclose(mppi_weights(np.full(4, 2.0), 0.5), 0.25)
    assert not mppi_weights(np.full(3, np.inf), 0.5).any()
