"""The moving-horizon estimator against the truth of a cart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amhe_cli.core.belief import belief_of
from amhe_cli.core.errors import ConfigError, EstimationError
from amhe_cli.core.log import Log, Window
from amhe_cli.core.signals import Series
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon, Pace
from amhe_cli.estimation.online.replay import open_replay, replay, windows
from amhe_cli.estimation.online.updates import Gaussian, Noise, Outcome, innovation, prior_of
from amhe_cli.system.system import System


def with_mhe(system: System, **changes: object) -> System:
    mhe = system.settings.mhe.model_copy(update=changes)
    return replace(system, settings=system.settings.model_copy(update={"mhe": mhe}))


def estimates(system: System, log: Log, seed: int = 0, threads: int = 1) -> list[Estimate]:
    engine = open_engine(system, threads=threads)
    estimator = MovingHorizon(system, engine, np.random.default_rng(seed))
    return list(replay(estimator, windows(system, log)))


@pytest.mark.medium
@pytest.mark.parametrize(("method", "within"), [("linearised", 0.03), ("logrank", 0.12)])
def test_it_finds_the_truth(cart, drive, method: str, within: float) -> None:
    found = estimates(with_mhe(cart, method=method), drive(6.0))
    assert found[-1].theta == pytest.approx([2.0, 3.0], rel=within)
    assert all(e.updated and e.diverged == 0 for e in found)
    assert found[-1].time == pytest.approx(5.9)


def test_a_log_without_a_file_is_replayed(cart, drive) -> None:
    problem = open_replay(cart, drive(2.0))
    assert problem.true_values == {}
    assert next(replay(problem.estimator, problem.steps)).updated


@pytest.mark.medium
def test_the_intervals_hold_the_truth_as_often_as_they_say(constant, drive) -> None:
    truth = np.array([2.0, 3.0])
    ends = [estimates(constant, drive(3.0, seed=seed), seed)[-1] for seed in range(60)]
    held = np.array([(e.lower < truth) & (truth < e.upper) for e in ends]).mean(axis=0)
    assert (held > 0.8).all(), held  # 90 %, less 2.5 sd of the count
    spread = np.log([e.theta for e in ends]).std(axis=0)
    reported = np.mean([e.sd / e.theta for e in ends], axis=0)
    assert (reported < 3.0 * spread).all(), reported / spread


@pytest.mark.medium
def test_intervals_hold_a_truth_that_is_far_from_the_prior(folder, drive) -> None:
    # what the first windows say of it, they say by slopes of another place
    unsure = {"mass": {"drift": 0.0}, "damping": {"drift": 0.0, "prior_sd": 1.0, "bounds": [0.05, 20]}}
    system, truth = System.load(folder, {"parameters": unsure}), np.array([2.0, 0.3])
    logs = [drive(1.5, damping=lambda t: truth[1], seed=seed) for seed in range(30)]
    ends = [estimates(system, log, seed)[-1] for seed, log in enumerate(logs)]
    held = np.array([(e.lower < truth) & (truth < e.upper) for e in ends]).mean(axis=0)
    assert (held > 0.65).all(), held  # a quarter, were a window's bend no more than noise


def test_an_update_iterates_while_its_steps_are_long(constant, drive) -> None:
    found = estimates(constant, drive(3.0))
    once = 1 + 2 * (2 + 2)  # parameters, and position and velocity of the first state
    assert found[0].rollouts == 2 * once
    assert [e.rollouts for e in found[-5:]] == [once] * 5


def test_a_jump_is_seen_and_followed(cart, drive) -> None:
    found = estimates(cart, drive(8.0, mass=lambda t: 2.0 if t < 4.0 else 3.5))
    jumps = [e.time for e in found if e.mark == "jump"]
    assert jumps and 4.0 < jumps[0] < 4.8
    assert all(time > 4.0 for time in jumps)
    late = [e for e in found if e.time > 6.0]
    assert np.mean([e.theta[0] for e in late]) == pytest.approx(3.5, rel=0.04)


@pytest.mark.medium
def test_a_jump_may_have_to_be_found_by_windows_in_a_row(cart, drive) -> None:
    log = drive(6.0, mass=lambda t: 2.0 if t < 4.0 else 3.5)
    marks = [[e.mark for e in estimates(with_mhe(cart, jump_windows=count), log)] for count in (1, 2)]
    one, two = (of.index("jump") for of in marks)
    assert two == one + 1


def test_a_jump_inflates_the_prior_of_its_own_window(constant, drive) -> None:
    log = drive(6.0, mass=lambda t: 2.0 if t < 4.0 else 3.5)
    one, two = (estimates(with_mhe(constant, jump_sd=sd), log) for sd in (0.6, 1e-6))
    at = next(i for i, e in enumerate(one) if e.mark == "jump")
    assert one[at - 1].theta == pytest.approx(two[at - 1].theta)
    assert one[at].theta[0] > two[at].theta[0] + 0.3
    assert one[at].sd[0] > 2.0 * two[at].sd[0]


def test_at_rest_it_keeps_its_belief_and_grows_less_sure(cart, drive) -> None:
    found = estimates(cart, drive(6.0, force=lambda t: np.where(t < 3.0, swing_of(t), 0.0) * (t < 3.0)))
    still = [e for e in found if e.time > 5.5]
    assert [e.mark for e in still] == ["still"] * len(still)
    assert np.ptp([e.theta for e in still], axis=0) == pytest.approx(0.0)
    assert (np.diff([e.sd for e in still], axis=0) > 0.0).all()


def swing_of(time: np.ndarray) -> np.ndarray:
    return 6.0 * np.sin(2.0 * np.pi * 1.3 * time)


def test_a_gap_is_passed_over(cart, drive) -> None:
    log = drive(5.0)
    series = dict(log.series)
    valid = np.array(series["force.effort"].valid)
    valid[400:420] = False
    gone = series["force.effort"]
    series["force.effort"] = Series(gone.values, valid, gone.sampled & valid, gone.columns)
    found = estimates(cart, replace(log, series=series))
    assert {e.mark for e in found} == {"updated", "gap"}
    assert all((e.mark == "gap") == (e.time - 0.5 < 2.1 - 1e-9 and e.time > 2.0 + 1e-9) for e in found)
    assert found[-1].theta == pytest.approx([2.0, 3.0], rel=0.05)


def test_a_seed_gives_the_same_estimates_at_any_number_of_threads(cart, drive) -> None:
    log = drive(2.0)
    one, two = estimates(cart, log, 3, 1), estimates(cart, log, 3, 2)
    np.testing.assert_array_equal([e.theta for e in one], [e.theta for e in two])
    other = estimates(cart, log, 4)
    assert (one[-1].theta != other[-1].theta).all()


@pytest.mark.parametrize("method", ["linearised", "logrank"])
def test_weights_hold_a_parameter_at_its_last_estimate(cart, drive, method: str) -> None:
    heavy = with_mhe(cart, method=method, prior_weight={"mass": 1e9})
    found = estimates(heavy, drive(3.0))
    assert found[-1].theta[0] == pytest.approx(1.5, rel=0.05)
    assert found[-1].theta[1] != pytest.approx(2.0, rel=0.1)
    if method == "linearised":  # nor does it become any surer of it
        assert found[-1].sd[0] > 0.95 * found[0].sd[0]


def test_time_up_stops_after_the_first_iteration(cart, drive) -> None:
    system = with_mhe(cart, method="logrank", iterations=6)
    engine = open_engine(system)
    window = windows(system, drive(2.0))[2]
    counts = []
    for budget in (None, 1e-9):
        estimator = MovingHorizon(system, engine, np.random.default_rng(0))
        counts.append(estimator.update(window, 1.0, budget).rollouts)
    assert counts == [6 * 32, 32]


@pytest.mark.parametrize("method", ["linearised", "logrank"])
def test_an_update_with_less_time_than_it_took_before_has_fewer_samples(cart, drive, method: str) -> None:
    system = with_mhe(cart, method=method, samples=12, iterations=1)
    engine = open_engine(system)
    estimator = MovingHorizon(system, engine, np.random.default_rng(0))
    first, second, third = (
        estimator.update(window, float(at), budget)
        for at, (window, budget) in enumerate(
            zip(windows(system, drive(2.0))[2:], (None, 1e-9, 60.0), strict=False)
        )
    )
    assert 4 <= second.rollouts <= first.rollouts - 4
    assert third.rollouts == first.rollouts


def test_a_budget_is_kept_to_by_the_updates_after_it() -> None:
    here = Gaussian(np.zeros(2), np.eye(2))
    samples, counts = 16, []
    for _ in range(4):  # 10 ms for each rollout, of which the mean is one
        outcome = Outcome(here, Noise(), 1.0, 1.0, 1.0, rollouts=samples + 1, diverged=0, iterations=1)
        pace = Pace.of(0.01 * (samples + 1), samples, outcome)
        counts.append(samples := pace.affordable(0.1, most=16))
    assert counts == [8] * 4
    assert pace.affordable(0.001, most=16) == 4, "fewer samples determine no slopes"
    assert pace.affordable(None, most=16) == Pace().affordable(0.1, most=16) == 16


def test_what_the_model_has_wrong_widens_what_is_reported_and_moves_nothing(cart, drive) -> None:
    log, off = drive(3.0), 0.2
    plain, widened = (
        estimates(cart, log)[-1],
        estimates(with_mhe(cart, systematic={"mass": off, "damping": -off}), log)[-1],
    )
    np.testing.assert_array_equal(plain.theta, widened.theta)
    assert widened.sd / widened.theta == pytest.approx(np.hypot(plain.sd / plain.theta, off), rel=1e-6)
    product = np.array([1.0, 1.0])
    alike = [product @ e.belief.covariance @ product for e in (plain, widened)]
    assert alike[1] == pytest.approx(alike[0], rel=1e-6), "the product is known as well as before"


def test_the_first_window_has_not_drifted_for_longer_than_it_lasts(cart, drive) -> None:
    often, seldom = (estimates(with_mhe(cart, update_period=p), drive(2.0))[0].sd for p in (0.5, 50.0))
    assert seldom == pytest.approx(often, rel=0.2)


def test_a_log_shorter_than_a_window_is_one_window_and_a_shorter_one_is_none(cart, drive) -> None:
    (window,) = windows(cart, drive(0.3))
    assert window.duration == pytest.approx(0.295)
    with pytest.raises(EstimationError, match="hold no window"):
        windows(cart, drive(0.02))


def test_a_window_of_few_steps_is_refused_and_one_without_samples_teaches_nothing(cart, drive) -> None:
    with pytest.raises(ConfigError, match=r"window of 0.001 s is too short: .* 5 steps .* 0.025 s"):
        windows(with_mhe(cart, window=0.001), drive(1.0))
    with pytest.raises(ConfigError, match=r"update period of 0.001 s is too short: .* step is 0.005 s"):
        windows(with_mhe(cart, update_period=0.001), drive(1.0))
    log = drive(1.0)
    silent = {key: replace(s, sampled=np.zeros_like(s.sampled)) for key, s in log.series.items()}
    engine = open_engine(cart)
    estimator = MovingHorizon(cart, engine, np.random.default_rng(0))
    assert estimator.update(Window(replace(log, series=silent), 10, 5), 0.1).mark == "gap"


def test_a_loaded_belief_can_still_move(cart) -> None:
    space = cart.space
    belief = belief_of(cart, space.z_of(np.array([1.0, 4.0])), 1e-8 * np.eye(2))
    start = prior_of(space, belief, 0.2)
    assert space.theta_of(start.z) == pytest.approx([1.0, 4.0])
    assert start.sd == pytest.approx(space.in_z(0.2))
    wide = prior_of(space, None, 0.2)
    assert wide.sd == pytest.approx([1.0, 1.0]), "the prior is not narrowed"


@pytest.mark.parametrize("d", [1, 7, 98])
def test_windows_of_many_unknowns_show_no_jump_by_chance_and_show_a_true_one(d: int) -> None:
    """Truths are drawn from the belief; some directions are determined well, others hardly."""
    rng = np.random.default_rng(d)
    turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
    told = (turn * np.geomspace(1e4, 1e-2, d)) @ turn.T
    prior = np.diag(rng.uniform(0.02, 0.2, d) ** 2)
    noise = np.linalg.cholesky(told / 0.5)

    def seen(truth: np.ndarray) -> float:
        step = np.linalg.solve(told + np.eye(d), told @ truth + noise @ rng.standard_normal(d))
        return innovation(step, told, prior, 0.5)

    quiet = [seen(rng.standard_normal(d) * np.sqrt(np.diag(prior))) for _ in range(400)]

    assert np.mean(np.array(quiet) > 3.0) <= 0.01
    assert np.median([seen(1.5 * turn[:, 0]) for _ in range(20)]) > 3.0  # 1.5 prior sd
