"""Parts of the data: what they know nothing of they do not contradict, and what they differ by is found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.statistics import among
from amhe_cli.estimation.core.information import marginalised
from amhe_cli.estimation.uncertainty import parts as module
from amhe_cli.estimation.uncertainty.fit import posterior
from amhe_cli.estimation.uncertainty.ledger import Source, Term
from amhe_cli.estimation.uncertainty.parts import HALVES, MANY, names_of, parts, report_drift
from amhe_cli.report.identification_page import _run_table
from tests import conftest

#: What a model lacks is not looked for here.
pytestmark = pytest.mark.usefixtures("unexplained")

#: Clips of each log, and residuals of each clip; its slopes are orthogonal, of length 1.
CLIPS, SAMPLES = 4, 6


class Named:
    """Stands for a log."""

    def __init__(self, source: str) -> None:
        self.source = source


def compared(truths: FloatArray, known: Sequence[FloatArray], rng: np.random.Generator) -> Term:
    """What parts say of linear logs with noise of sd 1 and the prior N(0, 1).

    Args:
        truths: The values of each log, shape (k, d).
        known: Slopes of each log, rows of what it knows, (m, d) each; every clip has them.
        rng: Draws the noise.
    """
    k, d = truths.shape
    logs = [Named(f"log{i}") for i in range(k)]
    gains, residuals = np.zeros((k * CLIPS, d, SAMPLES)), rng.standard_normal((k * CLIPS, SAMPLES))
    for i, rows in enumerate(known):
        clips = slice(i * CLIPS, (i + 1) * CLIPS)
        gains[clips, :, : len(rows)] = rows.T / np.sqrt(CLIPS)
    truth = np.repeat(truths, CLIPS, axis=0)

    def found(z: FloatArray) -> Any:
        off = residuals + np.einsum("cd,cdr->cr", z - truth, gains)
        nothing = np.zeros((len(gains), 0, SAMPLES)), np.zeros((len(gains), 0))
        return marginalised(off, gains, nothing[0], np.ones_like(off), nothing[1])

    weight, prior, zero = np.ones(k * CLIPS), np.eye(d), np.zeros(d)
    z = posterior(zero, found(zero), weight, prior).step
    channel = SimpleNamespace(channel=SimpleNamespace(key="joints.position", quantity="position"))
    slopes = SimpleNamespace(cost=SimpleNamespace(clips=SimpleNamespace(observed=[channel])))
    problem: Any = SimpleNamespace(clips=[SimpleNamespace(log=log) for log in logs for _ in range(CLIPS)])
    joint = posterior(z, found(z), weight, prior)
    fit: Any = SimpleNamespace(
        z=z, problem=problem, information=found(z), weight=weight, posterior=joint, slopes=slopes
    )
    return parts(fit, with_halves=False)


ONE = np.array([[100.0]])  # known to 0.01
NOTHING = np.zeros((0, 1))


@pytest.mark.parametrize("away", [0.0, 5.0, 50.0])
def test_a_part_that_knows_nothing_contradicts_nothing(away: float) -> None:
    truths = np.full((2, 1), away)
    for known in ([ONE, NOTHING], [NOTHING, ONE], [ONE, 1e-3 * ONE]):
        assert not compared(truths, known, np.random.default_rng(0)).covariance.any()


def test_a_part_that_knows_nothing_has_no_share_in_the_spread_of_others() -> None:
    truths = np.array([[-0.5], [0.5], [0.0], [0.0]])
    two, four = (
        compared(truths[:k], [ONE, ONE, NOTHING, NOTHING][:k], np.random.default_rng(0)) for k in (2, 4)
    )
    assert {source.name for source in four.sources} == {"log0 and log1"}
    assert four.covariance[0, 0] == pytest.approx(two.covariance[0, 0], rel=0.01)


def test_two_that_differ_by_d_have_a_variance_of_half_its_square() -> None:
    found = compared(np.array([[0.0], [0.7]]), [ONE, ONE], np.random.default_rng(1))
    (source,) = found.sources
    (apart,) = source.apart
    assert source.name == "log0 and log1"
    assert apart == pytest.approx(0.7, abs=0.05)
    # the score of four clips has the sd of its noise, or nearly; chance are three sd of the difference
    chance = 9.0 * 2.0 * 0.01**2
    assert found.covariance[0, 0] == pytest.approx(0.5 * (apart**2 - chance), rel=0.005)
    assert not found.shared, "more logs narrow it"


def test_parts_that_know_other_combinations_agree() -> None:
    """A motor of unknown gain shows gain / mass, a known one the mass: 47 % of contradiction, once."""
    rng, ratio, mass = np.random.default_rng(2), np.array([[70.0, -70.0]]), np.array([[0.0, 100.0]])
    for _ in range(100):
        truth = np.tile(2.0 * rng.standard_normal(2), (2, 1))
        assert not compared(truth, [ratio, mass], rng).covariance.any()
    wrong = compared(np.array([[0.0, 0.0], [0.4, 0.4]]), [ratio, np.diag([100.0, 100.0])], rng)
    assert not wrong.covariance.any(), "the ratio is the same"
    wrong = compared(np.array([[0.0, 0.0], [0.4, -0.4]]), [ratio, np.diag([100.0, 100.0])], rng)
    assert (wrong.errors[0] * wrong.errors[1]).max() < 0.0 and wrong.covariance[0, 0] > 0.01


@pytest.mark.parametrize("weak", [0.5, 1.0, 30.0])
@pytest.mark.parametrize("sharp", [1e3, 1e5, 1e7])
def test_a_contradiction_in_what_is_known_sharply_is_found_beside_what_is_not(
    sharp: float, weak: float
) -> None:
    truths, known = np.array([[0.0, 0.0], [20.0 / sharp, 0.0]]), np.diag([sharp, weak])
    found = compared(truths, [known, known], np.random.default_rng(5))
    assert sharp * np.sqrt(found.covariance[0, 0]) == pytest.approx(20.0 / np.sqrt(2.0), rel=0.2)


def test_chance_is_no_contradiction() -> None:
    rng, known = np.random.default_rng(3), np.diag([100.0, 30.0, 3.0])
    found = [compared(np.zeros((4, 3)), [known] * 4, rng).covariance.any() for _ in range(200)]
    assert np.mean(found) < 0.03  # of the 0.3 % of three sd, and the uncertain scatter of four clips


@pytest.mark.medium
@pytest.mark.parametrize("spread", [0.2, 1.0])
def test_the_variance_between_logs_is_recovered_on_average(spread: float) -> None:
    rng, known, k = np.random.default_rng(4), 100.0 * np.eye(3), 5
    found = []
    for _ in range(200):
        truths = np.zeros((k, 3))
        truths[:, 1] = rng.normal(0.0, spread, k)
        found.append(compared(truths, [known] * k, rng).covariance)
    mean = np.mean(found, axis=0)
    chance = 0.01**2 * (among(k * (k - 1) // 2 * 3, 3.0) ** 2 - 1.0)
    assert mean[1, 1] == pytest.approx(spread**2 - chance, rel=0.12)  # 800 degrees of freedom: 5 %
    assert mean[[0, 2], [0, 2]] == pytest.approx(0.0, abs=5e-3 * spread**2)


def test_many_logs_are_compared_by_halves() -> None:
    truths = np.repeat([[0.0], [0.5]], MANY // 2, axis=0)
    found = compared(truths, [ONE] * MANY, np.random.default_rng(0))
    assert [source.name for source in found.sources] == ["the earlier logs and the later logs"]
    assert found.covariance[0, 0] == pytest.approx(0.125, rel=0.1)


def test_a_drift_beyond_noise_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    space = ParameterSpace(tuple(Parameter(f"friction{i}", "-", 0.5, 0.01, 5.0, True, 0.5) for i in range(9)))
    apart = np.zeros(9)
    apart[4:7] = np.log1p([0.2, 0.4, 0.01]) / 0.5
    errors = (apart / np.sqrt(2.0))[:, None]
    elsewhere, halves = (Source(name, apart=tuple(apart)) for name in ("a and b", " and ".join(HALVES)))
    fit: Any = SimpleNamespace(space=space, posterior=SimpleNamespace(sd=np.full(9, 0.1)))
    report_drift(fit, Term("parts", errors, (elsewhere,)))
    assert not caplog.messages
    report_drift(fit, Term("parts", errors, (halves,)))
    (text,) = caplog.messages
    assert "their second half wants friction5 +40 %, friction4 +20 % against the first:" in text


def test_logs_are_named_by_their_files_as_far_as_they_differ() -> None:
    def named(*sources: str) -> list[str]:
        return list(names_of([Named(source) for source in sources]).values())  # type: ignore[misc]

    assert named("a/x.mcap", "b/y.mcap") == ["x.mcap", "y.mcap"]
    assert named("a/x.mcap", "b/x.mcap") == ["a/x.mcap", "b/x.mcap"]
    assert named("a/x.mcap", "a/x.mcap") == ["x.mcap #1", "x.mcap #2"]


# -- whole identifications -----------------------------------------------------------------------------------

CART = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="x"/></actuator></mujoco>
"""
MASS = {"nominal": 1.0, "prior_sd": 0.5, "targets": [{"body": "cart", "set": "mass"}]}
GAIN = {"nominal": 1.3, "prior_sd": 0.5, "targets": [{"actuator": "motor", "set": "gain"}]}


