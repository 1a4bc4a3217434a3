"""The sampler on costs whose answer is known; no simulation."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amhe_cli.control.mpopi import Mpopi, MpopiStep, Scores, mppi_weights, shift_matrix, spline_basis
from amhe_cli.control.settings import ControlSettings
from amhe_cli.core.arrays import FloatArray

FEW = settings(max_examples=25, deadline=None)

CHANNEL_SIGMA = np.array([0.1, 2.0])
SETTINGS = ControlSettings(
    samples=32, horizon=12, knots=3, loops=2, elites=0.3, learning_rate=0.5, sigma_range=(0.2, 1.5),
    temperature=0.1,
)  # fmt: skip
JOINT_SIGMA = np.tile([0.02, 0.03, 0.05], 4)
START_SIGMA = np.concatenate((np.tile(JOINT_SIGMA, 3), CHANNEL_SIGMA))
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
    return Mpopi(settings, JOINT_SIGMA, CHANNEL_SIGMA, np.random.default_rng(seed))


def bowl(target: FloatArray) -> Cost:
    """Squared distance in units of the start's sigma."""
    return lambda x: (((x - target) / START_SIGMA) ** 2).sum(axis=1)


def downhill(x: FloatArray) -> FloatArray:
    """Noise on any number may pay: all of them are refined."""
    return -(x / START_SIGMA).sum(axis=1)


def steady(joints: FloatArray, channels: FloatArray) -> FloatArray:
    """A plan that does not change when time goes on: the same at all knots."""
    return np.concatenate((np.tile(joints, 3), channels))


def moved_ahead(x: FloatArray) -> FloatArray:
    knots = shift_matrix(SETTINGS.horizon, SETTINGS.knots, 1.0) @ x[:36].reshape(3, 12)
    return np.concatenate((knots.ravel(), x[36:]))


def failed(x: FloatArray) -> FloatArray:
    return np.full(len(x), np.inf)


def sigmas(mpopi: Mpopi, cost: Cost, switches: Iterable[bool]) -> list[FloatArray]:
    """Sigma after each step, one for each of the flags."""
    after = list[FloatArray]()
    for switched in switches:
        mpopi.step(Recorder(cost), switched)
        after.append(mpopi.sigma.copy())
    return after


def test_refined_sampling_finds_all_numbers_of_a_plan() -> None:
    rng = np.random.default_rng(3)
    target = steady(rng.uniform(-2.0, 2.0, 12) * START_SIGMA[:12], np.array([0.15, -3.0]))
    mpopi, cost = sampler(samples=64, refine="always"), bowl(target)
    first = cost(mpopi.mean[None])[0]
    for _ in range(150):
        step = mpopi.step(Recorder(cost), switched=False)
    assert cost(step.mean[None])[0] < 0.05 * first
    assert (np.abs(step.mean - target) < 0.6 * START_SIGMA).all()
    np.testing.assert_array_equal(step.mean, mpopi.mean)


@pytest.mark.parametrize("switched", [False, True])
@pytest.mark.parametrize("refine", ["switch", "always", "never"])
def test_the_mean_moves_by_the_weights_of_all_candidates_refined_or_not(refine: str, switched: bool) -> None:
    target = steady(3.0 * START_SIGMA[:12], np.array([0.2, 4.0]))
    mpopi, evaluate = sampler(refine=refine), Recorder(bowl(target))
    for _ in range(4):
        step = mpopi.step(evaluate, switched)
        x = evaluate.seen[-1]
        np.testing.assert_allclose(step.mean, mppi_weights(evaluate.cost(x), 0.1) @ x)


@pytest.mark.parametrize("loops", [1, 2, 4])
def test_a_switch_begins_as_many_loops_as_are_set_one_in_each_step(loops: int) -> None:
    """Before the switch and after the loops, sigma is retained."""
    flags = [False, False, True, *[False] * 6]
    after = [START_SIGMA, *sigmas(sampler(loops=loops), downhill, flags)]
    changed = [not np.array_equal(a, b) for a, b in pairwise(after)]
    assert changed == [2 <= step < 2 + loops for step in range(len(flags))]


