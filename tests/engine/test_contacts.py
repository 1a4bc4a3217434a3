"""Forces between touching bodies."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.states import contact_forces

WORLD = """<mujoco><option timestep="0.002"/><worldbody>
  <body name="upper" pos="0 0 0.5"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body>
  <body name="lower" pos="0.3 0 0.2"><freejoint/><geom type="box" size="0.5 0.5 0.2" mass="4"/></body>
  <geom type="plane" size="3 3 0.1"/>
  </worldbody></mujoco>"""


def test_a_ball_on_a_box_on_the_floor_presses_with_its_weight() -> None:
    model = mujoco.MjModel.from_xml_string(WORLD)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 800)
    mujoco.mj_forward(model, data)
    forces = contact_forces(model, data)
    floor, between = forces[np.argsort(-np.abs(forces[:, 5]))]
    assert floor[3:] == pytest.approx([0.0, 0.0, 5.0 * 9.81], abs=0.1)  # on the box, which the floor carries
    # the centre of pressure: moments about the box's centre balance
    assert floor[:3] == pytest.approx([0.3 - 0.3 * 1.0 / 5.0, 0.0, 0.0], abs=0.01)
    # the box is the second of the two: the ball presses it down
    assert between[3:] == pytest.approx([0.0, 0.0, -9.81], abs=0.1)
    assert between[:3] == pytest.approx([0.0, 0.0, 0.4], abs=0.01)


def test_nothing_touches_in_the_air() -> None:
    model = mujoco.MjModel.from_xml_string(WORLD.replace("0.3 0 0.2", "0 0 1"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert contact_forces(model, data).shape == (0, 6)
