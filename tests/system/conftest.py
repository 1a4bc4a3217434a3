"""Small systems for the tests: a model and a system.yaml in a fresh folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" friction="1 0.005 0.0001"/>
    <body name="box" pos="0 0 0.1">
      <freejoint name="box"/>
      <geom name="box" type="box" size="0.1 0.1 0.1" mass="2" condim="4"/>
      <site name="grip" pos="0.1 0 0.05"/>
    </body>
    <body name="arm" pos="1 0 1">
      <joint name="hip" axis="0 1 0" damping="0.1" armature="0.01" frictionloss="0.05" stiffness="2"
             actuatorfrcrange="-6 6"/>
      <geom name="upper" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
      <body name="hand" pos="0 0 -0.3">
        <joint name="knee" axis="0 1 0" damping="0.3"/>
        <geom name="hand" type="box" pos="0.02 0 -0.1" size="0.01 0.02 0.1" mass="0.5"/>
        <site name="imu" pos="0 0 -0.2" euler="0 0 90"/>
      </body>
    </body>
    <body name="ball" pos="2 0 1">
      <joint name="socket" type="ball"/>
      <geom name="ball" size="0.1"/>
    </body>
    <body name="marker" mocap="true" pos="0 2 0"/>
    <body name="table" pos="0 -2 0"><geom name="table" type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
  <contact><pair name="slide" geom1="upper" geom2="table" solref="0.02 1"/></contact>
  <actuator>
    <position name="hip_servo" joint="hip" kp="20" kv="1" forcerange="-5 5"/>
    <motor name="knee_motor" joint="knee" gear="3" forcerange="0 3" ctrlrange="-1 1"/>
    <velocity name="knee_speed" joint="knee" kv="2"/>
    <muscle name="muscle" joint="knee" lengthrange="0.1 0.2"/>
    <pid name="two" joint="hip"/>
  </actuator>
  <sensor>
    <jointpos name="hip_angle" joint="hip"/>
    <touch name="touch" site="imu"/>
  </sensor>
  <keyframe><key name="home" ctrl="0.1 0 0 0 0 0"/></keyframe>
</mujoco>
"""

SIGNALS = """
signals:
  hip:
    topic: /joint_states
    joints: [hip]
    noise: {position: 0.01}
"""

Written = Callable[..., Path]


@pytest.fixture
def written(tmp_path: Path) -> Written:
    """Write a system folder; what is not given is the model above and a signal of its hip."""

    def write(
        parameters: str, signals: str = SIGNALS, model: str = MODEL, more: str = "keyframe: home\n"
    ) -> Path:
        (tmp_path / "scene.xml").write_text(model)
        (tmp_path / "system.yaml").write_text(f"model: scene.xml\n{more}parameters:\n{parameters}{signals}")
        return tmp_path

    return write


@pytest.fixture
def with_target(written: Written) -> Written:
    """Write a system folder whose one parameter `p` has the target and keys given."""

    def write(target: str, keys: str = "", model: str = MODEL) -> Path:
        return written(f"  p: {{targets: [{target}]{', ' + keys if keys else ''}}}\n", model=model)

    return write


@pytest.fixture(scope="session")
def model() -> mujoco.MjModel:
    return mujoco.MjSpec.from_string(MODEL).compile()
