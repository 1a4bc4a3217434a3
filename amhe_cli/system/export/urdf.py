"""The identified model as a URDF: a new one, or the values in the URDF that the model came from."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.export.mjcf import identified_assets, identified_spec, values_of
from amhe_cli.system.model.couplings import couplings
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.inertia import rotation_matrix
from amhe_cli.system.system import System

logger = logging.getLogger(__name__)

_FREE, _HINGE, _SLIDE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "HINGE", "SLIDE")
)
#: Limit of effort that a URDF demands where the model has none [N m or N].
_EFFORT = 1000.0
#: Limit of velocity that a URDF demands where the model has none [rad/s or m/s].
_VELOCITY = 100.0
#: Mass of a link between two joints of one body [kg]: simulators refuse none.
_NOTHING = 1e-6
_WORLD = "world"
_INERTIA = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def identified_urdf(system: System, theta: FloatArray, source: Path | None = None) -> str:
    """URDF text with the values of parameters theta (d,): masses, inertias, friction and damping.

    What a URDF cannot say stands in a comment: armature, gains, delays. Meshes are `assets/...`, those that
    `identified_assets` names.

    Args:
        system: The system.
        theta: The values.
        source: A URDF with the model's links and joints, whose text is kept but for the values; None: a URDF
            is made of the model.

    Raises:
        ConfigError: The model has what no URDF can say, or `source` is about another robot.
    """
    spec = identified_spec(system, theta)
    model = compiled(spec)
    root = _new(system, spec, model) if source is None else _edited(system, model, source)
    text = "; ".join((f"identified by amhe, system {system.name}", *values_of(system, theta)))
    root.insert(0, ElementTree.Comment(f" {text.replace('--', '- -')} "))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _edited(system: System, model: mujoco.MjModel, source: Path) -> Element:
    """The source with the values of the bodies and joints that parameters set."""
    try:
        root = ElementTree.fromstring(
            source.read_bytes(), ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        )
    except (OSError, ElementTree.ParseError) as error:
        raise ConfigError(f"`urdf`: {source}: cannot be read: {error}") from None
    links = {link.get("name", ""): link for link in root.iter("link")}
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    rows = {(c.field.partition("_")[0], c.row) for c in system.edits.cells}
    for row in sorted(row for kind, row in rows if kind == "body"):
        link = _named(links, "link", model.body(row).name, source)
        for old in link.findall("inertial"):
            link.remove(old)
        _inertial(link, model, row, np.zeros(3))
    for row in sorted({int(model.dof_jntid[row]) for kind, row in rows if kind == "dof"}):
        joint = _named(joints, "joint", model.joint(row).name, source)
        for old in joint.findall("dynamics"):
            joint.remove(old)
        _dynamics(joint, model, row)
    return root


def _named(elements: Mapping[str, Element], kind: str, name: str, source: Path) -> Element:
    if name not in elements:
        raise ConfigError(
            f"`urdf`: {source} has no {kind} {name!r}, as the model has; leave `urdf` out, and one is made"
        )
    return elements[name]


def _new(system: System, spec: mujoco.MjSpec, model: mujoco.MjModel) -> Element:
    root = Element("robot", name=system.name)
    offsets = {0: np.zeros(3)}
    top = [row for row in range(1, model.nbody) if model.body_parentid[row] == 0]
    floating = (
        len(top) == 1 and model.body_jntnum[top[0]] and model.jnt_type[model.body_jntadr[top[0]]] == _FREE
    )
    if not floating:
        SubElement(root, "link", name=_WORLD)
    for row in range(1, model.nbody):
        offsets[row] = _link(root, model, row, offsets, loose=bool(floating and row == top[0]))
    _shapes(root, system, spec, model, offsets)
    for coupling in couplings(model):
        follower = root.find(f"joint[@name='{_joint_name(model, coupling.follower)}']")
        offset, factor, *rest = (*coupling.polynomial.coef, 0.0, 0.0)
        if follower is not None and not any(rest):
            leader = _joint_name(model, coupling.leader)
            SubElement(follower, "mimic", joint=leader, multiplier=_text(factor), offset=_text(offset))
    if others := model.neq - len(couplings(model)) + model.ntendon:
        logger.warning("a URDF has no tendons and no such constraints: %d of the model are left out", others)
    return root


def _link(
    root: Element, model: mujoco.MjModel, row: int, offsets: Mapping[int, FloatArray], loose: bool
) -> FloatArray:
    """Add a body's link, with the joints that lead to it; where the link's frame lies in the body's, (3,).

    A URDF's joint turns about the origin of its link: there lies the link's frame. A body with several joints
    becomes a chain of links.
    """
    name, parent = _body_name(model, row), int(model.body_parentid[row])
    first, count = int(model.body_jntadr[row]), int(model.body_jntnum[row])
    place, turn, above = (
        model.body_pos[row] - offsets[parent],
        model.body_quat[row],
        _body_name(model, parent),
    )
    offset = np.zeros(3)
    joints = range(first, first + (0 if loose else count))
    for joint in joints:
        kind, axis = int(model.jnt_type[joint]), model.jnt_axis[joint]
        if kind not in (_HINGE, _SLIDE):
            raise ConfigError(f"joint {_joint_name(model, joint)!r}: a URDF has no free or ball joint here")
        place = place + rotations.rotate(turn, model.jnt_pos[joint] - offset)
        zero = -float(model.qpos0[model.jnt_qposadr[joint]])
        if kind == _HINGE:
            turn = rotations.multiply(turn, rotations.exp(zero * axis))
        else:
            place = place + rotations.rotate(turn, zero * axis)
        below = name if joint == joints[-1] else f"{name}_{_joint_name(model, joint)}"
        _joint(root, model, joint, (above, below), place, turn)
        place, turn, above, offset = np.zeros(3), np.array([1.0, 0, 0, 0]), below, model.jnt_pos[joint]
        if below != name:
            between = SubElement(SubElement(root, "link", name=below), "inertial")
            SubElement(between, "mass", value=_text(_NOTHING))
            moment = _text(1e-3 * _NOTHING)
            SubElement(between, "inertia", {k: moment if k[1] == k[2] else "0" for k in _INERTIA})
    if not joints and not loose:
        fixed = SubElement(root, "joint", name=f"{name}_fixed", type="fixed")
        _ends(fixed, (above, name), place, turn)
    _inertial(SubElement(root, "link", name=name), model, row, offset)
    return offset


def _joint(
    root: Element,
    model: mujoco.MjModel,
    row: int,
    links: tuple[str, str],
    place: FloatArray,
    turn: FloatArray,
) -> None:
    limited, hinge = bool(model.jnt_limited[row]), int(model.jnt_type[row]) == _HINGE
    kind = ("revolute" if limited else "continuous") if hinge else "prismatic"
    joint = SubElement(root, "joint", name=_joint_name(model, row), type=kind)
    _ends(joint, links, place, turn)
    SubElement(joint, "axis", xyz=_text(*model.jnt_axis[row]))
    lower, upper = model.jnt_range[row] if limited else (-1e3, 1e3)
    bounds = {"lower": _text(lower), "upper": _text(upper)} if limited or not hinge else {}
    SubElement(joint, "limit", {**bounds, "effort": _text(_effort(model, row)), "velocity": _text(_VELOCITY)})
    _dynamics(joint, model, row)


def _effort(model: mujoco.MjModel, row: int) -> float:
    """The largest force or torque that acts on a joint, as far as the model limits it."""
    on_joint = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == row)
    limits = [
        np.abs(model.actuator_forcerange[on_joint & (model.actuator_forcelimited != 0)]).max(initial=0.0)
    ]
    limits += [np.abs(model.jnt_actfrcrange[row]).max()] if model.jnt_actfrclimited[row] else []
    return min((limit for limit in limits if limit > 0.0), default=_EFFORT)


def _ends(joint: Element, links: tuple[str, str], place: FloatArray, turn: FloatArray) -> None:
    SubElement(joint, "parent", link=links[0])
    SubElement(joint, "child", link=links[1])
    _origin(joint, place, turn)


def _origin(element: Element, place: FloatArray, turn: FloatArray) -> None:
    SubElement(element, "origin", xyz=_text(*place), rpy=_text(*rotations.to_rpy(turn)))


def _dynamics(joint: Element, model: mujoco.MjModel, row: int) -> None:
    """Damping and dry friction; a URDF knows no armature."""
    dof = int(model.jnt_dofadr[row])
    damping, friction = model.dof_damping[dof], model.dof_frictionloss[dof]
    SubElement(joint, "dynamics", damping=_text(damping), friction=_text(friction))


def _inertial(link: Element, model: mujoco.MjModel, row: int, offset: FloatArray) -> None:
    """Mass and inertia of a body in a link whose frame lies at `offset` (3,) in the body's."""
    if model.body_mass[row] <= 0.0:
        return
    axes = rotation_matrix(model.body_iquat[row])
    inertia = axes @ np.diag(model.body_inertia[row]) @ axes.T
    inertial = SubElement(link, "inertial")
    _origin(inertial, model.body_ipos[row] - offset, np.array([1.0, 0, 0, 0]))
    SubElement(inertial, "mass", value=_text(model.body_mass[row]))
    SubElement(inertial, "inertia", {name: _text(inertia[place]) for name, place in _INERTIA.items()})


