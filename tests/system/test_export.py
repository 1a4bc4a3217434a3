"""The identified model loads on its own and has the numbers of `edits.apply`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from amhe_cli.system.export.mjcf import identified_assets, identified_xml
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
