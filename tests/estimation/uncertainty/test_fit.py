"""A fit that leaves a misfit, and the summary of a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log, Series
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.conclude import PARTS, Search, conclude
from amhe_cli.estimation.core.agreement import difference
from amhe_cli.estimation.core.information import Information, information, marginalised
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.search import SearchState
from amhe_cli.estimation.offline.watch import Watch
from amhe_cli.estimation.uncertainty.fit import FinalFit, doubled_prior, doubled_step, final_fit, posterior
from amhe_cli.estimation.uncertainty.misfit import (
    held_fixed,
    left_out,
    report_misfit,
    shared_by_joints,
    unexplained,
)
from amhe_cli.system.system import System
from tests.estimation.conftest import TRUTH

TRUE = np.array([0.5, -0.3])


def linear(clips: int, noise: float = 1.0, seed: int = 0) -> Information:
    """Information at z = 0 of clips with residuals G (z - TRUE) + noise, declared as noise of sd 1."""
    rng = np.random.default_rng(seed)
    gz = rng.standard_normal((clips, 2, 30)) * [[1.0], [0.3]]
    residual = noise * rng.standard_normal((clips, 30)) - np.einsum("d,cdr->cr", TRUE, gz)
    nothing = np.zeros((clips, 0, 30)), np.zeros((clips, 0))
    return marginalised(residual, gz, nothing[0], np.ones((clips, 30)), nothing[1])


def least_squares(found: Information, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    hessian = found.matrix.sum(axis=0) + prior
    return -np.linalg.solve(hessian, found.score.sum(axis=0)), np.linalg.inv(hessian)


def test_the_estimate_is_that_of_regularised_least_squares() -> None:
    found, prior = linear(20), np.diag([1.0, 4.0])
    result = posterior(np.zeros(2), found, np.ones(20), prior)
    assert result.step == pytest.approx(least_squares(found, prior)[0])


def test_a_prior_of_twice_the_sd_weighs_a_quarter() -> None:
    """The estimate moves to that of least squares under such a prior of one parameter."""
    found, prior, z = linear(3), np.array([[40.0, 12.0], [12.0, 30.0]]), np.array([0.1, 0.2])
    own = posterior(z, found, np.ones(3), prior)
    problem = SimpleNamespace(active=np.ones(2, dtype=bool))
    fit: Any = SimpleNamespace(problem=problem, posterior=own, information=found, weight=np.ones(3), z=z)
    for i, wider in enumerate(([[10.0, 6.0], [6.0, 30.0]], [[40.0, 6.0], [6.0, 7.5]])):
        moved = posterior(z, found, np.ones(3), np.array(wider)).step[i] - own.step[i]
        assert doubled_prior(fit)[i] == pytest.approx(moved) and abs(moved) > 1e-3
    problem.active[:] = False
    assert not doubled_prior(fit).any()


def test_under_white_noise_the_sandwich_is_the_inverse_of_the_information() -> None:
    found = linear(2000)
    result = posterior(np.zeros(2), found, np.ones(2000), np.eye(2))
    exact = least_squares(found, np.eye(2))[1]
    np.testing.assert_allclose(
        result.covariance, exact, rtol=0.1, atol=0.05 * np.sqrt(exact[0, 0] * exact[1, 1])
    )


def test_noise_of_twice_the_declared_sd_doubles_the_sd() -> None:
    plain, loud = (posterior(np.zeros(2), linear(2000, n), np.ones(2000), np.eye(2)) for n in (1.0, 2.0))
    assert loud.sd / plain.sd == pytest.approx(2.0, rel=0.1)


def test_with_few_clips_the_declared_noise_counts_for_more_than_their_scatter() -> None:
    few = posterior(np.zeros(2), linear(3, noise=0.0), np.ones(3), np.eye(2))
    white = np.linalg.inv(few.hessian)
    assert (few.sd > 0.8 * np.sqrt(np.diag(white))).all(), "no scatter is no proof of no noise"
    many = posterior(np.zeros(2), linear(1000, noise=0.0), np.ones(1000), np.eye(2))
    assert (many.sd < 0.3 * np.sqrt(np.diag(np.linalg.inv(many.hessian)))).all()


def test_the_sd_is_the_spread_of_estimates_over_data() -> None:
    results = [
        posterior(np.zeros(2), linear(60, 1.5, seed), np.ones(60), 1e-9 * np.eye(2)) for seed in range(200)
    ]
    spread = np.std([result.step for result in results], axis=0)
    # clips are few enough for the declared noise of 1 to hold a seventh of the weight
    assert np.mean([result.sd for result in results], axis=0) / spread == pytest.approx(0.95, abs=0.15)


def test_a_clip_of_weight_zero_is_left_out() -> None:
    found, weight = linear(10), np.ones(10)
    weight[7:] = 0.0
    part = Information(*(getattr(found, name)[:7] for name in Information.__slots__))
    left, alone = (posterior(np.zeros(2), f, w, np.eye(2)) for f, w in ((found, weight), (part, np.ones(7))))
    assert left.step == pytest.approx(alone.step)
    np.testing.assert_allclose(left.covariance, alone.covariance)


def test_independent_data_disagree_by_no_more_than_their_sd_says() -> None:
    ratios = []
    for seed in range(150):
        one, other = (
            posterior(np.zeros(2), linear(60, seed=s), np.ones(60), np.eye(2))
            for s in (2 * seed, 2 * seed + 1)
        )
        chance = difference((one.noise, other.noise), (one.pull, other.pull), np.eye(2))
        ratios.append((one.step - other.step) / np.sqrt(chance.diagonal()))
    assert np.std(ratios, axis=0) == pytest.approx(1.0, abs=0.15)


@pytest.mark.medium
@pytest.mark.parametrize("width", [1, 6])
def test_estimates_under_a_robust_loss_scatter_as_their_covariance_says(width: int) -> None:
    """With few clips, errors of their own, and a loss that counts the norm of so many columns."""
    unknowns, clips, samples, errors = 4, 12, 40, []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        gz, gx = (rng.standard_normal((clips, n, samples * width)) for n in (unknowns, 2))
        noise = rng.standard_normal((clips, samples * width))
        noise += np.einsum("cx,cxr->cr", rng.standard_normal((clips, 2)), gx)
        observed = SimpleNamespace(mask=np.ones((clips, samples), dtype=bool), width=width)
        cost = SimpleNamespace(
            clips=SimpleNamespace(observed=[observed]), settings=SimpleNamespace(huber=3.0), times=None
        )
        z, nothing = np.zeros(unknowns), np.zeros((unknowns, unknowns))
        for _ in range(4):
            slopes: Any = SimpleNamespace(
                cost=cost, residual=noise + np.einsum("d,cdr->cr", z, gz),
                gain=np.concatenate((gz, gx), axis=1), bend=0.0,
                first=SimpleNamespace(mean=np.zeros((clips, 2))), averaged=False,
                completed=np.ones(clips, dtype=bool),
            )  # fmt: skip
            result = posterior(z, information(slopes), np.ones(clips), nothing)
            z = z + result.step
        errors.append(z @ np.linalg.solve(result.covariance, z) / unknowns)
    assert np.mean(errors) == pytest.approx(1.0, abs=0.1)


def changed(log: Log, key: str, change: Callable[[np.ndarray], np.ndarray]) -> Log:
    """The log with other values of one series between 2.45 and 2.9 s, within its fifth clip of 0.6 s."""
    old, time = log[key], np.arange(log.steps) * log.dt
    values = np.where(((time > 2.45) & (time < 2.9))[:, None], change(old.values), old.values)
    return Log(log.dt, {**log.series, key: Series(values, old.valid, old.sampled, old.columns)}, "swing")


def at_truth(pendulum: System, log: Log) -> tuple[Problem, SearchState]:
    """A search of a log that has found the truth."""
    pool = ClipPool(pendulum, [whole(log)], pendulum.settings.clips)
    problem = Problem(pendulum, pool, open_engine(pendulum), 0)
    return problem, search.restart(problem, pendulum.space.z_of(TRUTH))


@pytest.mark.medium
def test_a_clip_that_is_left_out_and_contradicts_the_others_speaks_against_every_value(
    pendulum, swing, caplog
) -> None:
    problem, found = at_truth(pendulum, changed(swing(6.2), "command.position", np.negative))
    watch = Watch(lambda record, total: None, None, PARTS)
    watch.interrupted = True  # no other check
    ended = Search(problem, found, [], watch, problem.system.space)
    short = conclude(ended)
    assert [one.text for one in short.unexplained] == [watch.short] and "it was interrupted" in watch.short
    assert "the model may lack" not in caplog.text
    result = conclude(replace(ended, finding=replace(found, stage="done")))
    assert {p.verdict for p in result.parameters} == {"model-sensitive"}
    (reason,) = [one.text for one in result.unexplained]
    assert "of swing 2.40-3.00 s by" in reason and "`cost.trim` leaves it out" in reason
    assert f"{reason}: no value is called identified" in caplog.text


def test_noise_in_a_clip_that_is_left_out_is_no_contradiction(pendulum, swing) -> None:
    """Sensors that show ten times their noise for a while, and a right model."""
    rng = np.random.default_rng(3)
    log = changed(swing(6.2), "joints.position", lambda values: values + rng.normal(0.0, 0.02, values.shape))
    problem, found = at_truth(pendulum, log)
    fit = final_fit(problem, found)
    assert [problem.clips[i].start * log.dt for i in np.flatnonzero(fit.weight == 0.0)] == [2.4]
    assert left_out(fit) == ()


def test_jitter_counts_in_the_noise_and_not_again(pendulum, swing) -> None:
    """Where contacts jitter, what bends along z widens an interval beyond its noise, and jitter does not."""
    fit = final_fit(*at_truth(pendulum, swing(3.0)))
    rng, grown = np.random.default_rng(0), []
    pairs = np.sqrt(len(fit.z)) * np.linalg.qr(rng.standard_normal((40, len(fit.z))))[0] * np.sqrt(10.0)
    jitter = rng.standard_normal((40, *fit.slopes.residual.shape))
    bowed = (pairs[:, 0] ** 2 - 1.0)[:, None, None] * np.ones_like(jitter)
    for curves in (jitter, jitter + bowed):
        bent = replace(fit.slopes, curves=curves, pairs=pairs, bend=curves.var(axis=0))
        where = replace(fit, slopes=bent, problem=SimpleNamespace(non_smooth=True))
        grown.append(np.trace(doubled_step(where).hessian - fit.posterior.prior))
    once = np.trace(
        posterior(
            fit.z, information(replace(fit.slopes, bend=jitter.var(axis=0))), fit.weight, fit.posterior.prior
        ).hessian
        - fit.posterior.prior
    )
    assert grown[0] == pytest.approx(once, rel=0.1), "jitter counts once"
    assert grown[1] < 0.2 * once, "wider samples bend more"


#: Two hinges, each with a motor.
LEG = """
<mujoco><worldbody><body><joint name="hip"/><geom size="0.1"/>
<body pos="0 0 -0.2"><joint name="knee"/><geom size="0.1"/></body></body></worldbody></mujoco>
"""


def test_a_misfit_lists_what_is_fixed_and_no_cause_that_nothing_tested(pendulum, delayed) -> None:
    drive = ["the gain of servo", "the force limit of servo"]
    assert held_fixed(pendulum, "joints.position") == [*drive, "the commands' delay"]
    assert held_fixed(pendulum, "joints.effort")[0].startswith("the scale of joints.effort")
    assert held_fixed(delayed, "joints.position") == drive
    sure = delayed.fixing({"delay": 0.02})
    assert held_fixed(sure, "joints.position") == [*drive, "delay at 0.02"]
    pooled = {
        "unit": "N*m*s/rad", "nominal": 0.1, "bounds": [0.01, 1.0], "scale": "log", "prior_sd": 0.5,
        "targets": [{"joint": "hip", "set": "damping"}, {"joint": "knee", "set": "damping"}],
    }  # fmt: skip
    joints = {"joints": ["hip", "knee"], "noise": {"position": 0.01}}
    leg = System.from_model(
        mujoco.MjSpec.from_string(LEG), parameters={"damping": pooled}, signals={"q": joints}
    )
    assert held_fixed(leg, "joints.position") == ["damping as one value of 2 joints"]
    assert shared_by_joints(leg) == {"damping": 2} and shared_by_joints(pendulum) == {}


def test_a_gain_that_is_a_parameter_is_not_fixed(pendulum) -> None:
    gain = {
        "unit": "N*m/rad", "nominal": 4.0, "bounds": [1.0, 9.0], "scale": "log", "prior_sd": 0.5,
        "targets": [{"actuator": "servo", "set": "gain"}],
    }  # fmt: skip
    signals = {
        "joints": {"joints": ["hinge"], "noise": {"position": 0.002}},
        "command": {"actuators": {"servo": "hinge"}, "quantity": "position"},
    }
    free = System.from_model(pendulum.spec.copy(), parameters={"gain": gain}, signals=signals)
    assert held_fixed(free, "joints.position") == ["the force limit of servo", "the commands' delay"]


def of_wrong_armature(pendulum: System, log: Log) -> FinalFit:
    """The last linearisation under an armature that is fixed at a wrong value."""
    system = pendulum.fixing({"armature": 0.007})
    problem = Problem(system, ClipPool(system, [whole(log)], system.settings.clips), open_engine(system), 0)
    return final_fit(problem, search.restart(problem, system.space.z_of(TRUTH[:3])))


def test_a_warning_names_what_may_be_wrong(pendulum, swing, caplog) -> None:
    report_misfit(of_wrong_armature(pendulum, swing(4.0)))
    listed = (
        "now fixed are the gain of servo, the force limit of servo, armature at 0.007, the commands' delay"
    )
    assert listed in caplog.text and "play" not in caplog.text


def test_no_noise_is_advised_that_is_larger_than_all_motion(pendulum, swing) -> None:
    log = swing(4.0)
    (reason, *_) = unexplained(of_wrong_armature(pendulum, log))
    assert "declare what it misses: `signals.joints.noise.position=0." in reason.text
    degrees = {
        key: replace(log[key], values=np.degrees(log[key].values)) for key in log.series if "joints" in key
    }
    (reason, *_) = unexplained(of_wrong_armature(pendulum, Log(log.dt, {**log.series, **degrees}, "degrees")))
    assert "joints.position" in reason.text and "declare" not in reason.text
