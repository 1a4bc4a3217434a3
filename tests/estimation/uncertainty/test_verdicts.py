"""What stands between a value and 'identified', each read from a ledger that is made by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.statistics import Z90
from amhe_cli.estimation.core.result import Against, ParameterResult
from amhe_cli.estimation.uncertainty.derived import combinations
from amhe_cli.estimation.uncertainty.ledger import Kind, Ledger, Source, Term, term_of
from amhe_cli.estimation.uncertainty.minimum import Rival
from amhe_cli.estimation.uncertainty.verdicts import DOUBT, Evidence, verdicts

SPACE = ParameterSpace(
    (
        Parameter("mass", "kg", 4.0, 0.4, 40.0, log=True, prior_sd=0.5),
        Parameter("friction", "-", 0.6, 0.06, 6.0, log=True, prior_sd=0.5),
        Parameter("offset", "m", 0.1, -1.0, 1.0, log=False, prior_sd=0.2),
    )
)
GAIN = Source("the gain of servo", "4", 10.0, "%")


def priors(*errors: float) -> Term:
    """What each parameter owes to the prior of friction."""
    columns = np.zeros((3, 3))
    columns[: len(errors), 1] = errors
    sources = tuple(Source(f"your prior of {name}", "0.6", 65.0, "%", parameter=name) for name in SPACE.names)
    return Term("prior", columns, sources)


def term(kind: Kind, error: float, source: Source | None = None) -> Term:
    """An error of the mass alone."""
    return Term(kind, np.array([[error], [0.0], [0.0]]), () if source is None else (source,))


def evidence(sd: float = 0.05, *more: Term, **changes: Any) -> Evidence:
    """Nothing speaks against an estimate with this sd of noise, in prior sd; `more` terms are added."""
    covariance = changes.pop("covariance", sd**2 * np.eye(3))
    found = (term_of("noise", covariance), *more)
    if not any(one.kind == "prior" for one in more):
        found = (*found, priors())
    values = {
        "z": np.array([0.2, -0.2, 0.1]),
        "ledger": Ledger(found),
        "active": np.ones(3, dtype=bool),
        "idle": {},
        "misfit": (),
        "blamed": {},
        "rival": None,
        "doubled_prior": np.array([0.02, 0.0, 0.1]),
    }
    return Evidence(**(values | changes))


def mass(found: Evidence) -> ParameterResult:
    """The line of the first parameter."""
    return verdicts(SPACE, found)[0]


def texts(result: ParameterResult) -> list[str]:
    return [reason.text for reason in result.reasons]


def test_an_estimate_that_nothing_speaks_against_is_identified() -> None:
    for result in verdicts(SPACE, evidence()):
        assert (result.verdict, result.reasons, result.given) == ("identified", (), "")


def test_numbers_are_in_the_parameters_own_units() -> None:
    heavy, _, offset = verdicts(SPACE, evidence())
    assert heavy.estimate == pytest.approx(4.0 * np.exp(0.2 * 0.5))
    assert heavy.sd == pytest.approx(heavy.estimate * 0.5 * 0.05)
    assert heavy.upper == pytest.approx(heavy.estimate * np.exp(0.5 * 0.05 * Z90))
    assert heavy.shrinkage == pytest.approx(0.95)
    assert heavy.doubled_prior == pytest.approx(heavy.estimate * np.expm1(0.5 * 0.02))
    assert heavy.budget == pytest.approx({"noise": 1.0})
    assert offset.estimate == pytest.approx(0.1 + 0.1 * 0.2)
    assert (offset.sd, offset.prior_sd) == pytest.approx((0.2 * 0.05, 0.2))
    assert offset.lower == pytest.approx(offset.estimate - 0.2 * 0.05 * Z90)
    assert offset.doubled_prior == pytest.approx(0.2 * 0.1)


@pytest.mark.parametrize(
    ("sd", "verdict"),
    [(0.05, "identified"), (0.19, "identified"), (0.21, "weak"), (0.69, "weak"), (0.71, "prior")],
)
def test_the_verdict_follows_from_how_much_the_prior_is_narrowed(sd: float, verdict: str) -> None:
    assert mass(evidence(sd)).verdict == verdict


@pytest.mark.parametrize("kind", ["repeats", "minimum", "search", "declared"])
def test_a_term_that_no_number_would_remove_weakens(kind: Kind) -> None:
    result = mass(evidence(0.05, term(kind, 0.3), rival=RIVAL))
    assert result.verdict == "weak" and result.budget[kind] == pytest.approx(0.09 / 0.0925)
    (reason,) = result.reasons
    assert (reason.kind, reason.parameters) == (kind, ("mass",)) and reason.size == result.budget[kind]
    small = mass(evidence(0.05, term(kind, 0.01), rival=RIVAL))
    assert (small.verdict, small.reasons) == ("identified", ()), "4 % of the variance are no reason"


def assumed(error: float, doubted: bool = False) -> Term:
    return term("assumed", error, Source(GAIN.name, GAIN.value, 10.0, "%", doubted=doubted))


@pytest.mark.parametrize(
    ("given", "error", "verdict"),
    [
        (assumed, 0.05, "identified"),
        (assumed, 0.096, "identified"),
        (assumed, 0.098, "conditional"),
        (assumed, 2.0, "conditional"),
        (priors, 0.028, "identified"),
        (priors, 0.030, "conditional"),
        (priors, 2.0, "conditional"),
    ],
)
def test_a_number_that_somebody_gave_must_be_half_as_good_as_he_says(
    given: Callable[[float], Term], error: float, verdict: str
) -> None:
    """With noise of 0.05, twice 0.0968 is the 0.2 of a value that is determined.

    By twice the error of another unknown's prior it moves by its whole sd, where that error is 0.0289.
    """
    assert np.hypot(0.05, DOUBT * 0.0968) == pytest.approx(0.2, rel=1e-3)
    assert np.hypot(0.05, 0.0289) == pytest.approx(DOUBT * 0.0289, rel=1e-3)
    result = mass(evidence(0.05, given(error)))
    assert result.verdict == verdict
    name = {assumed: "the gain of servo, 4", priors: "your prior of friction, 0.6"}[given]
    assert result.given == (name if verdict == "conditional" else "")
    assert mass(evidence(0.21, given(error))).verdict in ("weak", "prior"), "the logs do not determine it"


def test_a_prior_that_decides_is_named_where_an_assumed_number_owes_more() -> None:
    assert mass(evidence(0.05, assumed(0.06))).verdict == "identified"
    result = mass(evidence(0.05, assumed(0.06), priors(0.05)))
    assert (result.verdict, result.given) == ("conditional", "your prior of friction, 0.6")


@pytest.mark.parametrize("wide", [0.5, 1.0, 4.0])
def test_a_ratio_is_not_identified_by_an_own_prior_that_is_wide(wide: float) -> None:
    """The logs show friction over gain to 1 %, and the gain is known to 10 %; or they show both to 1 %."""
    space = ParameterSpace(
        tuple(Parameter(n, "-", 1.0, 1e-3, 1e3, True, sd) for n, sd in zip("fg", (wide, 0.1), strict=True))
    )
    sources = tuple(Source(f"your prior of {n}", "1", parameter=n) for n in "fg")
    for rows, expected in (
        ([[1.0, -1.0]], ("conditional", "your prior of g, 1")),
        ([[1.0, -1.0], [0.0, 1.0]], ("identified", "")),
    ):
        slopes = np.array(rows) * space.prior_sd / 0.01
        inverse = np.linalg.inv(np.eye(2) + slopes.T @ slopes)
        noise = term_of("noise", inverse @ slopes.T @ slopes @ inverse)
        known = Ledger((noise, Term("prior", np.array(inverse, dtype=np.float64), sources)))
        found = Evidence(np.zeros(2), known, np.ones(2, dtype=bool), {}, (), {}, None, np.zeros(2))
        friction = verdicts(space, found)[0]
        assert (friction.verdict, friction.given) == expected


def test_the_number_that_matters_most_is_named() -> None:
    result = mass(evidence(0.05, assumed(0.2), priors(0.3)))
    assert result.verdict == "conditional" and result.given == "your prior of friction, 0.6"
    assert [reason.kind for reason in result.reasons] == ["prior", "assumed"]
    assert result.reasons[0].size > result.reasons[1].size > 0.25
    assert texts(result)[1] == "given the gain of servo, 4: known to 10 %, that leaves 11 % open"
    friction = verdicts(SPACE, evidence(0.05, priors(0.3, 0.3)))[1]
    assert friction.verdict == "weak" and not friction.given, "its own prior is nobody else's number"


def test_a_number_that_the_logs_doubt_and_when_it_acts_are_said() -> None:
    (text,) = texts(mass(evidence(0.05, assumed(0.3, doubted=True))))
    assert text == "the logs speak against the gain of servo, 4: known to 10 %, that leaves 16 % open"
    limit = term("assumed", 0.3, Source("the tilt", acts=0.123))
    (text,) = texts(mass(evidence(0.05, limit)))
    assert text == "given the tilt, which acts in 12 % of the steps: that leaves 16 % open"


@pytest.mark.parametrize("sd", [0.05, 0.3])
def test_what_no_measurement_depends_on_is_the_prior(sd: float) -> None:
    idle = {"mass": "no measurement in these logs depends on it"}
    result = mass(evidence(sd, active=np.array([False, True, True]), idle=idle))
    assert result.verdict == "prior"
    assert texts(result) == [f"{idle['mass']}: not identifiable, held at its prior"]


def test_a_value_that_the_logs_hardly_determine_says_how_far_it_went() -> None:
    near, away = (mass(evidence(0.8, z=np.array([z, 0.0, 0.0]))) for z in (0.2, -2.1))
    assert near.verdict == away.verdict == "prior"
    assert texts(near) == ["the logs hardly narrow it down: the value is your prior"]
    assert texts(away) == ["the logs hardly narrow it down: it is 2.1 prior sd from your prior"]


@pytest.mark.parametrize(
    ("sd", "verdict"), [(0.05, "model-sensitive"), (0.5, "model-sensitive"), (0.8, "prior")]
)
def test_what_speaks_against_the_model_makes_every_number_model_sensitive(sd: float, verdict: str) -> None:
    for result in verdicts(SPACE, evidence(sd, misfit=[Against("worse", "held-out clips fit worse")])):
        assert (result.verdict, texts(result)[0]) == (verdict, "held-out clips fit worse")


def test_what_speaks_against_some_values_leaves_the_others() -> None:
    found = verdicts(SPACE, evidence(blamed={SPACE.names[0]: ("it is one value of 4 joints",)}))
    assert (found[0].verdict, texts(found[0])) == ("model-sensitive", ["it is one value of 4 joints"])
    assert [one.verdict for one in found[1:]] == ["identified"] * 2


@pytest.mark.parametrize("kind", ["parts", "curvature"])
@pytest.mark.parametrize(
    ("error", "verdict"), [(0.096, "identified"), (0.098, "model-sensitive"), (3.0, "model-sensitive")]
)
def test_logs_that_contradict_themselves_are_model_sensitive(kind: Kind, error: float, verdict: str) -> None:
    apart = Source("one half and the other", apart=(np.sqrt(2.0) * error, 0.0, 0.0))
    result = mass(evidence(0.05, term(kind, error, apart)))
    assert result.verdict == verdict
    word = {
        "parts": f"the other disagree by +{100.0 * np.expm1(np.sqrt(2.0) * error * 0.5):.0f} %",
        "curvature": "bends",
    }
    assert word[kind] in texts(result)[0]
    assert mass(evidence(0.3, term(kind, error, apart))).verdict in ("weak", "prior"), "it would be, without"


@pytest.mark.parametrize(("error", "verdict"), [(0.05, "conditional"), (0.12, "weak")])
def test_a_number_that_was_given_excuses_no_contradiction(error: float, verdict: str) -> None:
    """Without the gain, and with twice the contradiction: 0.11, and 0.25, of the 0.2 that are determined."""
    apart = Source("one half and the other", apart=(error, 0.0, 0.0))
    assert mass(evidence(0.05, assumed(0.3), term("parts", error, apart))).verdict == verdict


def test_only_a_rough_model_hangs_on_contact() -> None:
    bent = term("curvature", 0.3)
    assert "details of contact" in texts(mass(evidence(0.05, bent, non_smooth=True)))[0]
    assert "contact" not in texts(mass(evidence(0.05, bent)))[0]


@pytest.mark.parametrize(
    ("side", "text"), [(0, "lower bound 0.4: the data want less"), (1, "upper bound 40: the")]
)
def test_an_estimate_at_a_bound_says_so(side: int, text: str) -> None:
    z = np.array([SPACE.bounds[side][0], 0.0, 0.0])
    assert text in texts(mass(evidence(z=z)))[0]


def test_the_end_of_a_linear_scale_at_0_is_no_bound_that_decides() -> None:
    """A joint without an armature: its interval says how large it may be."""
    linear = Parameter("armature", "kg m^2", 0.1, 0.0, 1.0, False, 0.1)
    space = ParameterSpace((*SPACE.parameters[:2], linear))
    z = np.array([0.0, 0.0, space.bounds[0][2]])
    for beyond, decides in ((0.0, False), (2.0, False), (4.0, True)):
        known = evidence(z=z, unbounded=z - beyond * evidence().ledger.sd)
        assert any(reason.kind == "bound" for reason in verdicts(space, known)[2].reasons) == decides


def test_parameters_that_are_known_only_together_name_each_other_and_their_product() -> None:
    covariance = 0.05**2 * np.array([[1.0, -0.98, 0.0], [-0.98, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = verdicts(SPACE, evidence(covariance=covariance))
    assert (
        texts(found[0]) == texts(found[1]) == ["known mostly together: mass and friction (correlation -0.98)"]
    )
    assert texts(found[2]) == []
    assert found[0].reasons[0].parameters == ("mass", "friction")
    sharp, blunt = combinations(SPACE, covariance, np.ones(3, dtype=bool))
    assert {sharp.text, blunt.text} == {"mass * friction", "mass / friction"}
    assert sharp.text == "mass * friction"
    assert sharp.sd == pytest.approx(0.5 * 0.05 * np.sqrt(2.0 * 0.02))
    assert combinations(SPACE, covariance, np.array([True, False, True])) == ()


def test_a_load_and_the_share_of_it_that_friction_takes_are_known_as_a_product() -> None:
    """1 + k is the factor: at k = 0.25, 0.1 of it is 8 %."""
    share = Parameter("load_friction", "-", 0.25, -0.2, 0.8, log=False, prior_sd=0.1)
    space = ParameterSpace((SPACE.parameters[0], share))
    covariance = np.array([[0.16**2, -0.98 * 0.16], [-0.98 * 0.16, 1.0]])
    sharp, _ = combinations(space, covariance, np.ones(2, dtype=bool))
    assert sharp.text == "mass * (1 + load_friction)" and sharp.names == ("mass", "load_friction")
    assert sharp.sd == pytest.approx(0.08 * np.sqrt(2.0 * 0.02))


def test_a_combination_shrinks_from_what_the_prior_knows_of_it() -> None:
    """A belief that is a prior may know two parameters together; logs that add nothing narrow nothing."""
    together = ((1.0, -0.98, 0.0), (-0.98, 1.0, 0.0), (0.0, 0.0, 1.0))
    prior = ParameterSpace(SPACE.parameters, together)
    found = combinations(prior, np.array(together), np.ones(3, dtype=bool))
    assert [one.shrinkage for one in found] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_combination_names_no_factor_with_an_exponent_of_zero() -> None:
    unequal = np.array([[0.5**2, 0.95 * 0.5 * 0.01, 0.0], [0.95 * 0.5 * 0.01, 0.01**2, 0.0], [0.0, 0.0, 1.0]])
    assert combinations(SPACE, unequal, np.ones(3, dtype=bool)) == ()


RIVAL = Rival(np.array([-0.4, -0.2, 0.1]), 0.4, np.array([True, False, False]), (1.02, 1.03))


def test_another_minimum_leaves_no_value_identified_in_which_it_differs() -> None:
    z = np.array([0.2, -0.2, 0.1])
    heavy, friction, _ = verdicts(SPACE, evidence(0.05, RIVAL.term(z), z=z, rival=RIVAL))
    assert heavy.verdict == "weak"
    assert heavy.sd / heavy.estimate == pytest.approx(0.5 * np.hypot(0.05, np.sqrt(0.4) * 0.6))
    assert texts(heavy) == ["another minimum explains the logs too: 3.27 kg (cost 1.03 against 1.02 here)"]
    assert friction.verdict == "identified"


def test_a_number_that_the_logs_speak_against_is_a_contradiction_and_no_condition() -> None:
    open_gain, doubted = (Source("the gain of servo", "4", 10.0, "%", doubted=d) for d in (False, True))
    assert mass(evidence(0.05, term("assumed", 0.3, open_gain))).verdict == "conditional"
    result = mass(evidence(0.05, term("assumed", 0.3, doubted)))
    assert (result.verdict, result.given) == ("model-sensitive", "")
    assert texts(result)[0].startswith("the logs speak against the gain of servo, 4: ")
