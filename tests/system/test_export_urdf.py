"""The identified model as a URDF moves as the MJCF does, and a URDF of one's own keeps its text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.mjcf import identified_spec
from amhe_cli.system.export.urdf import identified_urdf
from amhe_cli.system.model.files import compiled, read_spec
from amhe_cli.system.system import System

Write = Callable[..., Path]

#: Offset anchors, a zero that is not zero, two joints in one body, turned frames, limits, a mimic.
ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0.1 0 0.2" euler="0 0 0.3">
      <geom name="foot" type="box" size="0.1 0.1 0.02"/>
      <body name="upper" pos="0 0 0.1" euler="0.2 0 0">
        <joint name="yaw" axis="0 0 1" pos="0.02 0 0" ref="0.4" damping="0.3"/>
        <joint name="pitch" axis="0 1 0" pos="0 0.01 0.05" range="-1 1" frictionloss="0.1"
               actuatorfrcrange="-7 7"/>
        <geom type="capsule" fromto="0 0 0.05 0.1 0 0.3" size="0.03" mass="1.3"/>
        <body name="slider" pos="0.1 0 0.3" quat="0.9 0.1 0.3 0.2">
          <joint name="rail" type="slide" axis="1 0 0" range="-0.2 0.1" ref="0.05" damping="2"/>
          <geom type="sphere" size="0.04" pos="0.02 0.03 0" mass="0.6"/>
          <geom type="cylinder" size="0.02 0.05" pos="0 0.1 0" mass="0.2"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
PARAMETER = "  m: {nominal: 0.8, bounds: [0.1, 5], targets: [{body: slider, set: mass}]}\n"
SIGNAL = "signals:\n  joints: {topic: /j, joints: [yaw, pitch, rail], noise: {position: 0.01}}\n"


def dynamics(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
    """Inertia matrix, bias and passive forces, by joint name."""
    data = mujoco.MjData(model)
    names = ("yaw", "pitch", "rail")
    for name, position, speed in zip(names, q, v, strict=True):
        data.joint(name).qpos, data.joint(name).qvel = position, speed
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    rows = [int(model.joint(name).dofadr[0]) for name in names]
    return [
        full[np.ix_(rows, rows)],
        data.qfrc_bias[rows],
        data.qfrc_passive[rows],
        model.dof_frictionloss[rows],
    ]


def test_a_urdf_moves_as_the_model_does(written: Write, tmp_path: Path) -> None:
    system = System.load(written(PARAMETER, SIGNAL, ARM, ""))
    theta = np.array([1.1])
    path = tmp_path / "identified.urdf"
    path.write_text(identified_urdf(system, theta))
    urdf, own = compiled(read_spec(path)), compiled(identified_spec(system, theta))
    rng = np.random.default_rng(3)
    for _ in range(3):
        q, v = rng.uniform(-0.1, 0.1, 3), rng.normal(size=3)
        for one, other in zip(dynamics(urdf, q, v), dynamics(own, q, v), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=5e-6)
    np.testing.assert_allclose(urdf.joint("rail").range, [-0.2, 0.1])
    assert 'effort="7"' in path.read_text()


def test_what_no_urdf_can_say_is_refused(with_target: Write) -> None:
    system = System.load(with_target("{joint: hip, set: damping}"))
    with pytest.raises(ConfigError, match="ball"):
        identified_urdf(system, system.space.nominal)


URDF = """<robot name="arm">
  <!-- a remark -->
  <link name="base"/>
  <link name="rod"><inertial><origin xyz="0 0 -0.2"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://arm/rod.stl"/></geometry></visual></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
    <dynamics damping="0.1"/></joint>
</robot>
"""


def test_a_urdf_of_ones_own_keeps_its_text(tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf"
    source.write_text(URDF)
    system = System.from_model(
        source,
        meshes=False,
        parameters={
            "mass": {"targets": [{"body": "rod", "set": "mass"}]},
            "damping": {"targets": [{"joint": "hinge", "set": "damping"}]},
        },
        signals={"joints": {"joints": ["hinge"], "noise": {"position": 0.01}}},
    )
    text = identified_urdf(system, np.array([2.0, 0.3]), source)
    assert "package://arm/rod.stl" in text
    assert "a remark" in text
    model = mujoco.MjModel.from_xml_string(
        text.replace('<mesh filename="package://arm/rod.stl" />', '<box size="1 1 1"/>')
    )
    assert model.body("rod").mass[0] == pytest.approx(2.0)
    assert model.body("rod").inertia.max() == pytest.approx(0.02)
    assert model.joint("hinge").damping[0] == pytest.approx(0.3)


def test_a_urdf_of_another_robot_is_refused(written: Write, tmp_path: Path) -> None:
    source = tmp_path / "arm.urdf"
    source.write_text(URDF)
    system = System.load(written(PARAMETER, SIGNAL, ARM, ""))
    with pytest.raises(ConfigError, match="no link 'slider'"):
        identified_urdf(system, system.space.nominal, source)
