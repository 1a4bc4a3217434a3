"""First states and inputs: steps in the tangent space, commands that act late; forces of contacts."""

import mujoco
import numpy as np
import pytest

from amhe_cli.engine.rollout import Starts
from amhe_cli.engine.states import contact_forces, first_activations, in_state, integrated
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


def test_inputs_have_their_places_in_the_whole_state() -> None:
    model, rng = System.load("go1_push").model, np.random.default_rng(4)
    data = mujoco.MjData(model)
    data.ctrl, data.xfrc_applied = rng.normal(size=model.nu), rng.normal(size=(model.nbody, 6))
    parts = (
        int(mujoco.mjtState.mjSTATE_INTEGRATION),
        int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_XFRC_APPLIED),
    )
    whole, inputs = (np.empty(mujoco.mj_stateSize(model, spec)) for spec in parts)
    for values, spec in zip((whole, inputs), parts, strict=True):
        mujoco.mj_getState(model, data, values, spec)
    np.testing.assert_array_equal(whole[in_state(model, parts[1])], inputs)
    assert in_state(model, 0).size == 0


def test_commands_beyond_the_history_hold_its_ends() -> None:
    ramp = np.arange(1.0, 5.0)[None, :, None]
    starts = Starts(
        qpos=np.zeros((1, 1)),
        qvel=np.zeros((1, 1)),
        inputs=ramp,
        history=0,
        lengths=np.array([4]),
        first_index=np.zeros(0, dtype=int),
        first_sd=np.zeros((1, 0)),
    )
    late, early = starts.inputs_under(np.array([[1.5], [-1.0]]))[..., 0]
    np.testing.assert_allclose(late, [1.0, 1.0, 1.5, 2.5])
    np.testing.assert_allclose(early, [2.0, 3.0, 4.0, 4.0])


def test_filters_and_slews_start_at_their_command_and_what_else_has_a_state_at_zero() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="j" axis="0 1 0" range="-1 1"/><geom size="0.1"/></body>
        </worldbody><actuator>
          <position joint="j" kp="1" timeconst="0.1" ctrlrange="-0.5 0.5"/>
          <intvelocity joint="j" kp="1" gear="2" actrange="-1 1"/>
          <pid joint="j" kp="1" ki="1" slewmax="1"/>
          <dcmotor joint="j" motorconst="0.5" resistance="2" lugre="10 1 0.1 0.2 0.3"/>
        </actuator></mujoco>"""
    )
    controls = np.array([[0.7, 0.1, 0.2, 0.3, 0.4], [0.0, 0.0, 0.0, 0.0, 0.0]])
    found = first_activations(model, np.array([[0.3], [0.0]]), controls)
    np.testing.assert_allclose(found, [[0.5, 0.6, 0.2, 0.0, 0.0], [0.0] * 5])


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
