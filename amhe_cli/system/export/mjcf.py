"""The identified model as an MJCF file that MuJoCo loads on its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.gear_friction import GEARS
from amhe_cli.system.parameters.servos import SERVOS
from amhe_cli.system.system import System

#: Folder beside an exported model for its meshes, textures and height fields.
ASSETS = "assets"
_INERTIAL = ("body_mass", "body_inertia", "body_ipos", "body_iquat")
#: What the zero of an encoder moves: it belongs to the log, not to the model.
_CALIBRATED = ("qpos0", "qpos_spring", "jnt_range")
#: Attributes of asset elements that name files, and the compiler attribute with their folder.
_FILES = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}


def identified_spec(system: System, theta: FloatArray) -> mujoco.MjSpec:
    """Spec of the system's model as it was given, with parameters theta (d,) in it.

    Sensors, sites and actuators that amhe added are not in it; nor are a command delay and the calibration of
    signals, which belong to the log.
    """
    spec = system.original.copy()
    compiled(spec)  # gives every element its row in the compiled model
    model = system.edits.apply(system.model, theta)
    model.actuator_biasprm[:, 0] = system.unedited.actuator_biasprm[:, 0]  # zeros of commands are of the log
    _write_inertials(spec, model, {c.row for c in system.edits.cells if c.field in _INERTIAL})
    for numerics, elements in ((GEARS, model.joint), (SERVOS, model.actuator)):
        for row, at in numerics.acting(model, system.edits.numerics).items():
            numerics.add(spec, [elements(row).name], model.numeric_data[at])
    for _, cells in system.edits.by_parameter():
        for row in (c.row for c in cells if c.field == "qpos_spring"):
            zero = model.qpos0[row] - system.unedited.qpos0[row]  # of an encoder
            joint = _with_id(spec.joints, int(np.flatnonzero(model.jnt_qposadr == row)[0]))
            degrees = spec.compiler.degree and joint.type == mujoco.mjtJoint.mjJNT_HINGE
            joint.springref = (model.qpos_spring[row] - zero) * (180.0 / np.pi if degrees else 1.0)
    own = (c for c in system.edits.cells if (c.field, c.columns) != ("actuator_biasprm", (0,)))
    for field, row in dict.fromkeys((c.field, c.row) for c in own):
        calibrated = field in _CALIBRATED or (field.startswith("actuator_") and row >= len(spec.actuators))
        if field not in (*_INERTIAL, "numeric_data") and not calibrated:
            _write(spec, model, field, row)
    return spec


def identified_xml(system: System, theta: FloatArray) -> str:
    """MJCF text of `identified_spec`.

    Numbers have the six digits that MuJoCo writes. A comment lists the parameters, and is the only place
    where a command delay and the calibration of signals stand. Files are referred to as `assets/...` only:
    copy those that `identified_assets` names beside the text.
    """
    spec = identified_spec(system, theta)
    spec.comment = "; ".join((f"identified by amhe, system {system.name}", *values_of(system, theta)))
    spec.comment = spec.comment.replace("--", "- -")
    return portable(spec, Path(spec.modelfiledir))[0]


def identified_assets(system: System) -> dict[str, Path]:
    """Files that the text of `identified_xml` refers to: path beside it -> the original."""
    spec = system.original.copy()
    compiled(spec)
    return portable(spec, Path(spec.modelfiledir))[1]


def values_of(system: System, theta: FloatArray) -> list[str]:
    """Each parameter with its value: 'load_mass = 0.55 kg', 'gain = 1 (fixed)'."""
    values = zip(system.space.parameters, theta, strict=True)
    lines = (f"{p.name} = {value:.6g}{'' if p.unit == '-' else f' {p.unit}'}" for p, value in values)
    return [*lines, *(f"{name} = {value:.6g} (fixed)" for name, value in system.fixed.items())]


def _write_inertials(spec: mujoco.MjSpec, model: mujoco.MjModel, rows: set[int]) -> None:
    """Give bodies their compiled inertia in place of the one from their geoms."""
    options = spec.compiler
    if (
        options.settotalmass > 0
        or int(options.inertiafromgeom) == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    ):
        rows = set(range(1, model.nbody)) if rows else rows  # else these would undo the values
        options.settotalmass = -1
        options.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    for body in spec.bodies:
        if body.id in rows and model.body_mass[body.id] > 0.0:
            body.explicitinertial = True
            body.mass = model.body_mass[body.id]
            body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
            body.inertia = _loadable(model.body_inertia[body.id])
            body.fullinertia = np.full(6, np.nan)
            body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _loadable(moments: FloatArray) -> FloatArray:
    """Moments of six digits that still satisfy the triangle inequality, which MuJoCo checks exactly."""
    rounded = np.array([float(f"{moment:.6g}") for moment in moments])
    largest = int(np.argmax(rounded))
    most = float(np.delete(rounded, largest).sum())  # the sum of all three would round otherwise
    value = rounded[largest]
    while rounded[largest] > most:
        value *= 1.0 - 1e-6
        rounded[largest] = float(f"{value:.6g}")
    return rounded


def _write(spec: mujoco.MjSpec, model: mujoco.MjModel, field: str, row: int) -> None:
    """Write one row of a compiled array into the element that it came from."""
    kind, attribute = field.split("_", 1)
    if field == "jnt_actfrcrange":
        _with_id(spec.joints, row).actfrcrange = model.jnt_actfrcrange[row]
        return
    if kind in ("dof", "jnt"):
        joint = _with_id(spec.joints, int(model.dof_jntid[row]) if kind == "dof" else row)
        value = getattr(model, field)[row]
        joint.springdamper = np.zeros(2)  # else it would override stiffness and damping
        if attribute in ("damping", "stiffness"):  # polynomials; the first coefficient is the linear one
            getattr(joint, attribute)[0] = value
        elif attribute == "dampingpoly":
            joint.damping[1:] = value
        else:
            setattr(joint, attribute, value)
        return
    lists = {"geom": spec.geoms, "pair": spec.pairs, "actuator": spec.actuators, "tendon": spec.tendons}
    owner = int(np.flatnonzero(model.actuator_ctrladr == row)[0]) if attribute == "ctrlrange" else row
    setattr(_with_id(lists[kind], owner), attribute, getattr(model, field)[row])


def _with_id(elements: Any, row: int) -> Any:
    return next(element for element in elements if element.id == row)


def portable(spec: mujoco.MjSpec, folder: Path) -> tuple[str, dict[str, Path]]:
    """Text of a spec whose files are `assets/...`, and where those files are now."""
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(spec.to_xml(), parser)
    compiler = root.find("compiler")
    folders = {} if compiler is None else {k: compiler.attrib.pop(k, "") for k in ("meshdir", "texturedir")}
    strip = compiler is not None and compiler.attrib.pop("strippath", "false") == "true"
    names: dict[Path, str] = {}
    elements = [element for element in root.iter() if element.tag in _FILES]
    for element, attribute in [
        (one, key) for one in elements for key in one.attrib if key.startswith("file")
    ]:
        written = element.attrib[attribute]
        inner = PurePosixPath(written).name if strip else written
        source = (folder / folders.get(_FILES[element.tag], "") / inner).resolve()
        names.setdefault(source, _free_name(PurePosixPath(inner).name, set(names.values())))
        element.attrib[attribute] = names[source]
    actuators = list(root.iter("general"))
    # MuJoCo 3 counts the controls of a PID or DC motor, which it does not know anyway, by their inputs
    if not any(actuator.get("gaintype") in ("pid", "dcmotor") for actuator in actuators):
        for actuator in actuators:
            actuator.attrib.pop("input", None)  # MuJoCo 3 refuses it, and no motion depends on it
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n", {name: path for path, name in names.items()}


def _free_name(base: str, taken: set[str]) -> str:
    name, number = f"{ASSETS}/{base}", 1
    while name in taken:
        number += 1
        name = f"{ASSETS}/{number}_{base}"
    return name


#: Key of a comment: the kind of element ('body', 'joint', 'actuator'), and its name.
Place = tuple[str, str]


def with_comments(text: str, comments: Mapping[Place, Sequence[str]]) -> str:
    """A model file, MJCF or URDF, with comments before elements; those of elements it lacks come first.

    Args:
        text: The file.
        comments: Lines for each element.
    """
    root = ElementTree.fromstring(
        text, ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    )
    parents = {child: parent for parent in root.iter() for child in parent}
    left = dict(comments)
    for element, parent in list(parents.items()):
        place = _place(element, parent)
        for line in left.pop(place, ()) if place else ():
            parent.insert(list(parent).index(element), _comment(line))
    for place in reversed(list(left)):
        for line in reversed(left[place]):
            root.insert(0, _comment(f"{place[1]}: {line}"))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _place(element: Element, parent: Element) -> Place | None:
    name = element.get("name")
    if name is None or not isinstance(element.tag, str):
        return None
    if parent.tag == "actuator":
        return "actuator", name
    kind = {"link": "body", "freejoint": "joint"}.get(element.tag, element.tag)
    return (kind, name) if kind in ("body", "joint") else None


def _comment(text: str) -> Any:
    return ElementTree.Comment(f" {text.replace('--', '- -')} ")
