"""Steps in the tangent space of the states."""

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.states import integrated
from amhe_cli.system.system import System


def test_tangent_steps_are_mujocos_own() -> None:
    model, rng = System.load("cube_toss").model, np.random.default_rng(3)
    qpos = np.array(model.qpos0)
    qpos[3:] = rng.normal(size=4)
    qpos[3:] /= np.linalg.norm(qpos[3:])
    delta = rng.normal(0.0, 0.3, 6)
    expected = qpos.copy()
    mujoco.mj_integratePos(model, expected, delta, 1.0)
    assert integrated(model, qpos, delta) == pytest.approx(expected, abs=1e-12)
