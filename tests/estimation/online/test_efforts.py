"""An arm's payload from its torques, window by window: nothing is simulated, and a grip is noticed."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.log import Log, sampled
from amhe_cli.engine.inverse import forces_along
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon
from amhe_cli.estimation.online.replay import open_replay, predictions
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.workers import InStep
from amhe_cli.system.system import System
from tests.estimation.online.test_tracker import portions

ARM = Path(__file__).parents[3] / "examples" / "logs" / "arm_torque.xml"
JOINTS = [f"joint{i}" for i in range(1, 8)]
DT, SECONDS, GRIP = 0.002, 9.0, 5.0
LIGHT, HEAVY, DRY = 0.4, 1.3, 0.3


@pytest.fixture(scope="module")
def arm() -> System:
    """Seven joints, a payload of unknown mass, torques that are measured."""
    spec = mujoco.MjSpec.from_file(str(ARM))
    spec.option.timestep = DT
    for joint in spec.joints:
        joint.frictionloss, joint.armature = DRY, 0.0
    payload = spec.body("link7").add_body(name="payload", pos=[0.0, 0.0, 0.15])
    payload.explicitinertial, payload.mass, payload.inertia = True, 0.5, [0.001] * 3
    return System.from_model(
        spec,
        parameters={
            "payload": {"nominal": 0.5, "prior_sd": 1.0, "targets": [{"body": "payload", "set": "mass"}]}
        },
        signals={
            "joints": {"joints": JOINTS, "noise": {"position": 1e-4}},
            "torque": {"joint_force": JOINTS, "noise": {"effort": 0.15}},
        },
        match="effort",
        settings={"mhe": {"window": 1.0, "update_period": 0.5}},
    )


@pytest.fixture(scope="module")
def gripping(arm: System) -> Log:
    """A log of a motion in which something heavy is gripped."""
    t, rng = np.arange(0.0, SECONDS, DT), np.random.default_rng(0)
    w = 2.0 * np.pi * np.array([0.2, 0.5, 0.9])[:, None, None]
    phase, size = rng.uniform(0.0, 6.0, (3, 1, 7)), 0.4 * rng.uniform(0.5, 1.0, (3, 1, 7)) * w[0] / w
    q, v, a = ((size * w**k * np.sin(w * t[:, None] + phase + k * np.pi / 2)).sum(axis=0) for k in range(3))
    empty, full = (
        forces_along(arm.edits.apply(arm.model, np.array([mass])), q, v, a).needed for mass in (LIGHT, HEAVY)
    )
    torque = np.where(t[:, None] < GRIP, empty, full) + DRY * np.sign(v)
    arrays = {
        "joints": {"time": t, "position": q + 1e-4 * rng.standard_normal(q.shape)},
        "torque": {"time": t, "effort": torque + 0.15 * rng.standard_normal(q.shape)},
    }
    return Log.from_arrays(arrays, arm)


@pytest.mark.medium
def test_a_payload_is_found_in_a_second_and_a_grip_is_a_jump(arm: System, gripping: Log) -> None:
    done = open_replay(arm, gripping).run()

    time, mass, lower, upper = (done.column(name).reshape(-1) for name in ("time", "theta", "lower", "upper"))
    true = np.where(time < GRIP, LIGHT, HEAVY)
    assert mass[0] == pytest.approx(LIGHT, rel=0.1)  # of the first second
    jumps = [e.time for e in done.estimates if e.mark == "jump" and e.time > 2.0]
    assert GRIP < jumps[0] <= GRIP + 1.0
    assert mass[-1] == pytest.approx(HEAVY, rel=0.05)
    settled = (time < GRIP) | (time > GRIP + 1.0)
    assert ((lower < true) & (true < upper))[settled].mean() >= 0.75
    predicted = predictions(done)[-1]
    assert predicted is not None
    measured = gripping["torque.effort"].values[predicted.rows]
    assert np.nanstd(predicted.values["torque.effort"] - measured) < 0.25


@pytest.mark.medium
def test_live_windows_find_it_too(arm: System, gripping: Log) -> None:
    estimator = MovingHorizon(arm, open_engine(arm), np.random.default_rng(0))
    tracker = Tracker(arm, InStep(lambda _: estimator, latency=0.0))

    news = [one for _, part in portions(sampled(gripping), 0.25, SECONDS) for one in tracker.feed(part)]

    found = [one for one in news if isinstance(one, Estimate)]
    assert len(found) == len(news) >= 12
    assert found[-1].theta[0] == pytest.approx(HEAVY, rel=0.05)
    assert any(one.mark == "jump" and GRIP < one.time <= GRIP + 1.0 for one in found)


def test_windows_are_long_enough_to_smooth_a_motion_in_unless_they_were_chosen() -> None:
    signals = {"torque": {"joint_force": JOINTS, "noise": {"effort": 0.1}}, "joints": {"joints": JOINTS}}
    mass = {"m": {"targets": [{"body": "link7", "set": "mass"}]}}

    def windows(**given: float) -> tuple[float, float]:
        system = System.from_model(
            mujoco.MjSpec.from_file(str(ARM)), parameters=mass, signals=signals, match="effort",
            settings={"mhe": given}, warn=False,
        )  # fmt: skip
        return system.settings.mhe.window, system.settings.mhe.update_period

    assert windows() == (1.0, 0.5)
    assert windows(window=0.7) == (0.7, 0.2)
