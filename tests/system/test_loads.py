"""Loads of arms: what hangs on a flange, in each arm's own form."""

import json
import re

import mujoco
import numpy as np
import pytest

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.loads import WRITERS, load_of, principal, xacro_properties
from amhe_cli.system.system import System

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


def test_a_flange_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="`flange`: .*flang"):
        load_of(mujoco.MjModel.from_xml_string(ARM), "flang")
