"""A URDF with identified values keeps the rest of its text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.urdf import identified_urdf
from amhe_cli.system.system import System

Write = Callable[..., Path]

ARM = """<mujoco><worldbody><body name="slider"><joint name="rail" type="slide"/>
  <geom type="sphere" size="0.04" mass="0.6"/></body></worldbody></mujoco>"""
PARAMETER = "  m: {nominal: 0.8, bounds: [0.1, 5], targets: [{body: slider, set: mass}]}\n"
SIGNAL = "signals:\n  joints: {topic: /j, joints: [rail], noise: {position: 0.01}}\n"


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
