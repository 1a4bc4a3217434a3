"""First states and inputs: steps in the tangent space, and commands that act late."""

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.rollout import Starts
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


def test_commands_beyond_the_history_hold_its_ends() -> None:
    ramp = np.arange(1.0, 5.0)[None, :, None]
    starts = Starts(
        qpos=np.zeros((1, 1)),
        qvel=np.zeros((1, 1)),
        inputs=ramp,
        history=0,
        lengths=np.array([4]),
        first_index=np.zeros(0, dtype=int),
        first_sd=np.zeros(0),
    )
    late, early = starts.inputs_under(np.array([[1.5], [-1.0]]))[..., 0]
    np.testing.assert_allclose(late, [1.0, 1.0, 1.5, 2.5])
    np.testing.assert_allclose(early, [2.0, 3.0, 4.0, 4.0])
