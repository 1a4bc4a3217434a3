"""Common mean and spread: against the analytic answer, and by recovering the truth."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest

from amhe_cli.api.identify import identify
from amhe_cli.core.errors import NOTE
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.estimation.uncertainty.hierarchy import SPREADS, grouped, with_common_means
from amhe_cli.estimation.uncertainty.ledger import Ledger, Source, Term
from amhe_cli.estimation.uncertainty.verdicts import Evidence, verdicts
from amhe_cli.system.system import System


def test_many_precise_values_give_their_own_mean_and_spread() -> None:
    """With values known exactly, mean and spread are those of a normal sample."""
    rng = np.random.default_rng(0)
    values = 0.5 + 0.4 * rng.normal(size=60)
    group = grouped(values, 1e-6 * np.eye(60), range(60))
    np.testing.assert_allclose(group.mean[:-1], values, atol=1e-3)
    assert group.mean[-1] == pytest.approx(values.mean(), abs=5e-3)  # the prior N(0, 1) hardly matters
    assert np.sqrt(group.covariance[-1, -1]) == pytest.approx(values.std() / np.sqrt(60), rel=0.1)
    assert group.spread[1] == pytest.approx(values.std(ddof=1), rel=0.05)
    assert group.spread[0] < values.std(ddof=1) < group.spread[2]


def test_values_that_no_data_determine_have_the_predictive_distribution() -> None:
    """The posterior of an unobserved value is the mean's, with the spread added."""
    z, covariance = np.array([0.3, 0.5, 0.4, 0.0]), np.diag([1e-4, 1e-4, 1e-4, 1.0])
    group = grouped(z, covariance, range(4))
    assert group.mean[3] == pytest.approx(group.mean[-1], abs=1e-6)
    alone = group.covariance[-1, -1]
    assert group.covariance[3, 3] == pytest.approx(alone + group.variance, rel=0.02)


def test_noisy_values_move_towards_their_mean() -> None:
    z, covariance = np.array([-0.5, 0.1, 0.4, 0.8]), 0.2 * np.eye(4)
    group = grouped(z, covariance, range(4))
    assert np.ptp(group.mean[:4]) < 0.8 * np.ptp(z)
    assert np.all(np.diag(group.covariance)[:4] < 0.2 / 0.8 + 1e-9)  # no wider than the data alone


def test_spreads_cover_the_truth() -> None:
    """Simulated values with noise: the 90 % intervals of mean and spread hold the truth about as often."""
    rng = np.random.default_rng(1)
    inside = np.zeros(2)
    for _ in range(100):
        truth = 0.3 + 0.3 * rng.normal(size=6)
        noise = 0.1
        measured = truth + noise * rng.normal(size=6)
        posterior = 1.0 / (noise**-2 + 1.0)  # under the prior N(0, 1) of the search
        group = grouped(posterior * measured / noise**2, posterior * np.eye(6), range(6))
        sd = np.sqrt(group.covariance[-1, -1])
        inside += abs(group.mean[-1] - 0.3) < 1.645 * sd, group.spread[0] < 0.3 < group.spread[2]
    assert (inside >= 82).all(), inside
    assert (SPREADS[0], SPREADS[-1]) == pytest.approx((1e-3, 4.0))


@pytest.mark.parametrize(
    ("noise", "gain", "doubted", "verdict"),
    [
        (0.02, 0.05, False, "identified"),
        (0.02, 0.3, False, "conditional"),
        (0.02, 0.3, True, "model-sensitive"),
        (0.98, 0.0, False, "prior"),
    ],
)
def test_a_mean_rests_on_what_its_values_rest_on(
    noise: float, gain: float, doubted: bool, verdict: str
) -> None:
    """A gain that is common to all logs moves the mean as it moves each value."""
    friction = Parameter("friction", "-", 0.6, 0.06, 6.0, log=True, prior_sd=0.5)
    space = ParameterSpace(tuple(friction.owned_by(owner) for owner in "abcdefgh"))
    priors = tuple(Source(f"your prior of {name}", parameter=name) for name in space.names)
    source = Source("the gain of servo", "4", 10.0, "%", doubted=doubted)
    ledger = Ledger(
        (
            Term("noise", noise * np.sqrt(1.0 - noise**2) * np.eye(8)),
            Term("prior", noise**2 * np.eye(8), priors),
            Term("assumed", gain * np.ones((8, 1)), (source,), shared=True),
        )
    )
    lines = with_common_means(space, ParameterSpace((friction,)), np.zeros(8), ledger)
    evidence = Evidence(
        z=lines.z, ledger=lines.ledger, active=np.ones(9, dtype=bool), idle={}, misfit=(), blamed={},
        profiles={}, rival=None, doubled_prior=np.full(9, np.nan), means=lines.means,
    )  # fmt: skip
    mean, *values = verdicts(lines.space, evidence)
    assert (mean.name, mean.verdict, values[0].name) == ("friction", verdict, "friction[a]")
    assert mean.given == ("the gain of servo, 4" if verdict == "conditional" else "")
    assert "the common mean of 8 values" in [reason.text for reason in mean.reasons]
    assert sum(mean.budget.values()) == pytest.approx(1.0)
    assert mean.budget.get("assumed", 0.0) == pytest.approx(values[0].budget.get("assumed", 0.0), abs=0.1)
    if verdict == "prior":
        assert mean.budget["spread"] > 0.5, "the values' priors are no more"


