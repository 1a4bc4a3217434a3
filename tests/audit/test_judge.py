"""The audit's judgement, and its files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amhe_cli.audit.files import compare
from amhe_cli.audit.judge import (
    ODDS,
    RATE,
    Findings,
    Said,
    Sheets,
    averaged,
    chances,
    contradicted,
    judged,
    said,
    wrong_sheets,
)
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.numbers import numbers_of


def findings(information: np.ndarray, truth: np.ndarray, sheet: np.ndarray, noise: np.ndarray) -> Findings:
    """What logs with this information and score noise say, under priors about zero."""
    precision = np.diag(sheet**-2.0)
    covariance = np.linalg.inv(information + precision)
    mean = covariance @ (information @ truth + noise)
    return Findings(mean, np.array([np.zeros(len(truth)), sheet]), information, covariance, mean)


def linear(d: int) -> np.ndarray:
    """No number is a logarithm."""
    return np.zeros(d, dtype=bool)


def likeliest(found: Findings, groups: dict, file: np.ndarray, right: np.ndarray, wide: np.ndarray) -> set:
    """The set of sheets that are most likely wrong."""
    return set(next(iter(wrong_sheets(found, Sheets(groups, file, right, wide)))))


def drawn(rng: np.random.Generator, d: int) -> tuple[np.ndarray, np.ndarray]:
    """Information of rank d, and score noise of that covariance."""
    root = rng.standard_normal((d, d))
    return root @ root.T, root @ rng.standard_normal(d)


def test_a_right_file_gives_a_standard_normal_number() -> None:
    rng, sheet = np.random.default_rng(0), np.array([0.5, 1.0, 2.0])
    t = []
    for _ in range(4000):
        information, noise = drawn(rng, 3)
        truth = sheet * rng.standard_normal(3)
        t.append(said(findings(information, truth, sheet, noise), [0, 1, 2], np.zeros(3), sheet, linear(3)).t)
    assert np.allclose(np.mean(t, axis=0), 0.0, atol=0.06)
    assert np.allclose(np.std(t, axis=0), 1.0, atol=0.05)


def test_the_files_own_prior_does_not_speak_for_it() -> None:
    information = np.array([[25.0]])
    for width in (0.1, 1.0, 10.0):  # however tightly the search was held to the file
        found = findings(information, np.array([1.0]), np.array([width]), np.zeros(1))
        logged = said(found, [0], np.zeros(1), np.array([0.1]), linear(1))
        assert np.isclose(logged.mean[0], 1.0)
        assert np.isclose(logged.sd[0], 0.2)
        assert np.isclose(logged.t[0], 1.0 / np.hypot(0.2, 0.1))


def test_more_errors_than_noise_widen_what_a_log_says() -> None:
    found = findings(np.array([[25.0]]), np.array([1.0]), np.array([10.0]), np.zeros(1))
    wider = Findings(found.mean, found.prior, found.information, found.covariance + 0.3**2, found.mean)
    assert np.isclose(
        said(wider, [0], np.zeros(1), np.ones(1), linear(1)).sd[0], np.hypot(0.2, 0.3), rtol=2e-3
    )


def test_noise_of_twice_the_sd_is_a_quarter_of_the_information() -> None:
    rng = np.random.default_rng(5)
    (information, noise), truth, sheet = drawn(rng, 3), rng.standard_normal(3), np.array([0.5, 1.0, 2.0])
    more = np.diag([0.01, 0.02, 0.03])  # of other terms of the ledger
    one, other = (
        findings(m, truth, sheet, n) for m, n in ((information, noise), (information / 4, noise / 4))
    )
    one, other = (replace(f, covariance=f.covariance + k * more) for f, k in ((one, 1.0), (other, 4.0)))
    wider = one.under_noise(2.0)
    for name in ("mean", "prior", "information", "covariance"):
        assert np.allclose(getattr(wider, name), getattr(other, name))


def test_a_log_that_says_nothing_contradicts_nothing() -> None:
    found = findings(np.zeros((2, 2)), np.array([5.0, 5.0]), np.ones(2), np.zeros(2))
    logged = said(found, [0, 1], np.zeros(2), np.ones(2), linear(2))
    assert (logged.sd > 1e4).all()
    assert not contradicted(chances(logged.t)).any()
    assert not likeliest(found, {"a": [0], "b": [1]}, np.zeros(2), np.ones(2), np.full(2, 10.0))


def test_the_wrong_number_stands_out_and_the_others_are_right_without_it() -> None:
    rng, d = np.random.default_rng(1), 5
    root = rng.standard_normal((40, d))
    information, truth, sheet = 100.0 * root.T @ root, np.zeros(d), np.full(d, 0.1)
    truth[2] = 3.0
    found = findings(information, truth, sheet, np.zeros(d))
    sheets = Sheets({i: [i] for i in range(d)}, np.zeros(d), sheet, 100.0 * sheet)
    likely = wrong_sheets(found, sheets)
    assert next(iter(likely)) == {2}
    _, chance = judged(found, sheets, likely, list(range(d)), linear(d))
    assert contradicted(chance).tolist() == [False, False, True, False, False]


def test_numbers_of_one_data_sheet_stand_out_together() -> None:
    truth, sheet = np.array([0.3, 0.3, 0.3, 0.0]), np.full(4, 0.1)
    found = findings(1e4 * np.eye(4), truth, sheet, np.zeros(4))
    of = (np.zeros(4), sheet, 10.0 * sheet)
    assert likeliest(found, {"alone": [0], "other": [3]}, *of) == set()
    assert likeliest(found, {"sheet": [0, 1, 2], "other": [3]}, *of) == {"sheet"}


def test_what_stands_out_is_that_by_bayes_rule() -> None:
    """The factor is that of the densities N(f, 1/q + W^2) and N(f, 1/q + S^2) of what the log says."""

    def density(x: float, variance: float) -> float:
        return -0.5 * (x**2 / variance + np.log(variance))

    for far in np.linspace(0.0, 2.0, 41):
        found = findings(np.array([[25.0]]), np.array([far]), np.array([0.3]), np.zeros(1))
        factor = density(far, 0.04 + 4.0) - density(far, 0.04 + 0.09)
        out = likeliest(found, {"it": [0]}, np.zeros(1), np.array([0.3]), np.array([2.0]))
        assert (out == {"it"}) == (factor > 3.0)


def test_of_tables_of_right_numbers_few_have_a_contradiction() -> None:
    rng = np.random.default_rng(2)
    tables = [contradicted(chances(rng.standard_normal(30))).any() for _ in range(1000)]
    assert 0.02 < np.mean(tables) < RATE + 0.02


def test_what_another_number_explains_as_well_contradicts_neither() -> None:
    """The log knows the sum of two numbers, and one of them is wrong."""
    information, truth, sheet = 1e4 * np.ones((2, 2)), np.array([0.0, 1.0]), np.full(2, 0.1)
    found = findings(information, truth, sheet, np.zeros(2))
    sheets = Sheets({"one": [0], "other": [1]}, np.zeros(2), sheet, 10.0 * sheet)
    likely = wrong_sheets(found, sheets)
    assert len(next(iter(likely))) == 1
    assert np.abs(said(found, [0, 1], np.zeros(2), sheet, linear(2)).t).min() > 5.0
    assert not contradicted(judged(found, sheets, likely, [0, 1], linear(2))[1]).any()


@pytest.mark.parametrize("begin", [(), (0, 1), (0, 2), (0, 1, 2)])
def test_one_wrong_number_is_told_from_two_that_make_up_for_it(begin: tuple[int, ...]) -> None:
    """The third acts as the first two together, and each of the two is believed from the beginning."""
    rng, sheet, groups = np.random.default_rng(3), np.full(3, 0.1), {i: [i] for i in range(3)}
    root = rng.standard_normal((40, 2)) @ np.array([[1.0, 0.0, 0.7], [0.0, 1.0, 0.7]])
    found = findings(1e4 * root.T @ root, np.array([0.0, 0.0, 1.0]), sheet, np.zeros(3))
    likely = wrong_sheets(found, Sheets(groups, np.zeros(3), sheet, 10.0 * sheet), frozenset(begin))
    assert next(iter(likely)) == {2}


def test_odds_of_sets_are_those_of_their_densities_however_much_a_log_knows() -> None:
    rng, d = np.random.default_rng(7), 5
    turned, _ = np.linalg.qr(rng.standard_normal((d, d)))
    information, right, wide = turned @ np.diag(10.0 ** np.arange(4, 14, 2)) @ turned.T, 0.02, 1.5
    truth = np.where(np.arange(d) < 2, 1.0, right) * rng.standard_normal(d)
    sheet = np.full(d, right)
    found = findings(information, truth, sheet, np.zeros(d))
    sheets = Sheets({i: [i] for i in range(d)}, np.zeros(d), sheet, np.full(d, wide))

    def density(wrong: frozenset) -> float:
        spread = np.linalg.inv(information) + np.diag(sheets.sd(wrong) ** 2)
        off = truth @ np.linalg.solve(spread, truth) + np.linalg.slogdet(spread)[1]
        return -0.5 * float(off) - ODDS * len(wrong)

    odds = wrong_sheets(found, sheets)
    assert len(odds) > 10
    for one, value in odds.items():
        assert value == pytest.approx(density(one) - density(frozenset()), rel=1e-3, abs=0.1)


def test_explanations_are_averaged_as_a_mixture_and_logarithms_as_the_numbers_that_they_are_of() -> None:
    sheet, at, log = np.ones(2), np.zeros(2), np.array([False, True])
    one = Said(np.array([1.0, np.log(2.0)]), np.array([0.1, 0.1]), np.zeros(2))
    other = Said(np.array([4.0, np.log(1e-9)]), np.array([0.2, 3.0]), np.zeros(2))
    mixed = averaged([one, other], [2.0, 1.0], np.zeros(2), sheet, log, -np.inf, at)
    assert np.allclose(mixed.mean, [2.0, np.log(4.0 / 3.0)])
    spread = [(2.0 * 0.1**2 + 0.2**2) / 3.0 + 2.0, 2.0 * 0.2**2 / 3.0 + 8.0 / 9.0]
    assert np.allclose(mixed.sd, np.sqrt(spread) / [1.0, 4.0 / 3.0])
    same = averaged([one, one], [0.3, 0.7], np.zeros(2), sheet, log, -np.inf, at)
    assert np.allclose([same.mean, same.sd], [one.mean, one.sd])


@pytest.mark.parametrize("truth", [0.2, 1.0, 5.0])
def test_a_mass_is_as_far_off_as_its_forces_say(truth: float) -> None:
    """A force is proportional to a mass: its error in newtons is the same, however heavy the body is."""
    rng, sd, sheet, t = np.random.default_rng(4), 0.15, 0.1, []
    for _ in range(2000):
        file, heard = truth * np.exp(sheet * rng.standard_normal()), truth + sd * rng.standard_normal()
        at = max(heard, 0.05)  # where the search ends
        found = findings(
            np.array([[(at / sd) ** 2]]), np.array([heard / at - 1.0]), np.array([50.0]), np.zeros(1)
        )
        f = np.array([np.log(file / at)])
        found = replace(found, at=np.zeros(1))
        t.append(float(said(found, [0], f, np.array([sheet]), np.array([True])).t[0]))
    assert np.mean(np.abs(t) > 2.0) < 0.06  # 0.05


ROOT = Path(__file__).parents[2]
ARM = ROOT / "examples" / "logs" / "arm.xml"

URDF = """<robot name="arm"><link name="base_link"/>
<link name="rod_link"><inertial><origin xyz="0.1 0 0"/><mass value="{mass}"/>
<inertia ixx="0.001" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="continuous"><parent link="base_link"/><child link="rod_link"/><axis xyz="0 1 0"/>
<dynamics damping="0.3" friction="0"/></joint></robot>"""
MJCF = """<mujoco><worldbody><body name="rod"><joint name="hinge_joint" axis="0 1 0" damping="0.3"/>
<inertial pos="0.1 0 0" mass="2" diaginertia="0.001 0.02 0.02"/></body></worldbody></mujoco>"""


def changed(tmp_path: Path, *pairs: tuple[str, str]) -> Path:
    text = ARM.read_text()
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "changed.xml"
    path.write_text(text)
    return path


def test_a_file_does_not_differ_from_itself() -> None:
    model = compiled(read_spec(ARM))
    found = compare(model, model)
    assert not found.differences and not any(found.alone)
    assert found.alike == len(numbers_of(model, axes=False)) + 3 + 3  # places of two bodies on others, ranges


def test_what_differs_is_listed_by_what_it_is_worth(tmp_path: Path) -> None:
    other = changed(tmp_path, ('mass="1.2"', 'mass="3.6"'), ('damping="0.4"', 'damping="0.41"'))
    found = compare(*(compiled(read_spec(path)) for path in (ARM, other)))
    first = found.differences[0]
    assert (first.of, first.what) == ("upper_arm", "mass")
    assert np.isclose(first.other[0] / first.one[0], 3.0)
    weights = [d.weight for d in found.differences]
    assert weights == sorted(weights, reverse=True)
    assert {d.what for d in found.differences} == {"mass", "inertia", "damping"}
    assert found.masses == pytest.approx((3.0, 5.4))


def test_a_weight_is_the_share_of_the_forces(tmp_path: Path) -> None:
    """A joint that only damping loads needs twice the force where damping is twice as large."""
    paths = []
    for damping in (1, 2):
        path = tmp_path / f"{damping}.xml"
        path.write_text(
            '<mujoco><option gravity="0 0 0"/><worldbody><body name="rod">'
            f'<joint name="j" damping="{damping}"/>'
            '<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/></body></worldbody></mujoco>'
        )
        paths.append(path)
    found = compare(*(compiled(read_spec(path)) for path in paths))
    assert [d.what for d in found.differences] == ["damping"]
    assert found.differences[0].weight == pytest.approx(1.0, abs=1e-3)


def test_urdf_and_mjcf_are_matched_by_names(tmp_path: Path) -> None:
    urdf, mjcf = tmp_path / "a.urdf", tmp_path / "b.xml"
    urdf.write_text(URDF.format(mass=4))
    mjcf.write_text(MJCF)
    found = compare(*(compiled(read_spec(path)) for path in (urdf, mjcf)))
    (only,) = found.differences
    assert (only.of, only.what, only.one, only.other) == ("rod_link", "mass", (4.0,), (2.0,))
    assert found.alone == ((), ())


def test_a_friction_that_the_log_wants_negative_does_not_contradict_a_file_that_has_none() -> None:
    """No number is negative: the best that may be is what the file says, and no file is better."""
    found = findings(np.array([[1e4]]), np.array([-0.1]), np.array([10.0]), np.zeros(1))
    here = [0], np.zeros(1), np.array([0.01]), linear(1)
    assert abs(said(found, *here).t[0]) > 5.0
    bounded = said(found, *here, np.zeros(1))
    assert bounded.t[0] == 0.0 and bounded.mean[0] == 0.0
    # a file that has some is as far from zero as it says
    some = said(found, [0], np.array([0.5]), np.array([0.01]), linear(1), np.zeros(1))
    assert some.mean[0] == 0.0 and some.t[0] < -20.0
    # where the log wants a number that may be, the bound says nothing
    wants = findings(np.array([[1e4]]), np.array([0.3]), np.array([10.0]), np.zeros(1))
    assert np.isclose(said(wants, *here, np.zeros(1)).t[0], said(wants, *here).t[0])
