"""Held-out clips: a right model predicts them as it fits, and what does not is never called identified."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.estimation.core.result import Identification
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.uncertainty.fit import Scored
from amhe_cli.estimation.validation.held_out import misses_more, worse
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP, TRUTH


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
    assert "held-out clips fit worse than under the prior" in result.unexplained[0]
    assert "no value is called identified" in caplog.text


@pytest.mark.medium
def test_a_load_that_no_fitted_log_carried_does_not_carry_over(pendulum, swing) -> None:
    heavy = TRUTH * [1.15, 1.0, 1.0, 1.0]
    result = identify(pendulum, [swing(4.0)], [swing(2.5, seed=5, theta=heavy)], IdentifyOptions())
    assert values_of(result) == {"model-sensitive"}
    assert any("of held-out clips" in reason for reason in result.unexplained)


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
    assert not any("held-out" in text for text in result.unexplained)


@pytest.mark.medium
def test_what_the_model_misses_says_what_to_do(pendulum, swing, caplog) -> None:
    """Commands that act 40 ms late, which the model does not know of: no number is called identified."""
    log = swing(4.0)
    command = log["command.position"]
    late = Series(np.roll(command.values, -20, axis=0), command.valid, command.sampled, command.columns)
    result = identify(
        pendulum, [Log(log.dt, {**log.series, "command.position": late}, "late")], None, IdentifyOptions()
    )
    assert "the model misses joints.position by" in caplog.text
    assert values_of(result) <= {"model-sensitive", "prior"}
    (missed, *_) = [reason for reason in result.unexplained if "times its noise" in reason]
    assert "the commands' delay" in missed and "noise: {" in missed


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
    none: Any = None
    return Scored(none, [np.full(3, 70.0 * loss)], (time,), np.full(3, 2.0), none)
