"""Validation: held-out data, horizons, comparisons."""

from __future__ import annotations

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.log import Log, Window
from amhe_cli.core.signals import Series
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.core.result import AtHorizon, Identification
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.uncertainty.fit import Scored
from amhe_cli.estimation.validation.held_out import misses_more, worse
from amhe_cli.estimation.validation.prediction import (
    STARTS,
    ClipErrors,
    at_horizon,
    best_of,
    clip_errors,
    improves,
    starts,
    stretches,
    verdict,
)
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.report.held_out import horizon_table
from amhe_cli.system.system import System
from tests.conftest import PENDULUM_TRUTH
from tests.estimation.conftest import CHEAP, TRUTH

#: What a model lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")


def values_of(result: Identification) -> set[str]:
    return {p.verdict for p in result.parameters}


@pytest.fixture(scope="module")
def at_truth() -> System:
    """A prior that stands at the truth."""
    names = ("load_mass", "damping", "friction_loss", "armature")
    nominal = {name: {"nominal": float(t), "prior_sd": 0.3} for name, t in zip(names, TRUTH, strict=True)}
    return System.load("pendulum", {**CHEAP, "parameters": nominal})


@pytest.mark.medium
def test_a_prior_at_the_truth_is_no_alarm(at_truth, swing, caplog) -> None:
    """Its cost has a floor: sensors four times as noisy as declared, and first states as recorded."""
    result = identify(at_truth, [swing(5.0, noise=4.0)], None, IdentifyOptions())
    held_out = result.held_out
    assert held_out is not None and held_out.cost > 4.0
    assert result.method == "linearised", "no other search was called for"
    assert result.unexplained == ()
    assert "held-out" not in caplog.text


@pytest.mark.medium
def test_a_log_that_another_load_held_out_is_model_sensitive(pendulum, swing, caplog) -> None:
    """The held-out log has the prior's own load: the fitted one leads away from it."""
    prior = pendulum.space.nominal
    with caplog.at_level(logging.WARNING):
        result = identify(pendulum, [swing(4.0)], [swing(2.0, seed=5, theta=prior)], IdentifyOptions())
    assert values_of(result) == {"model-sensitive"}
    assert "held-out clips fit worse than under the prior" in result.unexplained[0].text
    assert "no value is called identified" in caplog.text


@pytest.mark.medium
def test_a_load_that_no_fitted_log_carried_does_not_carry_over(pendulum, swing) -> None:
    heavy = TRUTH * [1.15, 1.0, 1.0, 1.0]
    result = identify(pendulum, [swing(4.0)], [swing(2.5, seed=5, theta=heavy)], IdentifyOptions())
    assert values_of(result) == {"model-sensitive"}
    assert any("of held-out clips" in reason.text for reason in result.unexplained)


@pytest.mark.medium
def test_errors_are_told_for_each_channel_over_time(pendulum, swing) -> None:
    result = identify(pendulum, [swing(5.0)], None, IdentifyOptions())
    held_out = result.held_out
    assert values_of(result) == {"identified"} and held_out is not None
    assert held_out.fitted_cost == pytest.approx(1.0, abs=0.3)
    assert held_out.fitted_cost < held_out.cost, "the first sample's noise is not in it"
    assert held_out.noise_scale["joints.position"] == pytest.approx(1.0, abs=0.2)
    angles = [one for one in held_out.errors if one.channel == "joints.position"]
    assert {one.unit for one in angles} == {"rad"}
    assert [(one.start, one.end) for one in angles] == [
        (0.0, 0.6), (0.0, 0.1), (0.1, 0.25), (0.25, 0.5), (0.5, 0.6)
    ]  # fmt: skip
    for one in angles:
        assert one.identified_fitted < 0.5 * one.initial_fitted
    assert angles[0].identified_fitted == pytest.approx(0.002 * np.sqrt(2.0 / np.pi), rel=0.3)


@pytest.mark.medium
def test_a_noise_that_was_declared_too_small_is_no_difference_between_clips(pendulum, swing) -> None:
    result = identify(pendulum, [swing(5.0, noise=7.0)], None, IdentifyOptions())
    assert result.noise_scale["joints.position"] > 5.0
    assert not any("held-out" in one.text for one in result.unexplained)


@pytest.mark.medium
@pytest.mark.parametrize(("steps", "as_noise"), [(5, True), (20, False)])
def test_what_the_model_misses_says_what_to_do(pendulum, swing, caplog, steps, as_noise) -> None:
    """Commands that act 10 or 40 ms late, which the model does not know of: no number is called identified.

    What is missed by 10 ms may be declared as noise; by 40 ms it is a part of the motion.
    """
    log = swing(4.0)
    command = log["command.position"]
    late = Series(np.roll(command.values, -steps, axis=0), command.valid, command.sampled, command.columns)
    result = identify(
        pendulum, [Log(log.dt, {**log.series, "command.position": late}, "late")], None, IdentifyOptions()
    )
    assert "the model misses joints.position by" in caplog.text
    assert values_of(result) <= {"model-sensitive", "prior"}
    (missed, *_) = [one.text for one in result.unexplained if "times its noise" in one.text]
    assert "the commands' delay" in missed and ("`signals.joints.noise.position=" in missed) == as_noise


