import mujoco
import pytest

from amhe_cli.control.go1_model import plant_model
from tests.control.playing import FAR


@pytest.fixture(scope="session")
def plant() -> mujoco.MjModel:
    """The plant, its box out of the robot's way."""
    return plant_model(FAR)
