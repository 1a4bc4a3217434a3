"""Exports: MJCF, URDF, the load at a flange, and the hook for friction of gears."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.loads import WRITERS, load_of, principal, xacro_properties
from amhe_cli.system.export.mjcf import identified_assets, identified_xml
from amhe_cli.system.export.urdf import identified_urdf
from amhe_cli.system.model.files import compiled
from amhe_cli.system.system import System

from .test_edits import TARGETS

Write = Callable[..., Path]
#: MuJoCo writes six digits.
DIGITS = 2e-5


def reloaded(system: System, theta: np.ndarray) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(identified_xml(system, theta))


def assert_same_numbers(system: System, theta: np.ndarray, model: mujoco.MjModel) -> None:
    expected = system.edits.apply(compiled(system.original.copy()), theta)
    fields = (
        *system.edits.fields,
        "body_mass",
        "body_inertia",
        "dof_invweight0",
        "geom_friction",
        "pair_friction",
    )
    for name in fields:
        np.testing.assert_allclose(
            getattr(model, name), getattr(expected, name), rtol=DIGITS, atol=1e-9, err_msg=name
        )


@pytest.mark.parametrize("target", TARGETS)
def test_every_target_survives(target: str, with_target: Write) -> None:
    keys, value, *_ = TARGETS[target]
    system = System.load(with_target(target, keys))
    theta = np.array([value])
    assert_same_numbers(system, theta, reloaded(system, theta))


def test_a_whole_inertia_survives(with_target: Write) -> None:
    system = System.load(with_target("{body: hand, set: pseudo_inertia}"))
    theta = np.random.default_rng(2).normal(0.0, 0.3, 10)
    assert_same_numbers(system, theta, reloaded(system, theta))


@pytest.mark.parametrize("name", ["cube_toss", "pendulum"])
def test_bundled_systems_survive(name: str) -> None:
    system = System.load(name)
    theta = system.space.nominal * 1.1
    text = identified_xml(system, theta)
    assert f"{system.space.names[0]} = {theta[0]:.6g}" in text
    assert "amhe/" not in text
    assert_same_numbers(system, theta, mujoco.MjModel.from_xml_string(text))


@pytest.mark.parametrize("compiler", ['settotalmass="7"', 'inertiafromgeom="true"', 'angle="radian"'])
def test_compiler_settings_do_not_undo_the_values(compiler: str, with_target: Write) -> None:
    from .conftest import MODEL

    model = MODEL.replace("<worldbody>", f"<compiler {compiler}/><worldbody>", 1)
    system = System.load(with_target("{body: hand, set: mass}", model=model))
    theta = np.array([0.9])
    assert_same_numbers(system, theta, reloaded(system, theta))


def test_meshes_travel_with_the_file(written: Write, tmp_path: Path) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    model = """<mujoco><compiler meshdir="parts"/>
      <asset><mesh name="a" file="left/part.obj"/><mesh name="b" file="right/part.obj" scale="2 2 2"/></asset>
      <worldbody><body name="b"><freejoint/><geom type="mesh" mesh="a"/><geom type="mesh" mesh="b"/></body>
      </worldbody>      </mujoco>"""
    for side in ("left", "right"):
        part = tmp_path / "parts" / side / "part.obj"
        part.parent.mkdir(parents=True)
        part.write_text(corners)
    signals = "signals: {b: {topic: /b, body: b, noise: {position: 0.01}}}\n"
    system = System.load(
        written("  p: {targets: [{body: b, set: mass}]}\n", signals=signals, model=model, more="")
    )
    out = tmp_path / "elsewhere"
    out.mkdir()
    theta = np.array([300.0])
    (out / "identified.xml").write_text(identified_xml(system, theta))
    for name, source in identified_assets(system).items():
        (out / name).parent.mkdir(exist_ok=True)
        shutil.copy(source, out / name)
    assert sorted(path.name for path in (out / "assets").iterdir()) == ["2_part.obj", "part.obj"]
    assert_same_numbers(system, theta, mujoco.MjModel.from_xml_path(str(out / "identified.xml")))


@pytest.mark.parametrize("default", ["", '<default><position kp="20" kv="1"/></default>'])
def test_servos_are_written_so_that_mujoco_3_reads_them(default: str, written: Write) -> None:
    model = f"""<mujoco>{default}<worldbody><body name="arm">
      <joint name="hip" damping="0.1"/><geom name="arm" size="0.1"/></body></worldbody>
      <actuator><position name="servo" joint="hip" kp="20" kv="1"/>
      <velocity name="speed" joint="hip" kv="2"/></actuator></mujoco>"""
    parameters = "  p: {nominal: 0.2, bounds: [0.1, 1], targets: [{joint: hip, set: damping}]}\n"
    system = System.load(written(parameters, model=model, more=""))
    text = identified_xml(system, np.array([0.3]))
    assert "input=" not in text  # MuJoCo 3.11: "XML Error: invalid keyword: 'pos'"
    found, own = mujoco.MjModel.from_xml_string(text), system.model
    for field in ("actuator_gainprm", "actuator_biasprm", "actuator_ctrlnum"):
        np.testing.assert_array_equal(getattr(found, field), getattr(own, field))


URDF_ARM = """<mujoco><worldbody><body name="slider"><joint name="rail" type="slide"/>
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
    system = System.load(written(PARAMETER, SIGNAL, URDF_ARM, ""))
    with pytest.raises(ConfigError, match="no link 'slider'"):
        identified_urdf(system, system.space.nominal, source)


