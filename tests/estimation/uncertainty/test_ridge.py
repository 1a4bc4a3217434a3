"""What is known only as a product or a ratio: the width along the ridge is the prior's, whatever the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.belief import with_prior
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.system.system import System
from tests.estimation.conftest import CHEAP

MJCF = """
<mujoco>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom name="cart" size="0.1" mass="2"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="rail"/></actuator>
</mujoco>
"""
SYSTEM = """
model: cart.xml
parameters:
  mass:
    {unit: kg, nominal: 2.0, bounds: [0.2, 20], scale: log, prior_sd: 0.5, targets: [{body: cart, set: mass}]}
  gain:
    {unit: N, nominal: 1.0, bounds: [0.1, 10], scale: log, prior_sd: 0.5,
     targets: [{actuator: drive, set: gain}]}
signals:
  cart: {topic: /cart, joints: [rail], noise: {position: 0.001, velocity: 0.01}}
  force: {topic: /force, actuators: [drive], quantity: effort}
"""


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    folder: Path = tmp_path_factory.mktemp("cart")
    (folder / "cart.xml").write_text(MJCF)
    (folder / "system.yaml").write_text(SYSTEM)
    return System.load(folder, CHEAP)


def drive(system, theta, seconds=4.0, seed=0) -> Log:
    """A cart pushed to and fro."""
    rng = np.random.default_rng(seed)
    model = system.edits.apply(system.model, np.array(theta))
    data = mujoco.MjData(model)
    dt = model.opt.timestep
    steps = round(seconds / dt)
    rows = np.empty((steps + 1, 3))
    for step in range(steps + 1):
        data.ctrl[0] = 3.0 * np.sin(4.0 * step * dt) + 2.0 * np.cos(9.0 * step * dt)
        rows[step] = data.qpos[0], data.qvel[0], data.ctrl[0]
        mujoco.mj_step(model, data)
    rows[:, :2] += rng.normal(0.0, [0.001, 0.01], (steps + 1, 2))
    yes = np.ones(steps + 1, dtype=bool)
    sampled = np.arange(steps + 1) % 2 == 0
    return Log(
        dt,
        {
            "cart.position": Series(rows[:, :1], yes, sampled, ("rail",)),
            "cart.velocity": Series(rows[:, 1:2], yes, sampled, ("rail",)),
            "force.effort": Series(rows[:, 2:], yes, sampled, ("drive",)),
        },
        "cart",
    )


@pytest.mark.medium
def test_only_the_ratio_of_gain_and_mass_is_known(system):
    result = identify(system, [drive(system, [3.0, 1.0])], None, IdentifyOptions())
    assert result.belief.names == ("mass", "gain")
    # (log mass, log gain) may move together by the prior: 0.5 across two of them is 0.5 / sqrt(2) for each
    sd = np.sqrt(np.diag(result.belief.covariance))
    assert sd == pytest.approx(0.5 / np.sqrt(2.0), rel=0.05)
    assert {p.verdict for p in result.parameters} == {"prior"}
    ratio = result.belief.estimate[1] / result.belief.estimate[0]
    assert ratio == pytest.approx(1.0 / 3.0, rel=0.01)
    sharp = min(result.combinations, key=lambda c: c.sd)
    assert sharp.text in ("gain / mass", "mass / gain")
    assert sharp.sd < 0.01


@pytest.mark.medium
def test_declared_errors_go_together_as_the_posterior_does(system):
    """100 % are 2 prior sd. The ridge has an sd of 0.5^0.5: errors 8^0.5 times as long, and as narrow."""
    log = drive(system, [3.0, 1.0])
    wrong = system.settings.identify.model_copy(update={"model_error": {"mass": 1.0, "gain": 1.0}})
    doubted = replace(system, settings=system.settings.model_copy(update={"identify": wrong}))
    plain, wide = (identify(one, [log], None, IdentifyOptions()) for one in (system, doubted))
    best, kept = (min(result.combinations, key=lambda c: c.sd) for result in (plain, wide))
    assert kept.text in ("gain / mass", "mass / gain") and kept.sd == pytest.approx(3.0 * best.sd, rel=0.05)
    before, after = (np.sqrt(np.diag(result.belief.covariance)) for result in (plain, wide))
    assert after == pytest.approx(np.hypot(before, 1.0), rel=0.02)


@pytest.mark.medium
def test_a_belief_hands_the_ratio_on(system):
    """The ratio that one log knows is still known to the next, though each parameter is not."""
    first = identify(system, [drive(system, [3.0, 1.0])], None, IdentifyOptions())
    space = with_prior(system.space, first.belief)
    handed = space.prior_covariance * np.outer(space.prior_sd, space.prior_sd)
    assert handed == pytest.approx(first.belief.covariance, rel=1e-9)
    second = identify(system, [drive(system, [3.0, 1.0], seed=1)], None, IdentifyOptions(prior=first.belief))
    assert min(c.sd for c in second.combinations) < min(c.sd for c in first.combinations)


TRUTH = np.array([0.02, 0.28, 0.15])


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module, with logs of half the length."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
    import friction_split  # pyright: ignore[reportMissingImports]

    monkeypatch.setattr(friction_split, "SECONDS", 4.5)
    return friction_split


@pytest.mark.medium
def test_runs_at_one_speed_know_neither_friction_and_never_contradict(benchmark: ModuleType) -> None:
    system = benchmark.system()
    for seed in (0, 1):
        log = benchmark.run(system, TRUTH, np.random.default_rng(seed))
        found = amhe.identify(system, [log], seed=seed).parameters
        for name, true in zip(benchmark.FRICTION, TRUTH[1:], strict=True):
            assert found[name].verdict in ("weak", "prior"), (name, seed)
            assert found[name].interval[0] < true < found[name].interval[1]
