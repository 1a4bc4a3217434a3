"""The reaction of a robot on its base, against the pendulum's own equations."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.reaction import fixed_base, momentum, tangents

MASS, LENGTH, STEP = 2.0, 0.5, 0.001
PENDULUM = f"""<mujoco><option timestep="{STEP}"/><worldbody><body><joint axis="0 1 0"/>
  <geom type="sphere" size="0.001" pos="0 0 {-LENGTH}" mass="{MASS}"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM)


def test_momentum_of_a_pendulum(model: mujoco.MjModel) -> None:
    angle, speed = np.array([[0.3], [-1.0]]), np.array([[2.0], [-0.5]])
    found, weight = momentum(model, angle, speed)
    sin, cos, rate = np.sin(angle[:, 0]), np.cos(angle[:, 0]), speed[:, 0]
    np.testing.assert_allclose(found[:, 0], -MASS * LENGTH * cos * rate, rtol=1e-9)
    np.testing.assert_allclose(found[:, 2], MASS * LENGTH * sin * rate, rtol=1e-9)
    np.testing.assert_allclose(found[:, 4], MASS * LENGTH**2 * rate, rtol=1e-4)
    # what the pivot takes: the rate of the momentum less the moment of the weight about it
    np.testing.assert_allclose(weight[:, 4], MASS * 9.81 * LENGTH * sin, rtol=1e-9)


def test_a_base_that_moves_pushes_the_joint(model: mujoco.MjModel) -> None:
    """In the frame of its base, a pendulum falls as if gravity were less the acceleration, and turned."""
    angle = np.array([[0.3], [-1.0]])
    found = tangents(model, int(mujoco.mjtState.mjSTATE_CTRL), angle, np.zeros((2, 1)), np.zeros((2, 0)))
    sin, cos = np.sin(angle[:, 0]), np.cos(angle[:, 0])
    np.testing.assert_allclose(found.push[:, 0, 0], STEP * cos / LENGTH, rtol=1e-4)
    np.testing.assert_allclose(found.push[:, 0, 2], -STEP * sin / LENGTH, rtol=1e-4)
    np.testing.assert_allclose(found.push[:, 0, 4], -STEP, rtol=1e-4)
    # turned about the joint's axis, it hangs as before in the world
    np.testing.assert_allclose(found.lean[:, 0, 4], -STEP * 9.81 * cos / LENGTH, rtol=1e-4)
    np.testing.assert_allclose(found.step[:, 1, 0], -STEP * 9.81 * cos / LENGTH, rtol=1e-2)


def test_what_flies_has_no_fixed_base(model: mujoco.MjModel) -> None:
    flying = '<mujoco><worldbody><body><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
    assert fixed_base(model)
    assert not fixed_base(mujoco.MjModel.from_xml_string(flying))
