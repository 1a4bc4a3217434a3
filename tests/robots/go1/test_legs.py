"""Leg kinematics against MuJoCo and against themselves."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from amhe_cli.robots.go1 import kinematics as legs
from amhe_cli.robots.go1.model import layout, planner_model


@pytest.fixture
def joints() -> np.ndarray:
    """Poses within the limits, knees not straight, feet below the hips: shape (50, 12)."""
    rng = np.random.default_rng(0)
    return rng.uniform(np.tile([-0.8, 0.0, -2.6], 4), np.tile([0.8, 1.4, -0.95], 4), (50, 12))


def test_feet_are_where_mujoco_has_them(joints: np.ndarray) -> None:
    model = planner_model()
    data, at = mujoco.MjData(model), layout(model)
    for q in joints:
        data.qpos[at.trunk] = [0, 0, 0, 1, 0, 0, 0]
        data.qpos[at.joints] = q
        mujoco.mj_kinematics(model, data)
        there = np.array([data.site(f"{leg}_foot").xpos for leg in legs.LEGS])
        np.testing.assert_allclose(legs.feet(q), there, atol=1e-9)


def test_inverse_undoes_forward_for_any_leading_shape(joints: np.ndarray) -> None:
    stacked = joints.reshape(5, 10, 12)
    np.testing.assert_allclose(legs.joint_angles(legs.feet(stacked)), stacked, atol=1e-9)


def test_inverse_leaves_a_foot_out_of_reach_in_its_direction() -> None:
    far = legs.feet(legs.HOME) + np.array([0.3, 0.0, -0.4])
    reached = legs.feet(legs.joint_angles(far))
    assert np.isfinite(reached).all()
    thighs = legs.HIPS + legs.SIDE[:, None] * [0.0, legs.HIP_OFFSET, 0.0]
    wanted, got = far - thighs, reached - thighs
    cosine = (wanted * got).sum(-1) / np.linalg.norm(wanted, axis=-1) / np.linalg.norm(got, axis=-1)
    np.testing.assert_allclose(cosine, 1.0, atol=1e-6)


def moved(joints: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Velocity of the feet (..., 4, 3) while the joints move at `rates` (..., 12), by differences."""
    step = 1e-6
    return (legs.feet(joints + step * rates) - legs.feet(joints - step * rates)) / (2.0 * step)


def test_rates_move_the_feet_as_asked(joints: np.ndarray) -> None:
    velocity = np.random.default_rng(1).normal(size=(50, 4, 3))
    np.testing.assert_allclose(moved(joints, legs.joint_rates(joints, velocity)), velocity, atol=1e-7)


def test_holding_torques_do_no_work_against_the_ground(joints: np.ndarray) -> None:
    """Virtual work: joint torques and ground forces cancel for every small motion of the legs."""
    rng = np.random.default_rng(2)
    forces, motion = rng.normal(size=(50, 4, 3)), rng.normal(size=(50, 12))
    work = (legs.holding_torques(joints, forces) * motion).sum(-1)
    work += (forces * moved(joints, motion)).sum((-1, -2))
    np.testing.assert_allclose(work, 0.0, atol=1e-7)
