"""The bundled systems against physics, and against the traps that made parameters invisible."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from amhe_cli.system.system import System

G = 9.81


@pytest.fixture(scope="module")
def cube() -> System:
    return System.load("cube_toss")


@pytest.fixture(scope="module")
def pendulum() -> System:
    return System.load("pendulum")


def theta_of(system: System, **values: float) -> np.ndarray:
    theta = np.array(system.space.nominal)
    for name, value in values.items():
        theta[system.space.names.index(name)] = value
    return theta


def test_parameter_names_are_the_documented_ones(cube: System, pendulum: System) -> None:
    assert cube.space.names == ("friction", "inertia_scale", "contact_damping", "mass")
    assert pendulum.space.names == ("load_mass", "damping", "friction_loss", "armature")


def test_cube_has_the_published_size_and_inertia(cube: System) -> None:
    np.testing.assert_allclose(cube.model.geom("cube").size, 0.1048 / 2)
    np.testing.assert_allclose(cube.model.body("cube").inertia, 8.1e-4)
    assert cube.model.body("cube").mass == pytest.approx(0.37)
    assert cube.settings.clips.held_out_first_only
    assert cube.settings.clips.held_out_length == 0.4


@pytest.mark.parametrize("friction", [0.1, 0.3])
def test_a_slide_ends_after_v_squared_over_two_mu_g(cube: System, friction: float) -> None:
    model = cube.edits.apply(cube.model, theta_of(cube, friction=friction))
    data = mujoco.MjData(model)
    for _ in range(200):
        mujoco.mj_step(model, data)
    start = data.qpos[0]
    data.qvel[0] = 0.8
    for _ in range(1000):
        mujoco.mj_step(model, data)
    assert abs(data.qvel[0]) < 1e-2
    assert data.qpos[0] - start == pytest.approx(0.8**2 / (2.0 * friction * G), rel=0.03)


def test_a_toss_is_blind_to_mass(cube: System) -> None:
    ends = []
    for mass in (0.2, 0.8):
        model = cube.edits.apply(cube.model, theta_of(cube, mass=mass))
        data = mujoco.MjData(model)
        data.qpos[:7] = [0, 0, 0.15, 0.9, 0.3, 0.2, 0.1]
        data.qvel[:] = [0.5, 0.2, 0, 3, -2, 4]
        for _ in range(150):
            mujoco.mj_step(model, data)
        ends.append(data.qpos[:3].copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-5)


def test_stale_constants_are_why_set_const_is_called(cube: System) -> None:
    """A mass written without mj_setConst leaves the inverse weights that scale every contact behind."""
    model = cube.edits.apply(cube.model, theta_of(cube, mass=1.2))
    body = model.body("cube").id
    assert model.body_invweight0[body, 0] == pytest.approx(1.0 / 1.2)


def free_swing(model: mujoco.MjModel, angle: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    data.qpos[0] = angle
    times, angles = [], []
    while data.time < seconds:
        mujoco.mj_step(model, data)
        times.append(data.time)
        angles.append(data.qpos[0])
    return np.array(times), np.array(angles)


def inertia_and_gravity(model: mujoco.MjModel, load: float) -> tuple[float, float]:
    """Inertia about the hinge, and the gravity torque per radian, of the formulas in scene.xml."""
    rod, body = model.body("rod"), model.body("load")
    inertia = rod.inertia[1] + rod.mass[0] * 0.1**2 + body.inertia[1] + load * 0.2**2 + model.dof_armature[0]
    return float(inertia), float((rod.mass[0] * 0.1 + load * 0.2) * G)


def test_pendulum_small_swings_have_the_analytic_period(pendulum: System) -> None:
    model = pendulum.edits.apply(
        pendulum.model, theta_of(pendulum, load_mass=0.6, damping=1e-6, friction_loss=1e-9, armature=0.01)
    )
    model.actuator_biasprm[0, 2] = 0.0
    inertia, gravity = inertia_and_gravity(model, 0.6)
    times, angles = free_swing(model, 0.02, 3.0)
    crossings = times[1:][(angles[:-1] < 0.0) & (angles[1:] >= 0.0)]
    period = np.diff(crossings).mean()
    assert period == pytest.approx(2.0 * np.pi * np.sqrt(inertia / (4.0 + gravity)), rel=5e-3)


def test_pendulum_sags_under_its_load(pendulum: System) -> None:
    model = pendulum.edits.apply(pendulum.model, theta_of(pendulum, load_mass=0.8, friction_loss=1e-9))
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    for _ in range(8000):
        mujoco.mj_step(model, data)
    _, gravity = inertia_and_gravity(model, 0.8)
    assert 4.0 * (1.0 - data.qpos[0]) == pytest.approx(gravity * np.sin(data.qpos[0]), rel=1e-3)


def test_dry_friction_stops_the_arm_short_of_its_rest(pendulum: System) -> None:
    """MuJoCo's dry friction is soft: what it holds creeps a little."""
    _, gravity = inertia_and_gravity(pendulum.model, 0.4)
    start = 0.8 * 0.3 / (4.0 + gravity)
    held = pendulum.edits.apply(pendulum.model, theta_of(pendulum, friction_loss=0.3))
    free = pendulum.edits.apply(pendulum.model, theta_of(pendulum, friction_loss=1e-9))
    assert free_swing(held, start, 0.3)[1].min() > 0.9 * start
    assert free_swing(free, start, 0.3)[1].min() < 0.0
