"""Motion out of noisy positions, and the forces that it needs."""

import mujoco
import numpy as np
import pytest

from amhe_cli.core import rotations
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.core.spectrum import smooth
from amhe_cli.engine.inverse import forces_along
from amhe_cli.matching.motion import motion_of, velocity_lag
from amhe_cli.system.system import System

XML = """
<mujoco><option timestep="0.002"/><worldbody>
  <body name="upper"><joint name="a" axis="0 1 0" damping="0.3"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1.5"/>
    <body name="lower" pos="0 0 -0.4"><joint name="b" axis="0 1 0" armature="0.02" stiffness="0.5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.7"/></body></body>
  <body name="ball" pos="0 1 1"><freejoint/><geom type="ellipsoid" size="0.1 0.2 0.3" mass="1"/></body>
</worldbody><actuator><motor name="ma" joint="a"/><motor name="mb" joint="b"/></actuator></mujoco>
"""
DT = 0.002


def waves(t, columns, derivative=0):
    """Sums of three sines of 0.2 to 1.5 Hz, and their derivatives."""
    rng = np.random.default_rng(5)
    w = 2 * np.pi * np.array([0.2, 0.6, 1.5])[:, None, None]
    phase, size = rng.uniform(0, 6, (3, 1, columns)), rng.uniform(0.1, 0.4, (3, 1, columns))
    return (size * w**derivative * np.sin(w * t[:, None] + phase + derivative * np.pi / 2)).sum(axis=0)


@pytest.fixture(scope="module")
def system():
    mass = {"targets": [{"set": "mass", "body": "lower"}]}
    return System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={"mass": mass},
        signals={
            "joints": {"joints": ["a", "b"], "noise": {"position": 1e-3}},
            "ball": {"body": "ball", "noise": {"position": 1e-3}},
            "torque": {"actuators": ["ma", "mb"]},
        },
    )


def log_of(system, noise, seconds=10.0, hole=None):
    """A log of the system on a path of sines; NaN in the hole."""
    t, rng = np.arange(0.0, seconds, DT), np.random.default_rng(0)
    q, place = waves(t, 2), waves(t, 3)
    turn = rotations.exp(waves(t, 3))
    q = q + noise * rng.standard_normal(q.shape)
    if hole is not None:
        q[hole] = np.nan
    turn = rotations.multiply(turn, rotations.exp(noise * rng.standard_normal((t.size, 3))))
    place = place + noise * rng.standard_normal(place.shape)
    ball = {"time": t, "position": place, "orientation": turn}
    torque = {"time": t, "effort": np.zeros((t.size, 2))}
    return Log.from_arrays({"joints": {"time": t, "position": q}, "ball": ball, "torque": torque}, system)


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_errors_of_a_smooth_motion_are_of_the_size_that_it_says(noise):
    t = np.arange(0.0, 20.0, DT)
    q = waves(t, 5)
    found = smooth(q + noise * np.random.default_rng(1).standard_normal(q.shape), DT)
    inner = slice(int(1.0 / (found.band.min() * DT)), -int(1.0 / (found.band.min() * DT)))
    assert found.noise == pytest.approx(noise, rel=0.15)
    assert (found.band > 1.4).all() and (found.band < 12.0).all()
    for k, values in enumerate((found.values, found.first, found.second)):
        error = values[inner] - waves(t, 5, k)[inner]
        ratio = error.std(axis=0) / found.sd[k]
        assert (ratio > 0.3).all() and (ratio < 1.7).all()
        # a regression on the smooth values is not pulled towards zero by more than a per mille
        assert (np.abs((error * values[inner]).sum(axis=0)) < 1e-3 * (values[inner] ** 2).sum(axis=0)).all()


def test_noise_alone_has_no_motion():
    found = smooth(1e-3 * np.random.default_rng(2).standard_normal((5000, 4)), DT)
    assert (found.second.std(axis=0) < 1e-2).all()


def test_a_free_body_turns_and_accelerates_as_it_did(system):
    found = motion_of(system, log_of(system, 1e-4))
    t = found.rows * DT
    ball = 2
    assert found.qvel[:, ball : ball + 3] == pytest.approx(waves(t, 3, 1), abs=0.01)
    assert found.qacc[:, ball : ball + 3] == pytest.approx(waves(t, 3, 2), abs=0.3)
    h = 1e-4
    before, now, after = (rotations.exp(waves(t + s, 3)) for s in (-h, 0.0, h))
    omega = rotations.difference(after, before) / (2 * h)
    alpha = (rotations.difference(after, now) - rotations.difference(now, before)) / h**2
    assert found.qvel[:, ball + 3 :] == pytest.approx(omega, abs=0.01)
    assert found.qacc[:, ball + 3 :] == pytest.approx(alpha, abs=0.3)
    assert found.sd[0, :2] == pytest.approx(1e-4, rel=0.9)


def test_forces_of_a_simulated_motion_are_those_that_drove_it(system):
    model = system.model
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    for _ in range(5):
        data.qpos[:2], data.qvel[:] = rng.normal(size=2), rng.normal(size=model.nv)
        data.ctrl[:], data.qfrc_applied[0] = rng.normal(size=2), 0.3
        data.xfrc_applied[3] = rng.normal(size=6)
        mujoco.mj_forward(model, data)
        spec = int(mujoco.mjtState.mjSTATE_USER)
        inputs = np.empty(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, inputs, spec)
        found = forces_along(model, data.qpos[None], data.qvel[None], data.qacc[None], inputs[None], spec)
        assert found.needed == pytest.approx(found.given, abs=1e-9)
        assert found.missing == pytest.approx(0.0, abs=1e-9)


def test_a_gap_parts_the_motion_and_a_log_of_gaps_has_none(system):
    found = motion_of(system, log_of(system, 1e-4, hole=slice(2000, 2600)))
    assert set(found.stretch) == {0, 1}
    assert not ((found.rows > 1990) & (found.rows < 2610)).any()
    assert found.within(100, 3000).start < found.within(100, 3000).stop
    with pytest.raises(LogError, match="without a gap"):
        motion_of(system, log_of(system, 1e-4, seconds=0.05))


def test_a_lag_of_measured_velocities_is_found(system):
    t = np.arange(0.0, 10.0, DT)
    rng = np.random.default_rng(4)
    for late in (0.0, 0.006):
        joints = {"time": t, "position": waves(t, 2) + 1e-4 * rng.standard_normal((t.size, 2))}
        joints["velocity"] = waves(t - late, 2, 1) + 0.02 * rng.standard_normal((t.size, 2))
        ball = {"time": t, "position": waves(t, 3), "orientation": rotations.exp(waves(t, 3))}
        torque = {"time": t, "effort": np.zeros((t.size, 2))}
        log = Log.from_arrays({"joints": joints, "ball": ball, "torque": torque}, system)
        lag = velocity_lag(system, log)
        assert lag is not None
        found, sd = lag
        assert found == pytest.approx(late, abs=5e-4)
        assert sd < 5e-4
    assert velocity_lag(system, log_of(system, 1e-4)) is None
