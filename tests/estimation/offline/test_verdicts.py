"""The rules by which evidence becomes a verdict, each with evidence made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.statistics import Z90
from amhe_cli.estimation.offline.combinations import combinations
from amhe_cli.estimation.offline.fits import profiles
from amhe_cli.estimation.offline.posterior import Disagreement
from amhe_cli.estimation.offline.result import ParameterResult
from amhe_cli.estimation.offline.verdicts import Evidence, Rival, Shift, verdicts

#: Two log-scaled parameters and a linear one; z = 1 is a factor of exp(0.5), or 0.2 m.
SPACE = ParameterSpace(
    (
        Parameter("mass", "kg", 4.0, 0.4, 40.0, log=True, prior_sd=0.5),
        Parameter("friction", "-", 0.5, 0.05, 5.0, log=True, prior_sd=0.5),
        Parameter("offset", "m", 0.1, -1.0, 1.0, log=False, prior_sd=0.2),
    )
)


def evidence(sd: float = 0.05, **changes: Any) -> Evidence:
    """Evidence for an ordinary estimate: each sd of z is 0.05, and nothing speaks against it."""
    plain: dict[str, Any] = {
        "z": np.array([0.4, -0.2, 0.1]),
        "covariance": sd**2 * np.eye(3),
        "own_sd": np.full(3, sd),
        "active": np.ones(3, dtype=bool),
        "idle": {"mass": "no measurement in these logs depends on it"},
        "step_ratio": np.ones(3),
        "bootstrap": np.full(3, 0.04),
        "disagreements": {},
        "shifts": [],
        "profiles": {},
        "repeats": np.ones(3),
        "unexplained": (),
        "rough": False,
        "causes": {},
    }
    return Evidence(**{**plain, **changes})


def mass(found: Evidence) -> ParameterResult:
    return verdicts(SPACE, found)[0]


def test_an_estimate_that_nothing_speaks_against_is_identified() -> None:
    for result in verdicts(SPACE, evidence()):
        assert (result.verdict, result.reasons) == ("identified", ())


def test_numbers_are_in_the_parameters_own_units() -> None:
    found = verdicts(SPACE, evidence())
    heavy, offset = found[0], found[2]
    assert heavy.estimate == pytest.approx(4.0 * np.exp(0.2))
    assert heavy.sd == pytest.approx(heavy.estimate * 0.5 * 0.05)
    assert heavy.upper == pytest.approx(heavy.estimate * np.exp(0.5 * 0.05 * Z90))
    assert heavy.bootstrap_sd == pytest.approx(heavy.estimate * 0.5 * 0.04)
    assert heavy.shrinkage == pytest.approx(0.95)
    assert offset.estimate == pytest.approx(0.1 + 0.1 * 0.2)
    assert (offset.sd, offset.prior_sd) == pytest.approx((0.2 * 0.05, 0.2))
    assert offset.lower == pytest.approx(offset.estimate - 0.2 * 0.05 * Z90)


@pytest.mark.parametrize(
    ("sd", "verdict"),
    [(0.05, "identified"), (0.19, "identified"), (0.21, "weak"), (0.69, "weak"), (0.71, "prior")],
)
def test_the_verdict_follows_from_how_much_the_prior_is_narrowed(sd: float, verdict: str) -> None:
    assert mass(evidence(sd)).verdict == verdict


def test_a_weak_one_gives_its_shrinkage_as_the_reason() -> None:
    assert mass(evidence(0.4)).reasons == ("the logs narrow the prior by 60% only",)


def test_residuals_that_repeat_are_a_reason_where_they_widen_much() -> None:
    much, little, none = verdicts(SPACE, evidence(repeats=np.array([3.3, 1.9, 1.0])))
    assert much.verdict == "identified", "the interval allows for it"
    assert "residuals repeat" in much.reasons[0] and "3.3 times" in much.reasons[0]
    assert not little.reasons and not none.reasons


def test_what_no_measurement_depends_on_is_the_prior() -> None:
    result = mass(evidence(active=np.array([False, True, True])))
    assert result.verdict == "prior"
    assert "no measurement in these logs depends on it" in result.reasons[0]


def test_a_value_far_from_its_prior_that_the_logs_hardly_determine_is_model_sensitive() -> None:
    near, away, far = (mass(evidence(0.8, z=np.array([z, 0.0, 0.0]))) for z in (0.2, 0.9, -2.1))
    assert near.verdict == "prior" and "hardly narrow it down: the value is your prior" in near.reasons[0]
    assert away.verdict == "prior" and "it is 0.9 prior sd from your prior" in away.reasons[0]
    assert far.verdict == "model-sensitive" and "2.1 prior sd from its prior" in far.reasons[0]


@pytest.mark.parametrize(
    ("ratio", "verdict"),
    [(0.71, "identified"), (1.39, "identified"), (0.69, "model-sensitive"), (1.41, "model-sensitive")],
)
def test_an_sd_that_depends_on_the_step_is_model_sensitive(ratio: float, verdict: str) -> None:
    result = mass(evidence(step_ratio=np.array([ratio, 1.0, 1.0])))
    assert result.verdict == verdict
    assert any("doubled" in reason for reason in result.reasons) == (verdict == "model-sensitive")
    assert mass(evidence(step_ratio=np.full(3, np.nan))).verdict == "identified", "it was not computed"


def test_what_speaks_against_the_model_makes_every_number_model_sensitive() -> None:
    for result in verdicts(SPACE, evidence(unexplained=["held-out clips fit worse"])):
        assert (result.verdict, result.reasons) == ("model-sensitive", ("held-out clips fit worse",))


def test_what_speaks_against_some_values_leaves_the_others() -> None:
    found = verdicts(SPACE, evidence(blamed={SPACE.names[0]: ("it is one value of 4 joints",)}))
    assert (found[0].verdict, found[0].reasons[0]) == ("model-sensitive", "it is one value of 4 joints")
    assert [one.verdict for one in found[1:]] == [one.verdict for one in verdicts(SPACE, evidence())[1:]]


def test_only_a_model_that_touches_hangs_on_contact() -> None:
    bent = np.array([0.5, 1.0, 1.0])
    assert "details of contact" in mass(evidence(step_ratio=bent, rough=True)).reasons[0]
    assert "contact" not in mass(evidence(step_ratio=bent)).reasons[0]


def test_an_assumed_number_widens_and_is_named_but_leaves_the_logs_their_say() -> None:
    wide = 0.3**2 * np.eye(3)
    rests = Shift("it rests on the gain (4): {} open", np.full(3, 0.29), np.full(3, 0.29), assumed=True)
    result = mass(evidence(covariance=wide, shifts=[rests]))
    assert result.verdict == "identified" and result.shrinkage == pytest.approx(0.7)
    assert result.reasons == ("it rests on the gain (4): 16% open, which the sd allows for",)
    assert mass(evidence(covariance=wide)).verdict == "weak", "not assumed, but open"
    much = Shift(rests.text, np.full(3, 0.6), np.full(3, 0.6), assumed=True)
    assert mass(evidence(covariance=0.61**2 * np.eye(3), shifts=[much])).verdict == "weak"


def test_what_widens_is_named_however_little_it_moves() -> None:
    step = Shift("at 1 ms it would move by {}", np.full(3, 0.05), np.full(3, 0.09))
    result = mass(evidence(0.1, shifts=[step]))
    assert result.verdict == "identified"
    assert result.reasons == ("at 1 ms it would move by +3%, which the sd allows for",)


@pytest.mark.parametrize(
    ("relative", "sd", "verdict", "noted"),
    [
        (0.30, 0.01, "model-sensitive", True),
        (0.30, 0.30, "identified", False),  # within chance: 3 sd are 0.9
        (0.10, 0.01, "identified", True),  # noted, and allowed for
        (0.03, 0.01, "identified", False),  # too small to tell
    ],
)
def test_parts_of_the_data_that_disagree(relative: float, sd: float, verdict: str, noted: bool) -> None:
    difference = np.array([np.log1p(relative) / 0.5, 0.0, 0.0])
    result = mass(evidence(disagreements={"the two halves": Disagreement(difference, sd**2 * np.eye(3))}))
    assert result.verdict == verdict
    reasons = [reason for reason in result.reasons if f"the two halves disagree by +{relative:.0%}" in reason]
    assert bool(reasons) == noted
    if noted and verdict == "identified":
        assert reasons[0].endswith("which the sd allows for")


def test_parts_that_disagree_again_and_again_need_not_disagree_by_much() -> None:
    difference = np.array([np.log1p(0.07) / 0.5, 0.0, 0.0])
    once, again = (Disagreement(difference, 1e-4 * np.eye(3), share) for share in (0.5, 1.0))
    assert mass(evidence(disagreements={"the halves": once})).verdict == "identified"
    result = mass(evidence(disagreements={"the halves": again}))
    assert result.verdict == "model-sensitive"
    assert result.reasons == ("the halves disagree by +7%, again and again",)


@pytest.mark.parametrize("z", [0.2, 1.6])
def test_an_sd_wider_than_the_priors_has_its_cause(z: float) -> None:
    causes = {"parts of the data disagree": np.full(3, 0.5), "clips differ": np.full(3, 2.0)}
    result = mass(evidence(1.5, z=np.array([z, 0.0, 0.0]), causes=causes))
    reason = "its sd is 1.5 times the prior's, which is too narrow for these logs: clips differ"
    assert reason in result.reasons
    assert "hardly narrow it down" not in "".join(result.reasons)
    assert reason not in mass(evidence(0.9, z=np.array([z, 0.0, 0.0]), causes=causes)).reasons


@pytest.mark.parametrize(
    ("relative", "verdict"), [(-0.4, "model-sensitive"), (-0.15, "identified"), (-0.02, "identified")]
)
def test_details_of_contact_that_would_move_the_estimate(relative: float, verdict: str) -> None:
    move = np.array([np.log1p(relative) / 0.5, 0.0, 0.0])
    shift = Shift("softer contacts would move it by {}", move, 0.5 * move)
    result = mass(evidence(shifts=[shift]))
    assert result.verdict == verdict
    noted = any("softer contacts would move it by" in reason for reason in result.reasons)
    assert noted == (abs(relative) > 0.05)
    chance = mass(evidence(shifts=[Shift(shift.text, move, np.zeros(3))]))
    assert (chance.verdict, chance.reasons) == ("identified", ())


@pytest.mark.parametrize(
    ("side", "text"), [(0, "lower bound 0.4: the data want less"), (1, "upper bound 40: the")]
)
def test_an_estimate_at_a_bound_says_so(side: int, text: str) -> None:
    z = np.array([SPACE.bounds[side][0], 0.0, 0.0])
    assert text in mass(evidence(z=z)).reasons[0]


def test_parameters_that_are_known_only_together_name_each_other_and_their_product() -> None:
    covariance = 0.05**2 * np.array([[1.0, -0.98, 0.0], [-0.98, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = verdicts(SPACE, evidence(covariance=covariance))
    assert found[0].reasons == ("known mostly together with friction (correlation -0.98)",)
    assert found[1].reasons == ("known mostly together with mass (correlation -0.98)",)
    assert found[2].reasons == ()
    sharp, blunt = combinations(SPACE, covariance, np.ones(3, dtype=bool))
    assert {sharp.text, blunt.text} == {"mass * friction", "mass / friction"}
    assert sharp.text == "mass * friction"
    assert sharp.sd == pytest.approx(0.5 * 0.05 * np.sqrt(2.0 * 0.02))
    assert combinations(SPACE, covariance, np.array([True, False, True])) == ()


def test_a_combination_shrinks_from_what_the_prior_knows_of_it() -> None:
    """A belief that is a prior may know two parameters together; logs that add nothing narrow nothing."""
    together = ((1.0, -0.98, 0.0), (-0.98, 1.0, 0.0), (0.0, 0.0, 1.0))
    prior = ParameterSpace(SPACE.parameters, together)
    found = combinations(prior, np.array(together), np.ones(3, dtype=bool))
    assert [one.shrinkage for one in found] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_combination_names_no_factor_with_an_exponent_of_zero() -> None:
    unequal = np.array([[0.5**2, 0.95 * 0.5 * 0.01, 0.0], [0.95 * 0.5 * 0.01, 0.01**2, 0.0], [0.0, 0.0, 1.0]])
    assert combinations(SPACE, unequal, np.ones(3, dtype=bool)) == ()


def test_a_profile_passes_through_the_estimate_within_the_bounds() -> None:
    z, sd, active = np.array([0.4, -0.2, 4.4]), np.full(3, 0.05), np.array([True, False, True])
    found = profiles(SPACE, lambda rows, at: (at - z[rows, None]) ** 2, z, sd, active, points=11)
    assert set(found) == {0, 2}
    theta, costs = found[0]
    assert theta[5] == pytest.approx(SPACE.theta_of(z)[0]) and costs[5] == pytest.approx(0.0, abs=1e-12)
    assert costs[[0, -1]] == pytest.approx(0.09)
    assert found[2][0].max() <= 1.0, "the upper bound"
    assert profiles(SPACE, lambda rows, at: at, z, sd, active, points=2) == {}


def test_another_minimum_leaves_no_value_identified_in_which_it_differs() -> None:
    rival = Rival(np.array([-0.4, -0.2, 0.1]), 0.4, np.array([True, False, False]), (1.02, 1.03))
    heavy, friction, _ = verdicts(SPACE, evidence(rival=rival))
    assert heavy.verdict == "weak"
    assert heavy.reasons[0] == "another minimum explains the logs too: 3.27 kg (cost 1.03 against 1.02 here)"
    assert friction.verdict == "identified"
