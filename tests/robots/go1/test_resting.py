"""Heights of the trunk from joints, beside the plant at rest."""

from __future__ import annotations

import numpy as np
import pytest

from amhe_cli.core.rotations import exp
from amhe_cli.robots.go1.kinematics import HOME, HOME_HEIGHT
from amhe_cli.robots.go1.model import plant_model
from amhe_cli.robots.go1.motor_plant import MotorPlant
from amhe_cli.robots.go1.resting import trunk_height

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def test_a_lying_robot_is_at_rest_where_it_should_be_and_as_high_as_its_joints_say() -> None:
    plant = MotorPlant(plant_model(timestep=0.001), np.random.default_rng(0))
    plant.lie_down()
    trunk = plant.state.trunk
    assert trunk_height(trunk.orientation, plant.state.joints) == pytest.approx(trunk.position[2], abs=0.002)
    for _ in range(50):
        plant.advance(np.zeros(12), 0.02)
    after = plant.state.trunk
    np.testing.assert_allclose(after.position, trunk.position, atol=1e-3)
    np.testing.assert_allclose(after.position[:2], 0.0, atol=1e-3)
    np.testing.assert_allclose(abs(after.orientation @ LEVEL), 1.0, atol=1e-4)


def test_a_standing_robot_is_as_high_as_its_legs() -> None:
    assert trunk_height(LEVEL, HOME) == pytest.approx(HOME_HEIGHT, abs=0.02)


def test_a_robot_on_its_side_rests_on_its_side() -> None:
    assert 0.1 < trunk_height(exp(np.array([0.5 * np.pi, 0.0, 0.0])), HOME) < 0.3
