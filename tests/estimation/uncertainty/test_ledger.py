"""The ledger of uncertainty, and parameters that logs have for themselves."""

from __future__ import annotations

import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest

from amhe_cli.api.identify import identify
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import NOTE
from amhe_cli.core.log import Log
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.statistics import root
from amhe_cli.estimation.core.information import information, marginalised
from amhe_cli.estimation.uncertainty import terms
from amhe_cli.estimation.uncertainty.fit import posterior
from amhe_cli.estimation.uncertainty.hierarchy import SPREADS, grouped, with_common_means
from amhe_cli.estimation.uncertainty.ledger import KINDS, Kind, Ledger, Source, Term, term_of
from amhe_cli.estimation.uncertainty.verdicts import Evidence, verdicts
from amhe_cli.system.system import System
from tests.estimation.core.test_agreement import rotated

SPACE = ParameterSpace(tuple(Parameter(name, "-", 1.0, 0.01, 100.0, True, 0.5) for name in "abc"))
RNG = np.random.default_rng(0)


def fit_of(slopes: FloatArray, space: ParameterSpace = SPACE, **more: Any) -> Any:
    """A final fit at z = 0 of clips with these slopes (c, d, R) and noise of sd 1."""
    clips, d, samples = slopes.shape
    weight, zero = np.ones(clips), np.zeros((clips, samples))
    told = marginalised(zero, slopes, np.zeros((clips, 0, samples)), zero + 1.0, np.zeros((clips, 0)))
    known = posterior(np.zeros(d), told, weight, space.prior_precision)
    return SimpleNamespace(
        z=np.zeros(d), space=space, information=told, weight=weight, posterior=known, **more
    )


def ledger(turn: FloatArray) -> tuple[Ledger, FloatArray]:
    """Terms of a linear problem in coordinates that `turn` (3, 3) makes of it, and their covariance."""
    rng = np.random.default_rng(3)
    fit = fit_of(rng.standard_normal((5, 3, 8)))
    hessian, scatter = (turn @ m @ turn.T for m in (fit.posterior.hessian, fit.posterior.scatter))
    inverse, gain = np.linalg.inv(hessian), turn @ rng.standard_normal((3, 2))
    known, mean = np.diag([0.3, 0.8]), np.array([1.5, -0.2])
    spread = known + np.outer(mean, mean)
    found = (
        term_of("noise", inverse @ scatter @ inverse),
        term_of("prior", inverse @ inverse, shared=True),  # its precision is 1 in every basis
        Term("assumed", gain @ root(spread), (Source("the gain"), Source("the tilt")), shared=True),
        Term("search", turn @ np.array([[0.1], [0.0], [-0.2]])),
    )
    whole = inverse @ (scatter + np.eye(3)) @ inverse + gain @ spread @ gain.T
    step = turn @ np.array([0.1, 0.0, -0.2])
    return Ledger(found), whole + np.outer(step, step)


@pytest.mark.parametrize("turn", [np.eye(3), rotated(3, 1), rotated(3, 2)])
def test_the_terms_add_up_to_the_covariance_in_any_basis(turn: FloatArray) -> None:
    straight, turned = ledger(np.eye(3))[0], ledger(turn)[0]
    np.testing.assert_allclose(turned.covariance, ledger(turn)[1], atol=1e-12)
    for one, other in zip(straight.terms, turned.terms, strict=True):
        np.testing.assert_allclose(other.covariance, turn @ one.covariance @ turn.T, atol=1e-12)
    np.testing.assert_allclose(turned.shared, turn @ straight.shared @ turn.T, atol=1e-12)
    assert np.linalg.eigvalsh(turned.covariance - turned.shared).min() > 0.0


def test_independent_assumed_values_add_up() -> None:
    """Two errors of 0.1 along one line are 0.14 there, and not 0.1."""
    found = Ledger((Term("assumed", np.array([[0.1, 0.1], [0.2, 0.2]])),))
    assert found.sd == pytest.approx(np.sqrt(2.0) * np.array([0.1, 0.2]))