#: A flange that looks along -x, and a tool of two parts behind it, one of them turned.
ARM = """<mujoco><worldbody><body name="link" pos="0 0 1" euler="0 20 0"><joint axis="0 1 0"/>
<inertial pos="0 0 0" mass="3" diaginertia=".1 .1 .1"/>
<body name="flange" pos=".1 0 .5" euler="0 0 180">
<inertial pos="0 0 .01" mass=".2" diaginertia="1e-4 1e-4 2e-4"/>
<body name="tool" pos="0 .05 .1" euler="30 0 0">
<inertial pos="0 0 .02" mass="1.3" diaginertia="3e-3 2e-3 1e-3"/></body></body></body></worldbody></mujoco>"""


def test_a_load_is_that_of_one_body_with_all_that_hangs_on_it() -> None:
    """MuJoCo fuses bodies that are welded together, if it is told to."""
    spec = mujoco.MjSpec.from_string(ARM)
    mass, centre, inertia = load_of(spec.compile(), "flange")
    assert mass == pytest.approx(1.5)
    # a free body of the same parts: its acceleration under a wrench at the flange is that of the load
    alone = ARM.replace('<joint axis="0 1 0"/>', "").replace(
        'euler="0 0 180">', 'euler="0 0 180"><freejoint/>'
    )
    alone = alone[: alone.index('<body name="link"')] + alone[alone.index('<body name="flange"') :]
    model = mujoco.MjModel.from_xml_string(alone.replace("</body></body></body>", "</body></body>"))
    data, full = mujoco.MjData(model), np.zeros((6, 6))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    turn = data.body("flange").xmat.reshape(3, 3)
    about_origin = full[3:, 3:]  # in the axes of the body
    shifted = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    assert np.allclose(about_origin, shifted, atol=1e-12)
    assert np.allclose(data.subtree_com[1], data.body("flange").xpos + turn @ centre)


