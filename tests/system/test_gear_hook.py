"""The hook of examples/ holds what the engine holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

HOOK = Path(__file__).parents[2] / "examples" / "gear_friction.py"
STEP = 0.004
ARM = """<mujoco><option timestep="{dt}"/><worldbody><body><joint name="hip" axis="0 1 0" frictionloss=".01"/>
  <geom type="sphere" size=".02" pos=".2 0 0" mass="1"/></body></worldbody>
  <actuator><motor name="m" joint="hip"/></actuator>
  <custom><numeric name="gear_friction/hip" data="0 {k} 0 .1 1 0 0 0"/></custom></mujoco>"""


@pytest.mark.parametrize(("k", "moves"), [(0.9, True), (1.1, False)])
def test_a_gear_that_locks_holds_its_load(k: float, moves: bool) -> None:
    names: dict[str, Any] = {}
    exec(HOOK.read_text(), names)
    model = mujoco.MjModel.from_xml_string(ARM.format(dt=STEP, k=k))
    data, hook = mujoco.MjData(model), names["GearFriction"](model)
    mujoco.mj_forward(model, data)
    for _ in range(50):
        hook(data)
        mujoco.mj_step(model, data)
    # the load is 1.96 N m: friction holds 0.01 + k times as much
    assert model.dof_frictionloss[0] == pytest.approx(0.01 + k * 1.962 * np.cos(data.qpos[0]), rel=0.02)
    assert (data.qpos[0] > 0.05) == moves
    expected = 0.5 * (1.962 * (1 - k) - 0.01) / (0.04 + 1.6e-4) * 0.2**2
    assert not moves or data.qpos[0] == pytest.approx(expected, rel=0.1)