def test_at_a_switch_sigma_restarts_and_the_loops_begin_anew() -> None:
    """The cost of the step of the switch is infinite everywhere: nothing is learnt, the restart is bare."""
    mpopi = sampler(loops=3)
    refined = sigmas(mpopi, downhill, [True, False])[-1]
    assert (np.abs(refined / START_SIGMA - 1.0) > 1e-3).all()
    np.testing.assert_allclose(sigmas(mpopi, failed, [True])[-1], START_SIGMA)
    after = sigmas(mpopi, downhill, [False] * 4)
    changed = [not np.allclose(a, b, rtol=1e-9, atol=0.0) for a, b in pairwise([START_SIGMA, *after])]
    assert changed == [True, True, False, False]


def test_sigma_widens_towards_what_is_far_off_but_not_beyond_its_bound() -> None:
    after = sigmas(sampler(learning_rate=1.0, samples=200, loops=3), lambda x: -x[:, 0], [True, False, False])
    assert after[-1][0] == pytest.approx(1.5 * START_SIGMA[0])
    assert (np.array(after) <= 1.5 * START_SIGMA * (1.0 + 1e-12)).all()


def after_a_loop(
    sigma: FloatArray, x: FloatArray, cost: FloatArray, old: FloatArray, about: FloatArray
) -> FloatArray:
    """Sigma at learning rate 0.7; each number by those of the elites in which it carries noise."""
    x, cost = x[3:], cost[3:]  # without mean, previous best and reference
    variance = sigma**2
    for number in range(sigma.size):
        noisy = np.flatnonzero(np.abs(x[:, number] - old[number]) > 1e-9)
        count = max(2, round(0.3 * noisy.size))
        elites = noisy[np.argsort(cost[noisy])[:count]]
        weights = np.log(count + 0.5) - np.log(np.arange(1, count + 1))
        variance[number] = np.average((x[elites, number] - about[number]) ** 2, weights=weights)
    return np.clip(np.sqrt(0.3 * sigma**2 + 0.7 * variance), 0.2 * START_SIGMA, 1.5 * START_SIGMA)


def test_the_variance_is_that_of_the_noisy_elites_about_the_old_mean() -> None:
    target = steady(3.0 * START_SIGMA[:12], np.array([0.2, 4.0]))
    mpopi, evaluate = sampler(learning_rate=0.7, loops=2), Recorder(bowl(target))
    mpopi.step(evaluate, switched=False)
    sigma = START_SIGMA
    for switched in (True, False):
        old = moved_ahead(mpopi.mean)
        mpopi.step(evaluate, switched)
        x = evaluate.seen[-1]
        cost = evaluate.cost(x)
        np.testing.assert_allclose(mpopi.sigma, after_a_loop(sigma, x, cost, old, about=old))
        assert np.abs(mpopi.sigma / after_a_loop(sigma, x, cost, old, about=mpopi.mean) - 1.0).max() > 0.05
        sigma = mpopi.sigma


@pytest.mark.parametrize("samples", [10, 32])
def test_a_cost_that_is_mere_chance_does_not_narrow_sigma(samples: int) -> None:
    """Its square stays as it is, on average over many switches; candidates without noise would halve it."""
    chance = np.random.default_rng(4).random
    squares = list[FloatArray]()
    for seed in range(60):
        mpopi = sampler(seed, samples=samples, loops=3, sigma_range=(0.01, 100.0))
        after = sigmas(mpopi, lambda x: chance(len(x)), [True, False, False])
        squares.append((after[-1] / START_SIGMA) ** 2)
    assert np.mean(squares, axis=0)[:36].mean() == pytest.approx(1.0, abs=0.15)
    assert np.mean(squares, axis=0)[36:].mean() == pytest.approx(1.0, abs=0.25)


def test_plans_without_noise_are_among_the_candidates() -> None:
    mpopi, evaluate = sampler(), Recorder(lambda x: -x[:, 0])
    mpopi.step(evaluate, switched=False)
    x = evaluate.seen[0]
    best, mean = x[np.argmin(evaluate.cost(x))], mpopi.mean
    assert not np.allclose(best, mean) and not np.allclose(best, moved_ahead(best))
    mpopi.step(evaluate, switched=False)
    for name, plan in (("mean", moved_ahead(mean)), ("best", moved_ahead(best)), ("zero", np.zeros(38))):
        assert np.isclose(evaluate.seen[1], plan, rtol=0.0, atol=1e-12).all(axis=1).any(), name