def test_each_arm_gets_its_own_form() -> None:
    mass, centre = 1.5, np.array([0.01, -0.02, 0.05])
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    inertia = turn @ np.diag((3e-3, 2e-3, 1e-3)) @ turn.T
    text = {kind: write(mass, centre, inertia) for kind, (_, write) in WRITERS.items()}
    numbers = [float(n) for n in re.findall(r"-?[\d.]+(?:e-?\d+)?", text["ur"])]
    assert text["ur"].startswith("set_target_payload(1.5, [0.01, -0.02, 0.05], [")
    xx, yy, zz, xy, xz, yz = numbers[4:]
    assert np.allclose([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], inertia, atol=1e-8)
    load = json.loads(text["franka"])
    assert (load["mass"], load["center_of_mass"]) == (1.5, centre.tolist())
    assert np.allclose(np.reshape(load["load_inertia"], (3, 3)), inertia)
    found = dict(
        re.findall(r"([A-Z]) (-?[\d.e-]+)", text["kuka"].replace("J {X", "J {U").replace(", J", " J"))
    )
    assert (float(found["M"]), float(found["X"])) == (1.5, 10.0)
    a, b, c = (np.radians(float(found[name])) for name in "ABC")
    rz, ry, rx = (np.array(m) for m in (
        [[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]],
        [[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]],
        [[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]],
    ))  # fmt: skip
    axes, moments = rz @ ry @ rx, principal(inertia)[0]
    assert np.allclose(axes @ np.diag(moments) @ axes.T, inertia, atol=1e-8)
    assert "J {X " in text["kuka"]


def test_properties_are_those_of_xacro() -> None:
    system = System.load("pendulum")
    text = xacro_properties(system, system.space.nominal)
    assert '<xacro:property name="load_mass" value="0.4"/>' in text
    assert text.count("<xacro:property") == len(system.space)


def test_properties_of_an_inertia_are_those_of_its_body(with_target: Write) -> None:
    system = System.load(with_target("{body: hand, set: pseudo_inertia}"))
    text = xacro_properties(system, system.space.nominal)
    values = dict(re.findall(r'property name="([^"]*)" value="([^"]*)"', text))
    (mass,) = (float(value) for name, value in values.items() if name.endswith("_mass"))
    assert mass == pytest.approx(system.model.body("hand").mass[0], rel=1e-5)
    assert len(values) == 10 and all(name.isidentifier() for name in values)


def test_numbers_that_would_be_one_property_are_refused() -> None:
    system = System.load("pendulum")
    first, second, *others = system.space.parameters
    alike = (replace(first, name="left-hip"), replace(second, name="left_hip"), *others)
    with pytest.raises(ConfigError, match="two numbers would both be the property 'left_hip'"):
        xacro_properties(replace(system, space=replace(system.space, parameters=alike)), system.space.nominal)


def test_a_flange_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="`flange`: .*flang"):
        load_of(mujoco.MjModel.from_xml_string(ARM), "flang")


HOOK = Path(__file__).parents[2] / "examples" / "gear_friction.py"
STEP = 0.004
GEARED_ARM = """<mujoco><option timestep="{dt}"/>
  <worldbody><body><joint name="hip" axis="0 1 0" frictionloss=".01"/>
  <geom type="sphere" size=".02" pos=".2 0 0" mass="1"/></body></worldbody>
  <actuator><motor name="m" joint="hip"/></actuator>
  <custom><numeric name="gear_friction/hip" data="0 {k} 0 .1 1 0 0 0"/></custom></mujoco>"""


@pytest.mark.parametrize(("k", "moves"), [(0.9, True), (1.1, False)])
def test_a_gear_that_locks_holds_its_load(k: float, moves: bool) -> None:
    names: dict[str, Any] = {}
    exec(HOOK.read_text(), names)
    model = mujoco.MjModel.from_xml_string(GEARED_ARM.format(dt=STEP, k=k))
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
    fields = ("qfrc_actuator", "qfrc_constraint", "qfrc_smooth", "qfrc_damper", "qvel")
    several = SimpleNamespace(**{name: np.tile(getattr(data, name), (3, 1)) for name in fields})
    batch = SimpleNamespace(dof_frictionloss=np.full((3, 1), 0.01))
    scene = mujoco.MjSpec()
    scene.option.timestep = STEP
    robot = mujoco.MjSpec.from_string(GEARED_ARM.format(dt=STEP, k=k))
    scene.attach(robot, prefix="robot/", frame=scene.worldbody.add_frame())
    as_in_mjlab = names["GearFriction"](scene.compile(), batch)
    batch.dof_frictionloss[:] = model.dof_frictionloss
    as_in_mjlab(several)
    hook(data)
    np.testing.assert_allclose(batch.dof_frictionloss, np.full((3, 1), model.dof_frictionloss[0]), rtol=1e-12)