def test_the_budget_shares_a_variance_out() -> None:
    found = ledger(np.eye(3))[0]
    for i in range(3):
        budget = found.budget(i)
        assert sum(budget.values()) == pytest.approx(1.0)
        assert list(budget) == [kind for kind in KINDS if kind in budget]
        assert set(budget) <= {"noise", "prior", "assumed", "search"} and min(budget.values()) > 0.0
        whole = found.variance(i, ("assumed",))
        assert budget["assumed"] == pytest.approx(whole / found.covariance[i, i])
        assert sum(variance for variance, _ in found.terms[2].of(i)) == pytest.approx(whole)
    assert "search" not in found.budget(1), "it does not move"


def test_every_kind_has_a_meaning() -> None:
    """A kind without one would be missing in every budget."""
    assert tuple(KINDS) == get_args(Kind)


def test_given_are_assumed_values_and_the_priors_of_others() -> None:
    priors = Term("prior", np.array([[0.1, 0.4], [0.3, 0.2]]), tuple(Source(n, parameter=n) for n in "ab"))
    found = Ledger((priors, Term("assumed", np.array([[0.2], [0.0]]), (Source("the gain"),))))
    assert [(round(v, 9), s.name) for v, s in found.given(0, "a")] == [(0.16, "b"), (0.04, "the gain")]
    assert [(round(v, 9), s.name) for v, s in found.given(1, "b")] == [(0.09, "a")]


def test_a_term_of_a_covariance_is_never_negative() -> None:
    found = term_of("curvature", np.diag([0.04, -0.3]))
    np.testing.assert_allclose(found.covariance, np.diag([0.04, 0.0]), atol=1e-12)


# -- what the linearisation gives ----------------------------------------------------------------------------


def test_noise_and_priors_are_all_of_a_linear_problem() -> None:
    """H^-1 (B + P) H^-1; each prior has its own error, exactly, whatever is known together."""
    together = ((1.0, 0.6, 0.0), (0.6, 1.0, 0.0), (0.0, 0.0, 1.0))
    space = ParameterSpace(SPACE.parameters, together)
    problem = SimpleNamespace(system=SimpleNamespace(edits=SimpleNamespace(bodies={})))
    fit = fit_of(RNG.standard_normal((6, 3, 10)) * [[1.0], [1.0], [0.0]], space, problem=problem)
    both = Ledger((terms.noise(fit), terms.prior(fit)))
    np.testing.assert_allclose(both.covariance, fit.posterior.covariance, atol=1e-12)
    assert both.sd[2] == pytest.approx(1.0) and both.budget(2) == pytest.approx({"prior": 1.0})
    assert [source.parameter for source in both.terms[1].sources] == list("abc")
    assert str(both.terms[1].sources[0]) == "your prior of a (1)"
    assert both.terms[1].sources[0].times() == "50 %"


def test_an_unfinished_search_and_a_declared_error_are_terms() -> None:
    settings: Any = SimpleNamespace(identify=SimpleNamespace(model_error={"b": 0.05}))
    problem = SimpleNamespace(settings=settings)
    fit = fit_of(RNG.standard_normal((6, 3, 10)), left=np.array([0.3, 0.0, -0.1]), problem=problem)
    assert Ledger((terms.search(fit),)).sd == pytest.approx([0.3, 0.0, 0.1])
    declared = terms.declared(fit)
    assert Ledger((declared,)).sd == pytest.approx([0.0, 0.1, 0.0]), "5 % of a prior of sd 50 %"
    assert declared.shared


def test_curvature_is_what_wider_samples_add(monkeypatch: pytest.MonkeyPatch) -> None:
    slopes = RNG.standard_normal((6, 3, 10))
    fit, wide = fit_of(slopes), fit_of(0.5 * slopes)
    other = {id(fit): wide.posterior, id(wide): fit.posterior}
    monkeypatch.setattr(terms, "doubled_step", lambda one: other[id(one)])
    added = terms.curvature(fit)
    np.testing.assert_allclose(fit.posterior.covariance + added.covariance, wide.posterior.covariance)
    assert not terms.curvature(wide).covariance.any(), "none where they are sharper"


# -- what repeats --------------------------------------------------------------------------------------------