@pytest.mark.medium
def test_a_held_out_log_is_predicted_with_the_value_that_is_its_own(
    swing: Callable[..., Log], pendulum: System, caplog: pytest.LogCaptureFixture
) -> None:
    """Under the mean of the others it would fit worse than under the prior, and speak against every value."""
    caplog.set_level(NOTE, "amhe_cli")
    logs = [
        swing(2.0, seed=i, theta=np.array([0.55, 0.03, f, 0.006])).with_(own=["friction_loss"])
        for i, f in enumerate((0.012, 0.02, 0.06))
    ]
    found = identify(pendulum, logs[:2], held_out=logs[2], threads=1)
    values = {p.name: p for p in found.found.parameters}
    assert not [name for name, p in values.items() if p.verdict == "model-sensitive"]
    assert values["load_mass"].verdict == "identified"
    (note,) = (text for text in caplog.messages if "has its own friction_loss" in text)
    shown = re.search(r"predicted with (\S+), .* fitted logs is (\S+)", note)
    assert shown is not None
    assert [float(number) for number in shown.groups()] == pytest.approx([0.06, 0.0155], rel=0.2)


@pytest.mark.slow
def test_each_logs_own_friction_is_found(swing: Callable[..., Log], pendulum: System) -> None:
    friction = 0.035 * np.exp([0.5, -0.6, 0.1, -0.1])
    logs = [
        swing(4.0, seed=i, theta=np.array([0.55, 0.03, f, 0.006])).with_(own=["friction_loss"])
        for i, f in enumerate(friction)
    ]
    result = identify(pendulum, logs, threads=1)
    lines = [p for p in result.found.parameters if p.name.startswith("friction_loss[")]
    for line, truth in zip(lines, friction, strict=True):
        assert abs(line.estimate - truth) < 3.0 * line.sd, line.name
        assert line.verdict == "identified", (line.name, line.reasons)
    mean = result.parameters["friction_loss"]
    assert mean.lower < np.exp(np.log(friction).mean()) < mean.upper
    (spread,) = result.found.spreads
    assert spread.lower < np.log(friction).std(ddof=1) < spread.upper
    assert result.belief.names == pendulum.space.names
    here = result.belief.names.index("friction_loss")
    assert result.belief.covariance[here, here] > (mean.sd / mean.estimate) ** 2 + spread.lower**2
    assert "friction_loss: spread of its 4 values" in result.table
    assert result.record()["spreads"][0]["name"] == "friction_loss"
    assert result.model().dof_frictionloss[0] == pytest.approx(mean.estimate)


@pytest.mark.medium
@pytest.mark.parametrize("growth", [2.5, 1.0])
def test_a_drift_of_friction_is_found_and_none_where_there_is_none(
    growth: float, swing: Callable[..., Log], pendulum: System
) -> None:
    places = (0.0, 0.4, 1.0)
    logs = [
        swing(2.0, seed=i, theta=np.array([0.55, 0.03, 0.02 * growth**at, 0.006])).with_(
            trend={"friction_loss": at}
        )
        for i, at in enumerate(places)
    ]
    found = identify(pendulum, logs[::2], held_out=logs[1], threads=1).found
    start, end = (p for p in found.parameters if p.name.startswith("friction_loss["))
    assert (start.name, end.name) == ("friction_loss[start]", "friction_loss[end]")
    for line, truth in ((start, 0.02), (end, 0.02 * growth)):
        assert abs(line.estimate - truth) < 3.0 * line.sd and line.sd < 0.2 * truth, line.name
    apart = np.log(end.estimate / start.estimate)
    sd = np.hypot(start.sd / start.estimate, end.sd / end.estimate)
    assert (apart > 4.0 * sd) == (growth > 1.0)
    assert not [p.name for p in found.parameters if p.verdict == "model-sensitive"], (
        "the log between fits too"
    )