def _shapes(
    root: Element,
    system: System,
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    offsets: Mapping[int, FloatArray],
) -> None:
    """Give each link the shapes of its body's geoms; those that collide also as collision shapes."""
    links = {link.get("name"): link for link in root.findall("link")}
    files = {source.resolve(): name for name, source in identified_assets(system).items()}
    folder = Path(spec.modelfiledir) / spec.meshdir
    meshes = {mesh.id: files.get((folder / mesh.file).resolve(), "") for mesh in spec.meshes}
    missing = 0
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if body == 0:
            continue
        shapes = list(_geometry(model, geom, meshes))
        missing += not shapes
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        for kind in ("visual", "collision") if collides else ("visual",):
            for place, turn, tag, attributes in shapes:
                shape = SubElement(links[_body_name(model, body)], kind)
                _origin(shape, place - offsets[body], turn)
                SubElement(SubElement(shape, "geometry"), tag, attributes)
    if missing:
        logger.warning("a URDF has no such shapes: %d geoms of the model are left out", missing)


def _geometry(
    model: mujoco.MjModel, geom: int, meshes: Mapping[int, str]
) -> Iterator[tuple[FloatArray, FloatArray, str, dict[str, str]]]:
    """Place (3,) and turn (4,) in the body, element and attributes of a geom; a capsule is three shapes."""
    place, turn, size = model.geom_pos[geom], model.geom_quat[geom], model.geom_size[geom]
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        yield place, turn, "box", {"size": _text(*(2.0 * size))}
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        yield place, turn, "sphere", {"radius": _text(size[0])}
    elif kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
        yield place, turn, "cylinder", {"radius": _text(size[0]), "length": _text(2.0 * size[1])}
        for end in (-size[1], size[1]) if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else ():
            tip = place + rotations.rotate(turn, np.array([0.0, 0.0, end]))
            yield tip, turn, "sphere", {"radius": _text(size[0])}
    elif kind == mujoco.mjtGeom.mjGEOM_MESH and meshes.get(int(model.geom_dataid[geom])):
        mesh = int(model.geom_dataid[geom])  # MuJoCo moves a mesh into the axes of its inertia
        turn = rotations.multiply(turn, rotations.conjugate(model.mesh_quat[mesh]))
        place = place - rotations.rotate(turn, model.mesh_pos[mesh])
        yield place, turn, "mesh", {"filename": meshes[mesh], "scale": _text(*model.mesh_scale[mesh])}


def _body_name(model: mujoco.MjModel, row: int) -> str:
    return model.body(row).name or f"body_{row}"


def _joint_name(model: mujoco.MjModel, row: int) -> str:
    return model.joint(row).name or f"joint_{row}"


def _text(*numbers: float) -> str:
    return " ".join(f"{number + 0.0:.9g}" for number in numbers)