def cart(xml: tuple[str, str] = ("", ""), assumed: Any = 0, **parameters: dict[str, Any]) -> amhe.System:
    """A cart that a motor pushes, with a change of its model; everything but what is `assumed` is exact."""
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(CART.replace(*xml) if xml[0] else CART),
        parameters=parameters,
        signals={
            "state": {"joints": ["x"], "noise": {"position": 0.001, "velocity": 0.02}},
            "force": {"actuators": ["motor"], "quantity": "effort"},
        },
        settings={
            "clips": {"count": 24, "length": [0.5, 0.5], "still": 0.0},
            "identify": {"assumed": assumed, "iterations": 8},
        },
        name="cart",
        warn=False,
    )


def pushed(
    system: amhe.System, *, begin: float = 0.0, seconds: float = 12.0, seed: int = 0, stiffness: float = 0.0
) -> amhe.Log:
    """A cart of 2 kg that is pushed from `begin` [s] on."""
    rng, time = np.random.default_rng(seed), 0.01 * np.arange(round(seconds / 0.01) + 1)
    force = np.where(time >= begin, 6.0 * np.sin(5.0 * time) + 4.0 * np.cos(11.0 * time), 0.0)
    speed, place = np.zeros((2, len(time)))
    for k in range(len(time) - 1):
        speed[k + 1] = speed[k] + 0.01 * (force[k] - stiffness * place[k]) / 2.0
        place[k + 1] = place[k] + 0.01 * speed[k + 1]
    state = {
        "time": time,
        "position": place + rng.normal(0.0, 0.001, len(time)),
        "velocity": speed + rng.normal(0.0, 0.02, len(time)),
    }
    return amhe.Log.from_arrays({"state": state, "force": {"time": time, "effort": force}}, system)


