"""The rollout engine: alignment, divergence, independence of threads and of other rollouts' lengths."""

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.states import integrated
from amhe_cli.engine.variants import contact_variants
from amhe_cli.system.system import System

PENDULUM = System.load("pendulum")
CUBE = System.load("cube_toss")


def engine(system, threads=1, sensors=False, model=None):
    return CpuEngine(model or system.model, system.edits, system.input_spec, threads, sensors)


def some_rollouts(threads=1, lengths=(40, 40, 40, 7), n=4):
    rng = np.random.default_rng(0)
    theta = PENDULUM.space.theta_of(rng.normal(0.0, 0.5, (n, 4)))
    inputs = rng.normal(0.0, 1.0, (n, 40, 1))
    qpos, qvel = rng.normal(0.0, 0.3, (n, 1)), rng.normal(0.0, 1.0, (n, 1))
    done = engine(PENDULUM, threads).rollout(theta, qpos, qvel, inputs, np.array(lengths))
    return theta, qpos, qvel, inputs, done


def test_row_k_is_the_state_after_input_k():
    theta, qpos, qvel, inputs, done = some_rollouts()
    for i in range(4):
        model = PENDULUM.edits.apply(PENDULUM.model, theta[i])
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        for k in range((40, 40, 40, 7)[i]):
            data.ctrl[:] = inputs[i, k]
            mujoco.mj_step(model, data)
            assert done.qpos[i, k] == pytest.approx(data.qpos, abs=1e-12)
            assert done.qvel[i, k] == pytest.approx(data.qvel, abs=1e-12)


def test_sensors_describe_the_same_instant_as_the_state():
    spec = PENDULUM.original.copy()
    spec.add_sensor(
        name="q", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="hinge"
    )
    rng = np.random.default_rng(1)
    done = engine(PENDULUM, sensors=True, model=spec.compile()).rollout(
        np.tile(PENDULUM.space.nominal, (3, 1)),
        rng.normal(size=(3, 1)),
        rng.normal(size=(3, 1)),
        rng.normal(size=(3, 25, 1)),
        np.full(3, 25),
    )
    assert done.sensordata is not None
    np.testing.assert_array_equal(done.sensordata, done.qpos)


def test_bit_identical_at_any_thread_count_and_beside_shorter_rollouts():
    one, many = some_rollouts(1)[-1], some_rollouts(3)[-1]
    np.testing.assert_array_equal(one.qpos[:3], many.qpos[:3])
    np.testing.assert_array_equal(one.qpos[:3], some_rollouts(1, (40, 40, 40, 40))[-1].qpos[:3])


def test_a_pool_is_reused_without_memory_of_the_last_call():
    pool = engine(PENDULUM)
    rng = np.random.default_rng(2)
    first = PENDULUM.space.theta_of(rng.normal(size=(6, 4)))
    call = (rng.normal(size=(6, 1)), rng.normal(size=(6, 1)), rng.normal(size=(6, 30, 1)), np.full(6, 30))
    fresh = pool.rollout(first, *call).qpos
    pool.rollout(PENDULUM.space.theta_of(rng.normal(size=(2, 4))), *(c[:2] for c in call))
    np.testing.assert_array_equal(pool.rollout(first, *call).qpos, fresh)


def test_a_diverged_rollout_looks_tame_and_is_marked():
    inputs = np.zeros((3, 50, 1))
    inputs[1, 20] = 1e300
    system = System.load("pendulum")
    system.model.actuator_ctrllimited[:] = False
    system.model.actuator_forcelimited[:] = False
    done = engine(system).rollout(
        np.tile(system.space.nominal, (3, 1)), np.zeros((3, 1)), np.zeros((3, 1)), inputs, np.full(3, 50)
    )
    assert done.completed.tolist() == [True, False, True]
    assert np.isfinite(done.qpos).all()  # the trap: nothing but the warning tells


def test_friction_changes_a_slide_and_mass_does_not():
    """A cube sliding at v stops after v^2 / (2 mu g)."""
    speed, steps = 1.0, 700
    mu = np.array([0.2, 0.4, 0.4])
    theta = np.tile(CUBE.space.nominal, (3, 1))
    theta[:, CUBE.space.names.index("friction")] = mu
    theta[2, CUBE.space.names.index("mass")] *= 2.0
    rest = np.array([0.0, 0.0, 0.0523, 1.0, 0.0, 0.0, 0.0])
    done = engine(CUBE).rollout(
        theta,
        np.tile(rest, (3, 1)),
        np.tile([speed, 0, 0, 0, 0, 0], (3, 1)),
        np.zeros((3, steps, 0)),
        np.full(3, steps),
    )
    way = done.qpos[:, -1, 0]
    assert way == pytest.approx(speed**2 / (2.0 * mu * 9.81), rel=0.03)
    assert way[1] == pytest.approx(way[2], rel=1e-6)


def test_tangent_steps_are_mujocos_own():
    rng = np.random.default_rng(3)
    qpos = np.array(CUBE.model.qpos0)
    qpos[3:] = rng.normal(size=4)
    qpos[3:] /= np.linalg.norm(qpos[3:])
    delta = rng.normal(0.0, 0.3, 6)
    expected = qpos.copy()
    mujoco.mj_integratePos(CUBE.model, expected, delta, 1.0)
    assert integrated(CUBE.model, qpos, delta) == pytest.approx(expected, abs=1e-12)


def test_only_models_that_collide_have_contact_variants():
    assert contact_variants(PENDULUM.model) == {}
    softer = contact_variants(CUBE.model)["contacts twice as soft"]
    assert softer.pair_solref[0, 0] == 2.0 * CUBE.model.pair_solref[0, 0]