def test_worse_is_more_than_the_values_own_sd_costs() -> None:
    """Six clips that know z to 0.1 each; the estimate has an sd of 0.04, and moved by 0.1 from the prior."""
    known, covariance, moved = np.full((6, 1, 1), 100.0), np.array([[0.0016]]), np.array([0.1])
    rng = np.random.default_rng(0)
    expected = 100.0 * 0.0016
    chance = [worse(expected + rng.normal(0.0, 0.1, 6), known, covariance, moved) for _ in range(200)]
    assert np.mean(chance) < 0.02
    assert worse(expected + rng.normal(9.0, 0.1, 6), known, covariance, moved)
    assert not worse(rng.normal(9.0, 30.0, 6), known, covariance, moved), "within the scatter of the clips"
    assert worse(np.array([np.inf, 0.0]), known[:2], covariance, moved), "a clip diverges that did not"


def test_held_out_clips_scatter_as_fitted_ones_do() -> None:
    rng = np.random.default_rng(1)
    alike = [misses_more(rng.chisquare(20, 6) / 20, rng.chisquare(20, 12) / 20) for _ in range(200)]
    assert sum(ratio is not None for ratio in alike) <= 2
    ratio = misses_more(4.0 * rng.chisquare(20, 6) / 20, rng.chisquare(20, 12) / 20)
    assert ratio == pytest.approx(2.0, rel=0.3)
    assert misses_more(np.array([40.0]), np.array([1.0, 30.0, 2.0])) is None, (
        "clips differ as much among them"
    )


def test_wrong_values_do_not_gain_by_residuals_that_repeat() -> None:
    """Far from the truth residuals repeat, and a time of their own would make them count for little."""
    missed, noise = 6.0, 1.0
    before, now = (scored_as(loss, time) for loss, time in ((missed, 30.0), (noise, 1.0)))
    times = [max(now.times[0], before.times[0])]
    assert (now.misfit(times) < before.misfit(times)).all()
    assert now.misfit(times) == pytest.approx(2.0 + 70.0 * noise / 30.0)


def scored_as(loss: float, time: float) -> Scored:
    """Three clips of 70 samples with one loss a sample, and squared first-state errors of 2."""
    cost: Any = SimpleNamespace(losses=lambda residuals: [np.full((1, 3), 70.0 * loss)])
    done: Any = SimpleNamespace(completed=np.ones((1, 3), dtype=bool))
    none: Any = None
    return Scored(cost, done, np.ones((3, 2)), (time,), none)


@pytest.fixture(scope="module")
def system() -> amhe.System:
    return amhe.System.load("pendulum")


@pytest.fixture(scope="module")
def log(system: amhe.System, pendulum_log: Path) -> amhe.Log:
    return amhe.read_log(pendulum_log, system)


def test_clips_side_by_side_are_one_stretch(log: amhe.Log) -> None:
    windows = [Window(log, start, 100) for start in (400, 0, 100, 700)]
    assert [(one.start, one.stop) for one in stretches(windows)] == [(0, 200), (400, 500), (700, 800)]


def test_starts_are_spread_and_few(system: amhe.System, log: amhe.Log) -> None:
    windows = [Window(log, 0, log.steps - 1)]
    short = starts(system, windows, 0.1)
    assert len(short) == STARTS
    assert short[-1].stop > 0.8 * log.steps
    assert starts(system, windows, 20.0) == []
    assert [one.length for one in starts(system, windows, np.inf)] == [log.steps - 1]


def test_the_truth_misses_by_noise_and_the_prior_by_more(system: amhe.System, log: amhe.Log) -> None:
    truth = system.space.z_of(np.array([PENDULUM_TRUTH[name] for name in system.space.names]))
    windows = starts(system, [Window(log, 0, log.steps - 1)], 0.5)
    cost = MatchingCost(system, windows, open_engine(system), system.settings.cost)
    (found,) = clip_errors(cost, np.stack((truth, np.zeros(4))))
    assert (found.channel, found.column, found.unit) == ("joints.position", "hinge", "rad")
    assert np.median(found.errors[0]) < 0.004  # sensors have 0.002 rad
    assert np.median(found.errors[1]) > 10.0 * np.median(found.errors[0])
    assert found.moved.max() > 0.1


@pytest.mark.medium
def test_the_table_is_in_degrees(log: amhe.Log) -> None:
    few = amhe.System.load("pendulum", CHEAP)
    result = amhe.identify(few, log, only=["load_mass"], fix={k: PENDULUM_TRUTH[k] for k in ("damping",)})
    held_out = result.found.held_out
    assert held_out is not None
    assert [one.to_end for one in held_out.horizons] == [False] * (len(held_out.horizons) - 1) + [True]
    table = horizon_table(held_out.horizons)
    assert table.head[2].startswith("after 0.1 s, n = ")
    assert " (end), n = 1" in table.head[-1]
    assert table.rows[0][0] == "hinge"
    assert "°" in table.rows[0][2]
    assert all(one.identified < one.initial for one in held_out.horizons)
    assert result.record()["held_out"]["horizons"][0]["column"] == "hinge"