def test_a_cart_that_is_pushed_in_one_half_only_is_identified() -> None:
    """Its second half wanted +54 % (526 sd) once."""
    system = cart(mass=MASS)
    result = amhe.identify(system, pushed(system, begin=6.0), threads=1)
    mass = result.parameters["mass"]
    assert mass.verdict == "identified" and not any("drift within" in text for text in result.warnings)
    assert mass.lower < 2.0 < mass.upper and mass.sd < 0.01
    assert "parts" not in mass.budget


@pytest.mark.medium
def test_logs_of_an_unknown_and_of_a_known_motor_agree() -> None:
    """They disagreed by 47 % once, and the order of logs says nothing."""
    system = cart(mass=MASS, gain=GAIN)
    unknown, known = pushed(system), pushed(system, seed=1).with_(known={"gain": 1.0})
    results = [amhe.identify(system, logs, threads=1) for logs in ([unknown, known], [known, unknown])]
    for result in results:
        mass = result.parameters["mass"]
        assert mass.verdict == "identified" and "parts" not in mass.budget
        assert mass.lower < 2.0 < mass.upper and mass.sd < 0.02
    one, other = (result.parameters["mass"] for result in results)
    assert other.estimate == pytest.approx(one.estimate, abs=one.sd)


QUICK = {"clips": {"count": 6, "length": [0.4, 0.6]}, "identify": {"iterations": 4, "first_state": "never"}}