def test_a_channel_does_not_run_away_however_cheap_that_is() -> None:
    mpopi, evaluate = sampler(), Recorder(lambda x: -x[:, 36] - x[:, 0])
    for _ in range(100):
        mpopi.step(evaluate, switched=False)
    tried = np.abs(np.concatenate(evaluate.seen)[:, 36])
    assert tried.max() == pytest.approx(tried[-32:].max())
    assert tried.max() < 5.0 * CHANNEL_SIGMA[0]


def test_diverged_rollouts_never_win_and_are_counted() -> None:
    """What goes to the left diverges; what goes to the right costs more the further it goes."""
    mpopi = sampler()
    evaluate = Recorder(lambda x: np.where(x[:, 0] < -1e-9, np.inf, x[:, 0] + 1.0))
    step = mpopi.step(evaluate, switched=True)
    x = evaluate.seen[0]
    cost = evaluate.cost(x)
    assert step.diverged == (x[:, 0] < -1e-9).sum() > 0
    assert step.rollouts == 32
    assert step.mean[0] >= 0.0
    assert step.best == cost.min() and step.terms["whole"] == step.best
    assert step.average == pytest.approx(cost[np.isfinite(cost)].mean())
    assert np.isfinite(step.mean).all() and np.isfinite(mpopi.sigma).all()


def test_diverged_rollouts_do_not_refine() -> None:
    """What leaves the middle diverges: the elites are those that remain, and sigma follows them only."""
    mpopi = sampler(samples=200, learning_rate=1.0, loops=1)
    limit = 0.5 * START_SIGMA[36]
    mpopi.step(
        Recorder(lambda x: np.where(np.abs(x[:, 36]) > limit, np.inf, -np.abs(x[:, 36]))), switched=True
    )
    assert mpopi.sigma[36] <= limit * (1.0 + 1e-12)
    assert mpopi.sigma[36] > 0.8 * limit


@pytest.mark.parametrize("switched", [False, True])
def test_where_all_diverge_the_mean_only_moves_on(switched: bool) -> None:
    mpopi = sampler()
    mpopi.step(Recorder(bowl(steady(np.full(12, 0.05), np.array([0.1, 1.0])))), switched=False)
    mean, sigma = mpopi.mean, mpopi.sigma
    step = mpopi.step(Recorder(failed), switched)
    np.testing.assert_allclose(step.mean, moved_ahead(mean))
    np.testing.assert_allclose(mpopi.sigma, sigma)
    assert step.diverged == step.rollouts == 32
    assert step.effective_samples == 0.0
    assert step.best == step.average == np.inf


def test_the_same_source_of_randomness_gives_the_same_plans() -> None:
    def run(seed: int) -> MpopiStep:
        mpopi = sampler(seed)
        for index in range(6):
            step = mpopi.step(Recorder(bowl(np.full(38, 0.03))), switched=index % 3 == 0)
        return step

    np.testing.assert_array_equal(run(1).mean, run(1).mean)
    assert np.abs(run(1).mean - run(2).mean).max() > 1e-4


@FEW
@given(
    samples=st.integers(5, 50),
    loops=st.integers(1, 6),
    refine=st.sampled_from(["switch", "always", "never"]),
    switches=st.lists(st.booleans(), min_size=1, max_size=8),
)
def test_every_step_takes_exactly_the_budget_of_rollouts_at_once(
    samples: int, loops: int, refine: str, switches: list[bool]
) -> None:
    evaluate = Recorder(bowl(np.zeros(38)))
    mpopi = sampler(samples=samples, loops=loops, refine=refine)
    steps = [mpopi.step(evaluate, switched) for switched in switches]
    assert [step.rollouts for step in steps] == [samples] * len(switches)
    assert [len(x) for x in evaluate.seen] == [samples] * len(switches)
    assert (mpopi.sigma >= 0.2 * START_SIGMA * (1.0 - 1e-12)).all()
    assert (mpopi.sigma <= 1.5 * START_SIGMA * (1.0 + 1e-12)).all()


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


