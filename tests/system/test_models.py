"""The bundled systems against physics, and against the traps that made parameters invisible."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import mujoco
import numpy as np
import pytest

import amhe_cli as amhe
from amhe_cli.core.bundled import bundled_root
from amhe_cli.core.log import Window
from amhe_cli.engine.open import open_engine
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.robots.go1.kinematics import HOME, HOME_HEIGHT
from amhe_cli.robots.go1.model import Box, home, layout, planner_model, plant_model
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


FOLDER = Path(__file__).parents[2] / "examples" / "systems" / "so101"


def write(path: Path, word: str, rows: np.ndarray) -> None:
    lines = [f'{word},{20000 * i + 5},"{json.dumps(row.tolist())}"' for i, row in enumerate(rows)]
    path.write_text("\n".join(["type,timestamp,positions", *lines]) + "\n")


def test_a_log_of_sage_is_read(tmp_path: Path) -> None:
    system = amhe.System.load(FOLDER)
    wave = 0.3 * np.sin(np.linspace(0.0, 6.0, 100))[:, None] * np.arange(1, 7)
    write(tmp_path / "state_motor.csv", "STATE_MOTOR", wave)
    write(tmp_path / "control.csv", "CONTROL", wave + 0.02)
    log = amhe.read_log(tmp_path, system)
    measured, targets = log["joints.position"].values, log["targets.position"].values
    assert abs(log.duration - 1.98) < 0.02
    np.testing.assert_allclose(measured[::5], wave[: len(measured[::5])], atol=2e-3)
    np.testing.assert_allclose(targets[0], wave[0] + 0.02, atol=1e-9)


def test_the_nominal_model_is_the_makers() -> None:
    system = amhe.System.load(FOLDER)
    assert sum(name.endswith("_gain") for name in system.space.names) == 6
    np.testing.assert_allclose(system.model.actuator_gainprm[:, 0], 998.22)


LOG = bundled_root() / "examples" / "logs" / "pusher.mcap"


@pytest.mark.parametrize("name", ["pusher", "pushed_box"])
def test_the_truth_explains_the_push(name: str) -> None:
    """Mass and friction with the same product push the box with the same force: both must be right."""
    system = amhe.System.load(name)
    log = amhe.read_log(LOG, system)
    truth = json.loads(log.metadata["truth"])
    true = np.array([truth[p] for p in system.space.names])
    candidates = np.array([true, true * [0.6, 1.0], true * [1.0, 0.6], true * [1.5, 1.0], true * [1.0, 1.5]])
    windows = [Window(log, start, 200) for start in range(200, log.steps - 250, 500)]
    cost = MatchingCost(system, windows, open_engine(system), system.settings.cost)
    costs = cost.costs(system.space.z_of(candidates))
    assert (costs[1:] > 1.5 * costs[0]).all(), costs


def test_the_log_shows_the_friction_of_the_floor() -> None:
    """While the box slides, the force along x is friction times weight, on average over its accelerations."""
    log = amhe.read_log(LOG, amhe.System.load("pusher"))
    truth = json.loads(log.metadata["truth"])
    force = log["wrist.force"].values[:, 0]
    speed = log["box.linear_velocity"].values[:, 0]
    expected = truth["floor_friction"] * truth["box_mass"] * 9.81
    assert force[speed > 0.05].mean() == pytest.approx(expected, rel=0.1)


G = 9.81

#: Body -> mass, principal moments: MuJoCo Menagerie's unitree_go1 (their trunk has no rotors and no IMU).
PUBLISHED = {
    "trunk": (5.204, (0.0716565, 0.0630105, 0.0168101)),
    "hip": (0.68, (0.000734064, 0.000468438, 0.000398719)),
    "thigh": (1.009, (0.00478717, 0.00460903, 0.000709268)),
    "calf": (0.195862, (0.00149767, 0.00148468, 3.58427e-05)),
}


@pytest.fixture(scope="module")
def go1() -> System:
    return System.load("go1_push")


def with_theta(system: System, **values: float) -> mujoco.MjModel:
    theta = np.array(system.space.nominal)
    for name, value in values.items():
        theta[system.space.names.index(name)] = value
    return system.edits.apply(system.model, theta)


def settled(model: mujoco.MjModel, box_x: float = 0.6) -> mujoco.MjData:
    data, at = mujoco.MjData(model), layout(model)
    data.qpos[:] = home(model)
    data.qpos[at.box][0] = box_x
    data.ctrl[at.servos] = HOME
    for _ in range(round(0.3 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return data


def test_it_loads_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        system = System.load("go1_push")
    assert not caplog.records
    assert system.space.names == ("box_mass", "box_inertia_scale", "floor_friction")
    assert not system.senses
    topics = {signal.topic for signal in system.signals}
    assert topics == {"/joint_states", "/odom", "/box/odom", "/joint_commands"}


def test_masses_and_inertias_are_the_published_ones(go1: System) -> None:
    assert go1.model.body("trunk").subtreemass[0] == pytest.approx(12.743448, abs=1e-6)
    for row in range(1, go1.model.nbody):
        body = go1.model.body(row)
        if body.name == "box":
            continue
        mass, moments = PUBLISHED[body.name.split("_")[-1]]
        assert body.mass[0] == pytest.approx(mass)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(moments), rtol=2e-5, err_msg=body.name)


def test_left_and_right_mirror_each_other(go1: System) -> None:
    for end in "FR":
        for kind in ("hip", "thigh", "calf"):
            right, left = (go1.model.body(f"{end}{side}_{kind}") for side in "RL")
            np.testing.assert_allclose(right.pos * [1, -1, 1], left.pos)
            if kind != "calf":  # the calf's own centre is off by a millimetre on both sides
                np.testing.assert_allclose(right.ipos * [1, -1, 1], left.ipos)
            np.testing.assert_allclose(right.inertia, left.inertia, rtol=1e-6)


def test_home_keyframe_is_home(go1: System) -> None:
    at = layout(go1.model)
    key = go1.model.key("home").qpos
    np.testing.assert_allclose(key, home(go1.model), atol=1e-4)
    np.testing.assert_allclose(key[at.trunk][2], HOME_HEIGHT, atol=1e-4)


@pytest.mark.parametrize("friction", [0.2, 0.6])
@pytest.mark.parametrize("heading", [0.0, np.pi / 4])
def test_the_box_slides_v_squared_over_two_mu_g(go1: System, friction: float, heading: float) -> None:
    """In any direction: with a pyramidal cone a slide at 45 degrees would go 1.4 times as far."""
    model = with_theta(go1, floor_friction=friction)
    data, at = settled(model, box_x=5.0), layout(model)
    start = data.qpos[at.box][:2].copy()
    data.qvel[at.box_v][:2] = np.cos(heading), np.sin(heading)
    for _ in range(300):
        mujoco.mj_step(model, data)
    gone = np.linalg.norm(data.qpos[at.box][:2] - start)
    assert gone == pytest.approx(1.0 / (2.0 * friction * G), rel=0.05)


@pytest.mark.parametrize("mass", [2.0, 6.0])
def test_a_known_push_accelerates_the_box_by_its_mass(go1: System, mass: float) -> None:
    model = with_theta(go1, box_mass=mass, floor_friction=0.3)
    data, at = settled(model, box_x=5.0), layout(model)
    data.xfrc_applied[model.body("box").id, 0] = force = 30.0
    for _ in range(50):
        mujoco.mj_step(model, data)
    assert data.qvel[at.box_v][0] / 0.2 == pytest.approx(force / mass - 0.3 * G, rel=0.03)


def test_inertia_scale_leaves_the_mass(go1: System) -> None:
    model, plain = with_theta(go1, box_inertia_scale=1.5), with_theta(go1)
    np.testing.assert_allclose(model.body("box").inertia, 1.5 * plain.body("box").inertia)
    assert model.body("box").mass == plain.body("box").mass


@pytest.mark.parametrize("build", [planner_model, plant_model])
def test_it_stands_for_three_seconds(build) -> None:
    model = build(Box(position=(5.0, 0.0)))
    data = settled(model)
    at = layout(model)
    while data.time < 3.0:
        mujoco.mj_step(model, data)
    trunk = data.qpos[at.trunk]
    assert 0.25 < trunk[2] < HOME_HEIGHT
    assert np.hypot(*trunk[4:6]) < np.sin(np.radians(2.0) / 2.0)
    assert np.abs(data.qvel[at.trunk_v]).max() < 0.02
    assert not data.warning.number.any()


def test_poses_are_compared_and_twists_bound_the_first_state_only(go1: System) -> None:
    compared = {c.key for c in go1.channels if c.compared}
    assert compared == {
        "joints.position", "trunk.position", "trunk.orientation", "box.position", "box.orientation",
    }  # fmt: skip
    assert all(c.noise for c in go1.channels if c.sets_state)