NAMES = ("plain", "stribeck")


def errors(values: np.ndarray, column: str = "hip") -> ClipErrors:
    return ClipErrors("joints.position", column, "rad", values[None], np.ones(values.size))


def compared(one: np.ndarray, other: np.ndarray, horizon: float = 0.5, seed: int = 0) -> AtHorizon:
    return at_horizon(horizon, False, [[errors(one)], [errors(other)]], np.random.default_rng(seed))


def clips(seed: int, count: int = 15) -> np.ndarray:
    """Errors of clips that differ much in how hard they are."""
    return np.exp(np.random.default_rng(seed).normal(0.0, 1.0, count))


def test_pairing_sees_what_scatter_hides() -> None:
    hard = clips(0)
    noise = np.exp(np.random.default_rng(1).normal(0.0, 0.05, (2, hard.size)))
    found = compared(hard * noise[0], 0.8 * hard * noise[1])
    assert best_of([found]) == 1
    assert found.ratios[1, 0] == pytest.approx(0.8, abs=0.05)
    assert found.better(1, 0)
    text = verdict([found], NAMES, 1, 0)
    assert text.startswith("stribeck predicts better than plain: its error is smaller by ")
    assert text.endswith("after 0.5 s")


def test_models_alike_are_told_apart_as_often_as_promised() -> None:
    decided = 0
    for seed in range(200):
        noise = np.exp(np.random.default_rng([seed, 1]).normal(0.0, 0.3, (2, 15)))
        found = compared(clips(seed) * noise[0], clips(seed) * noise[1], seed=seed)
        decided += found.better(0, 1) or found.better(1, 0)
    assert decided / 200 < 0.2  # 5 % were wanted; a bootstrap over 15 uneven clips is somewhat narrow


@pytest.mark.medium
def test_horizons_are_one_test() -> None:
    """Of models alike, over four horizons that each err by themselves."""
    kept = 0
    for seed in range(150):
        noise = np.exp(np.random.default_rng([seed, 2]).normal(0.0, 0.3, (4, 2, 15)))
        found = [compared(clips(seed) * a, clips(seed) * b, seed=seed) for a, b in noise]
        kept += improves(found, 0, 1)
    assert kept / 150 < 0.05
    assert improves([compared(0.8 * clips(0), clips(0)), compared(0.9 * clips(1), clips(1))], 0, 1)


def test_few_clips_cannot_tell() -> None:
    found = compared(clips(0, 3), 0.1 * clips(0, 3))
    assert np.isnan(found.lower).all()
    assert "fewer than 4 clips" in verdict([found], NAMES, 1, 0)


def test_horizons_that_contradict_each_other_are_both_named() -> None:
    hard = clips(0)
    early, late = compared(hard, 0.5 * hard, 0.1), compared(hard, 1.2 * hard, 2.0)
    text = verdict([early, late], NAMES, best_of([early, late]), 0)
    assert text == "stribeck predicts better than plain after 0.1 s, and worse after 2 s"


def test_a_diverged_prediction_loses_and_a_missing_one_does_not_count() -> None:
    hard = clips(0)
    diverged = hard.copy()
    diverged[3] = np.inf
    found = compared(hard, diverged)
    assert best_of([found]) == 0
    assert np.isfinite(found.ratios).all()
    missing = hard.copy()
    missing[:2] = np.nan
    assert compared(missing, hard).clips == hard.size - 2


def test_only_what_all_models_predict_counts() -> None:
    hard = clips(0)
    both = [[errors(hard), errors(9.0 * hard, "knee")], [errors(0.5 * hard)]]
    found = at_horizon(0.5, False, both, np.random.default_rng(0))
    assert list(found.errors) == [("hip", "rad")]
    assert found.ratios[1, 0] == pytest.approx(0.5)


@pytest.mark.filterwarnings("error")
def test_what_all_models_lose_and_what_nobody_measured_decides_nothing() -> None:
    hard = clips(0)
    lost = np.full(hard.size, np.inf)
    both = [[errors(hard), errors(lost, "knee")], [errors(0.5 * hard), errors(lost, "knee")]]
    found = at_horizon(2.0, False, both, np.random.default_rng(0))
    assert best_of([found]) == 1 and found.ratios[0, 1] > 1.0
    unmeasured = compared(np.full(15, np.nan), hard)
    assert unmeasured.clips == 0 and best_of([unmeasured, compared(hard[:2], 0.5 * hard[:2])]) == 1
    nothing = at_horizon(0.5, False, [[errors(hard)], [errors(hard, "knee")]], np.random.default_rng(0))
    assert not nothing.errors