@pytest.mark.medium
def test_runs_are_told_apart_in_the_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system, logs, dampings = amhe.System.load("pendulum", QUICK), [], (0.033, 0.035, 0.041)
    for i, damping in enumerate(dampings):
        monkeypatch.setitem(conftest.PENDULUM_TRUTH, "damping", damping)
        path = conftest.write_pendulum_log(tmp_path / f"run{i + 1}.mcap", 4.0, seed=i)
        logs.append(amhe.read_log(path, system))
    truth = {name: conftest.PENDULUM_TRUTH[name] for name in ("friction_loss", "armature", "load_mass")}
    result = amhe.identify(system, logs, fix=truth, threads=1)
    damping = result.parameters["damping"]
    (reason,) = (reason for reason in damping.reasons if reason.kind == "parts")
    assert reason.text.startswith("run1.mcap and run3.mcap disagree by +")
    for run, value in zip(result.found.runs, dampings, strict=True):
        estimate, sd = run.values["damping"]
        assert abs(estimate - value) < 5.0 * sd
    # of the differences only what chance does not explain counts
    assert 0.5 < damping.sd / np.std(dampings, ddof=1) < 1.2
    table = _run_table(result.found)
    assert table.head[1:-2] == ("run1.mcap", "run2.mcap", "run3.mcap")
    assert result.record()["runs"][0]["log"] == "run1.mcap"


def test_a_half_stands_where_its_fit_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind contacts the fit of a search that has settled is one more step, and its end counts."""
    prior, weight, slope = np.zeros((1, 1)), np.ones(1), np.ones((1, 1, 1))
    nothing = np.zeros((1, 0, 1)), np.zeros((1, 0))

    def fitted(part: Any, state: Any) -> Any:
        """A linear log that wants 2, seen from 1.5."""
        told = marginalised(np.full((1, 1), 1.5 - 2.0), slope, nothing[0], np.ones((1, 1)), nothing[1])
        return SimpleNamespace(
            z=np.array([1.5]), information=told, weight=weight,
            posterior=posterior(np.zeros(1), told, weight, prior),
        )  # fmt: skip

    state = SimpleNamespace(z=np.ones(1))
    monkeypatch.setattr(module, "final_fit", fitted)
    monkeypatch.setattr(module, "_second_half", lambda _: np.arange(8) >= 4)
    monkeypatch.setattr(module.search, "restart", lambda *_: state)
    monkeypatch.setattr(module.search, "advance", lambda *_: state)
    first = SimpleNamespace(of=lambda _: SimpleNamespace(forgotten=None))
    joint: Any = SimpleNamespace(
        problem=SimpleNamespace(part=lambda _: SimpleNamespace(non_smooth=True)),
        finding=SimpleNamespace(z=np.array([0.5])), slopes=SimpleNamespace(first=first),
    )  # fmt: skip
    for half in module._halves(joint, refitted=True).values():
        assert half.step == pytest.approx([1.5]), "from 0.5 to 2"