def test_weights_by_hand() -> None:
    """Excess 0, 1, 3: the median is 1; at temperature 0.5 the weights are as 1 : e^-2 : e^-6."""
    expected = np.exp([0.0, -2.0, -6.0])
    np.testing.assert_allclose(mppi_weights(np.array([4.0, 5.0, 7.0]), 0.5), expected / expected.sum())
    np.testing.assert_allclose(mppi_weights(np.full(4, 2.0), 0.5), 0.25)
    assert not mppi_weights(np.full(3, np.inf), 0.5).any()


KNOTS = st.integers(2, 9)
ANYWHERE = st.lists(st.floats(-0.5, 1.5), min_size=1, max_size=20)


def natural_spline(values: FloatArray, at: FloatArray) -> FloatArray:
    """Coefficients of all pieces at once, from the conditions that define a natural cubic spline."""
    pieces = len(values) - 1
    gap = 1.0 / pieces
    rows: list[FloatArray] = []
    sides: list[float] = []

    def condition(side: float, *parts: tuple[int, list[float]]) -> None:
        row = np.zeros((pieces, 4))
        for piece, coefficients in parts:
            row[piece] += coefficients
        rows.append(row.ravel())
        sides.append(side)

    end = [[1.0, gap, gap**2, gap**3], [0.0, 1.0, 2.0 * gap, 3.0 * gap**2], [0.0, 0.0, 2.0, 6.0 * gap]]
    for piece in range(pieces):
        condition(values[piece], (piece, [1.0, 0.0, 0.0, 0.0]))
        condition(values[piece + 1], (piece, end[0]))
    for piece in range(pieces - 1):
        condition(0.0, (piece, end[1]), (piece + 1, [0.0, -1.0, 0.0, 0.0]))
        condition(0.0, (piece, end[2]), (piece + 1, [0.0, 0.0, -2.0, 0.0]))
    condition(0.0, (0, [0.0, 0.0, 2.0, 0.0]))
    condition(0.0, (pieces - 1, end[2]))
    coefficients = np.linalg.solve(np.array(rows), np.array(sides)).reshape(pieces, 4)
    piece = np.minimum((at / gap).astype(int), pieces - 1)
    local = at - piece * gap
    return (coefficients[piece] * local[:, None] ** np.arange(4)).sum(axis=1)


@FEW
@given(seed=st.integers(0, 999), knots=KNOTS)
def test_it_is_the_natural_cubic_spline(seed: int, knots: int) -> None:
    values, at = np.random.default_rng(seed).normal(size=knots), np.linspace(0.0, 1.0, 41)
    np.testing.assert_allclose(spline_basis(at, knots) @ values, natural_spline(values, at), atol=1e-10)


@FEW
@given(knots=KNOTS, level=st.floats(-5.0, 5.0), slope=st.floats(-5.0, 5.0))
def test_lines_are_reproduced_and_held_outside(knots: int, level: float, slope: float) -> None:
    at = np.linspace(-0.3, 1.3, 33)
    values = level + slope * np.linspace(0.0, 1.0, knots)
    expected = level + slope * np.clip(at, 0.0, 1.0)
    np.testing.assert_allclose(spline_basis(at, knots) @ values, expected, atol=1e-12)


@FEW
@given(seed=st.integers(0, 999), horizon=st.integers(5, 40), knots=KNOTS, steps=st.floats(0.0, 50.0))
def test_shifted_knots_are_the_spline_later(seed: int, horizon: int, knots: int, steps: float) -> None:
    """The spline's values so many steps later, and past its end the last one."""
    values = np.random.default_rng(seed).normal(size=knots)
    later = np.minimum(np.linspace(0.0, 1.0, knots) + steps / (horizon - 1), 1.0)
    np.testing.assert_allclose(
        shift_matrix(horizon, knots, steps) @ values, natural_spline(values, later), atol=1e-9
    )