def repeating(residual: FloatArray) -> tuple[float, float]:
    """Of a parameter that moves every residual (c, R) alike: its variance, and what repeating adds."""
    clips, samples = residual.shape
    observed = SimpleNamespace(mask=np.ones((clips, samples), dtype=bool), width=1)
    cost = SimpleNamespace(
        times=None, clips=SimpleNamespace(observed=[observed]), settings=SimpleNamespace(huber=100.0)
    )
    slopes: Any = SimpleNamespace(
        cost=cost,
        residual=residual,
        gain=np.ones((clips, 1, samples)),
        bend=np.zeros_like(residual),
        first=SimpleNamespace(mean=np.zeros((clips, 0))),
        averaged=False,
        completed=np.ones(clips, dtype=bool),
    )
    weight = np.ones(clips)
    own = posterior(np.zeros(1), information(slopes), weight, np.eye(1))
    space = ParameterSpace(SPACE.parameters[:1])
    term = terms.repeats(SimpleNamespace(slopes=slopes, weight=weight, posterior=own, space=space))  # type: ignore[arg-type]
    assert term.shared
    return float(own.inverse[0, 0]), float(term.covariance[0, 0])


def test_errors_that_repeat_count_once_for_all_clips() -> None:
    rng = np.random.default_rng(0)
    slow = np.sin(np.arange(60) / 20.0 + rng.uniform(0.0, 6.0, (12, 1))) + 0.1 * rng.standard_normal((12, 60))
    (_, one), (variance, twelve) = (repeating(r) for r in (slow[:1], slow))
    assert one == pytest.approx(0.0, abs=0.01), "one clip is what it counts for"
    left = 1.0 / (twelve + variance) - 1.0
    assert left == pytest.approx((1.0 / variance - 1.0) / 12.0, rel=0.15), "twelve know no more than one"


def test_white_residuals_add_nothing() -> None:
    assert repeating(np.random.default_rng(1).standard_normal((12, 60)))[1] == pytest.approx(0.0, abs=1e-9)


def test_what_repeats_leaves_no_less_than_the_prior_that_it_is_judged_under() -> None:
    assert 0.0 < sum(repeating(np.repeat(np.sin(np.arange(60) / 20.0)[None], 12, axis=0) * 1e3)) <= 1.0


def test_errors_of_one_cause_add_up_exactly_in_any_direction() -> None:
    """(root(A) + root(B))^2 of the logs' shared part A and the belief's B, whatever their axes."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        systematic = (lambda m: 0.01 * m @ m.T)(rng.normal(size=(3, 3)))
        prior = systematic + 0.05 * np.eye(3)
        space = ParameterSpace(
            SPACE.parameters, tuple(map(tuple, prior.tolist())), tuple(map(tuple, systematic.tolist()))
        )
        fit = fit_of(rng.normal(size=(4, 3, 3)), space)
        shared = Term("assumed", 0.1 * rng.normal(size=(3, 4)), shared=True)
        found = Ledger(tuple(terms.inherited(fit, [shared])))
        pull = fit.posterior.pull
        rest = (np.eye(3) - pull) @ shared.errors
        both = root(rest @ rest.T) + root(pull @ systematic @ pull.T)
        np.testing.assert_allclose(found.shared, both @ both, atol=1e-10)
    assert terms.inherited(fit_of(RNG.normal(size=(4, 3, 3))), []) == []


def test_errors_of_one_named_cause_cancel_and_those_of_a_load_are_another_loads() -> None:
    """A belief that errs by e, and logs that would err by e' for one cause: together by G e + (1 - G) e'."""
    rng = np.random.default_rng(1)
    known, own = rng.normal(size=(2, 3, 2))
    systematic = 0.04 * known @ known.T
    prior = systematic + 0.05 * np.eye(3)
    rows = (tuple(map(tuple, matrix.tolist())) for matrix in (prior, systematic))
    owed = tuple(zip(("tilt", "lever"), map(tuple, (0.2 * known.T).tolist()), strict=True))
    space = ParameterSpace(SPACE.parameters, *rows, owed)
    fit = fit_of(rng.normal(size=(4, 3, 3)), space)
    sources = (Source("tilt"), Source("lever", of_load=True))
    found = Ledger(tuple(terms.inherited(fit, [Term("assumed", own, sources, shared=True)])))
    pull = fit.posterior.pull
    before, after = pull @ (0.2 * known), (np.eye(3) - pull) @ own
    one = before[:, 0] + after[:, 0]
    squares = sum(np.outer(e, e) for e in (one, before[:, 1], after[:, 1]))
    np.testing.assert_allclose(found.shared, squares, atol=1e-8)
    assert set(found.owed) == {"tilt", "lever"}


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


@pytest.mark.medium
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
        rival=None, doubled_prior=np.full(9, np.nan), means=lines.means,
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
