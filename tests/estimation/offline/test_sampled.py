"""The sampled posterior of a cart that a motor pushes: x'' = gain u / mass."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.posterior import final_fit
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.estimation.offline.sampled import sampled_posterior

CART = """
<mujoco><option timestep="0.02" gravity="0 0 0"/>
<worldbody><body name="cart"><joint name="x" type="slide"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="x"/></actuator></mujoco>
"""
GAIN = {
    "nominal": 1.0, "bounds": [0.1, 3.0], "prior_sd": 0.5, "scale": "linear",
    "targets": [{"actuator": "motor", "set": "gain"}],
}  # fmt: skip
MASS = {
    "nominal": 1.0, "bounds": [0.05, 20.0], "prior_sd": 0.8, "scale": "log",
    "targets": [{"body": "cart", "set": "mass"}],
}  # fmt: skip
EXACT = {"gain": 0.0, "command_delay": 0.0}


def cart(**parameters: dict[str, object]) -> amhe.System:
    """A system of which the log knows the numbers to a few percent."""
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(CART),
        parameters=parameters,
        signals={
            "state": {"joints": ["x"], "noise": {"position": 0.06, "velocity": 0.3}},
            "force": {"actuators": ["motor"], "quantity": "effort"},
        },
        settings={
            "clips": {"length": [0.6, 0.6], "count": 4},
            "identify": {"draws": 200, "rulers": EXACT, "iterations": 3},
        },
        name="cart",
    )


def pushed(system: amhe.System, seed: int = 0) -> Log:
    """Two seconds of gain 1 and mass 1."""
    rng, time = np.random.default_rng(seed), np.arange(101) * 0.02
    force = 6.0 * np.sin(5.0 * time)
    speed = np.concatenate(([0.0], np.cumsum(force[:-1] * 0.02)))
    place = np.concatenate(([0.0], np.cumsum(speed[1:] * 0.02)))
    noise = rng.normal(0.0, (0.06, 0.3), (101, 2))
    state = {"time": time, "position": place + noise[:, 0], "velocity": speed + noise[:, 1]}
    return amhe.Log.from_arrays({"state": state, "force": {"time": time, "effort": force}}, system)


def drawn(system: amhe.System) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws of z; mean and covariance of the linearised posterior."""
    pool = ClipPool(system, [whole(pushed(system))], system.settings.clips)
    problem = Problem(system, pool, open_engine(system), 0)
    fit = final_fit(problem, search.restart(problem, np.zeros(len(system.space))))
    return (
        sampled_posterior(problem, fit).z,
        fit.z + fit.posterior.step,
        np.linalg.inv(fit.posterior.hessian),
    )


def test_both_posteriors_of_a_linear_problem_agree() -> None:
    """Motion is linear in the gain."""
    z, mean, covariance = drawn(cart(gain=GAIN))
    sd = float(np.sqrt(covariance[0, 0]))
    assert sd < 0.3, "the log knows it"
    assert z.mean() == pytest.approx(mean[0], abs=0.25 * sd)
    assert z.std() == pytest.approx(sd, rel=0.15)


@pytest.mark.medium
def test_what_is_known_only_together_bends_the_sampled_posterior_alone() -> None:
    """The log knows gain / mass. The prior of one is Gaussian in the value, of the other in its logarithm."""
    z, _, covariance = drawn(cart(gain=GAIN, mass=MASS))
    ratio = (1.0 + 0.5 * z[:, 0]) / np.exp(0.8 * z[:, 1])
    assert ratio.std() < 0.1, "each draw has the ratio that the log shows"
    middle = float(np.median(ratio))
    line = np.linspace(-3.0, 3.0, 2001)  # of ln(mass) / 0.8; across it, the ridge is as wide as the mass
    away = (middle * np.exp(0.8 * line) - 1.0) / 0.5  # of the gain
    prior = np.exp(-0.5 * line**2 - 0.5 * away**2 + 0.8 * line)
    share = np.cumsum(prior) / prior.sum()
    exact = [(middle * np.exp(0.8 * line[np.searchsorted(share, q)]) - 1.0) / 0.5 for q in (0.05, 0.95)]
    low, high = np.quantile(z[:, 0], (0.05, 0.95))
    assert low == pytest.approx(exact[0], abs=0.2)
    assert high == pytest.approx(exact[1], abs=0.45)  # where draws are few
    assert -1.645 * np.sqrt(covariance[0, 0]) < exact[0] - 0.25, "the Gaussian is not right"


@pytest.mark.medium
def test_an_identification_takes_intervals_from_draws_and_says_where_they_differ(tmp_path) -> None:
    system = cart(gain=GAIN, mass=MASS)
    result = amhe.identify(system, pushed(system), posterior="sampled", threads=1)
    assert result.samples is not None and result.samples.shape == (200, 2)
    for i, p in enumerate(result.parameters.values()):
        assert p.interval == pytest.approx(np.quantile(result.samples[:, i], (0.05, 0.95)))
    record = result.record()["sampled"]
    assert any(entry["differs"] for entry in record["parameters"])
    assert "by draws" in result.table
    folder = result.save(tmp_path / "out")
    with np.load(folder / "samples.npz") as file:
        np.testing.assert_array_equal(file["samples"], result.samples)
    assert "Sampled posterior" in (folder / "report.html").read_text()


def test_draws_that_did_not_settle_leave_the_linearised_intervals(monkeypatch, caplog) -> None:
    monkeypatch.setattr("amhe_cli.estimation.offline.conclude.ENOUGH", 1.1)
    system = cart(gain=GAIN)
    result = amhe.identify(system, pushed(system), posterior="sampled", threads=1)
    assert result.samples is None
    assert result.record()["sampled"] is None
    assert any("did not settle" in text for text in result.warnings)


def test_an_unknown_posterior_is_refused() -> None:
    system = cart(gain=GAIN)
    with pytest.raises(ConfigError, match="`posterior`: no posterior 'laplace'.*sampled"):
        amhe.identify(system, pushed(system), posterior="laplace")
