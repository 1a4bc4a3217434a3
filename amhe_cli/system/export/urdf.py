"""The identified values in a URDF of the robot, whose text is kept but for them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.mjcf import identified_spec, values_of
from amhe_cli.system.model.files import compiled
from amhe_cli.system.model.urdf import INERTIA
from amhe_cli.system.parameters.inertia import rotation_matrix
from amhe_cli.system.system import System


def identified_urdf(system: System, theta: FloatArray, source: Path) -> str:
    """Text of a URDF with the values of parameters theta (d,): masses, inertias, friction and damping.

    What a URDF cannot say stands in a comment: armature, gains, delays.

    Args:
        theta: The values.
        source: A URDF with the model's links and joints.

    Raises:
        ConfigError: `source` cannot be read, or is about another robot.
    """
    model = compiled(identified_spec(system, theta))
    try:
        parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        root = ElementTree.fromstring(source.read_bytes(), parser)
    except (OSError, ElementTree.ParseError) as error:
        raise ConfigError(f"`urdf`: {source}: cannot be read: {error}") from None
    links = {link.get("name", ""): link for link in root.iter("link")}
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    rows = {(c.field.partition("_")[0], c.row) for c in system.edits.cells}
    for row in sorted(row for kind, row in rows if kind == "body" and model.body_mass[row] > 0.0):
        inertial = _emptied(links, "link", model.body(row).name, "inertial", source)
        axes = rotation_matrix(model.body_iquat[row])
        inertia = axes @ np.diag(model.body_inertia[row]) @ axes.T
        SubElement(inertial, "origin", xyz=_text(*model.body_ipos[row]), rpy="0 0 0")
        SubElement(inertial, "mass", value=_text(model.body_mass[row]))
        SubElement(inertial, "inertia", {name: _text(inertia[place]) for name, place in INERTIA.items()})
    for row in sorted({int(model.dof_jntid[row]) for kind, row in rows if kind == "dof"}):
        dof = model.jnt_dofadr[row]
        dynamics = _emptied(joints, "joint", model.joint(row).name, "dynamics", source)
        dynamics.set("damping", _text(model.dof_damping[dof]))
        dynamics.set("friction", _text(model.dof_frictionloss[dof]))
    text = "; ".join((f"identified by amhe, system {system.name}", *values_of(system, theta)))
    root.insert(0, ElementTree.Comment(f" {text.replace('--', '- -')} "))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _emptied(elements: Mapping[str, Element], kind: str, name: str, tag: str, source: Path) -> Element:
    """A new element of a link or joint, in place of its own of this tag."""
    if name not in elements:
        raise ConfigError(f"`urdf`: {source} has no {kind} {name!r}, as the model has")
    for old in elements[name].findall(tag):
        elements[name].remove(old)
    return SubElement(elements[name], tag)


def _text(*numbers: float) -> str:
    return " ".join(f"{number + 0.0:.9g}" for number in numbers)
