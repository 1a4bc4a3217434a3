"""What hangs on an arm's flange, as arms' own programs take it, and parameters as properties of xacro files.

Each writer gets mass [kg], centre of mass [m] and inertia about it [kg m^2], all in the axes of the flange:

ur      URScript: set_target_payload(m, cog, inertia) with [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] (script manual)
franka  JSON of a request to franka_msgs/srv/SetLoad, as libfranka's setLoad takes it
kuka    KRL: LOAD of mass, place [mm], directions A B C of the principal axes [degrees, about z, y and x], and
        the moments about them
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.system.model.elements import names_of
from amhe_cli.system.parameters.inertia import inertia_of
from amhe_cli.system.system import System

#: Mass, centre of mass (3,), and inertia about it (3, 3).
Load = tuple[float, FloatArray, FloatArray]


def load_of(model: mujoco.MjModel, flange: str) -> Load:
    """A body and all that hangs on it, at the model's home pose, in the axes of that body.

    Raises:
        ConfigError: The model has no such body, or it weighs nothing.
    """
    names = names_of(model, "body")
    if flange not in names:
        raise ConfigError(f"`flange`: {one_of('body', flange, names)}")
    data, row = mujoco.MjData(model), model.body(flange).id
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies = [row]
    bodies += [b for b in range(row + 1, model.nbody) if model.body_parentid[b] in bodies]
    mass = float(model.body_mass[bodies].sum())
    if not mass > 0.0:
        raise ConfigError(f"`flange`: nothing at or behind {flange!r} has a mass")
    centre, inertia = model.body_mass[bodies] @ data.xipos[bodies] / mass, np.zeros((3, 3))
    for body in bodies:
        axes, away = data.ximat[body].reshape(3, 3), data.xipos[body] - centre
        inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        inertia += model.body_mass[body] * (away @ away * np.eye(3) - np.outer(away, away))
    turn = data.xmat[row].reshape(3, 3)
    return mass, turn.T @ (centre - data.xpos[row]), turn.T @ inertia @ turn


def _ur(mass: float, centre: FloatArray, inertia: FloatArray) -> str:
    six = inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    return f"set_target_payload({_number(mass)}, [{_listed(centre)}], [{_listed(six)}])\n"


def _franka(mass: float, centre: FloatArray, inertia: FloatArray) -> str:
    load = {"mass": mass, "center_of_mass": centre.tolist(), "load_inertia": inertia.ravel("F").tolist()}
    return json.dumps(load, indent=1) + "\n"


def _kuka(mass: float, centre: FloatArray, inertia: FloatArray) -> str:
    moments, axes = principal(inertia)
    a = np.arctan2(axes[1, 0], axes[0, 0])
    b = np.arctan2(-axes[2, 0], np.hypot(axes[0, 0], axes[1, 0]))
    c = np.arctan2(axes[2, 1], axes[2, 2])
    place = zip("XYZABC", (*(1e3 * centre), *np.degrees((a, b, c))), strict=True)
    frame = ", ".join(f"{name} {_number(value)}" for name, value in place)
    turned = ", ".join(f"{name} {_number(value)}" for name, value in zip("XYZ", moments, strict=True))
    return f"LOAD_DATA[1]={{M {_number(mass)}, CM {{{frame}}}, J {{{turned}}}}}\n"


def principal(inertia: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Principal moments (3,) and their axes as columns of a rotation (3, 3), each near the flange's own."""
    moments, axes = np.linalg.eigh(inertia)
    order = max(
        ([0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]),
        key=lambda order: np.abs(axes[range(3), order]).sum(),
    )
    axes = axes[:, order] * np.sign(axes[range(3), order] + 1e-300)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return moments[order], axes


#: Kind of export -> its file, and what writes it.
WRITERS: Mapping[str, tuple[str, Callable[[float, FloatArray, FloatArray], str]]] = {
    "ur": ("load.script", _ur), "franka": ("load.json", _franka), "kuka": ("load.dat", _kuka),
}  # fmt: skip


def xacro_properties(system: System, theta: FloatArray) -> str:
    """A xacro file of properties, to be included by the robot's own.

    Each parameter is one; of a body's inertia, its mass, centre of mass, and moments about it, in the axes of
    the body. Names are those of Python, which xacro reads: what is no letter or digit is an underscore.

    Raises:
        ConfigError: Two numbers would have one name.
    """
    named = zip(system.space.names, theta.tolist(), strict=True)
    values = {name: value for name, value in named if not inertia_of(name)}
    for body, numbers in system.edits.inertias(theta[None]):
        values |= {f"{body}.{name}": float(number[0]) for name, number in numbers.items()}
    names = [re.sub(r"^(?=\d)|[^A-Za-z0-9]", "_", name) for name in values]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(
            f"two numbers would both be the property {twice[0]!r}: rename a parameter or a body"
        )
    pairs = zip(names, map(_number, values.values()), strict=True)
    rows = [f"  <xacro:property name={quoteattr(n)} value={quoteattr(v)}/>" for n, v in pairs]
    head = '<?xml version="1.0"?>\n<robot xmlns:xacro="http://www.ros.org/wiki/xacro">'
    return "\n".join((head, *rows, "</robot>")) + "\n"


def _number(value: float) -> str:
    return f"{value + 0.0:.6g}"


def _listed(values: FloatArray) -> str:
    return ", ".join(map(_number, values))
