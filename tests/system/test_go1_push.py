"""The bundled Go1 and its box against the published numbers and against physics."""

from __future__ import annotations

import logging

import mujoco
import numpy as np
import pytest

from amhe_cli.robots.go1.kinematics import HOME, HOME_HEIGHT
from amhe_cli.robots.go1.model import Box, home, layout, planner_model, plant_model
from amhe_cli.system.system import System

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
def test_a_slide_ends_after_v_squared_over_two_mu_g(go1: System, friction: float, heading: float) -> None:
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
