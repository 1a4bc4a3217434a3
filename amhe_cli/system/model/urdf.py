"""URDF as ROS writes it, as text that MuJoCo reads.

MuJoCo reads links, joints, limits, `<dynamics>` and `<mimic>` by itself, but it knows no packages: it looks
for a mesh by its base name only, beside the file. Here each mesh gets its absolute path.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.limits import limits
from amhe_cli.system.model.cost import check_elements, check_size
from amhe_cli.system.model.packages import Places

logger = logging.getLogger(__name__)

#: Attributes of <inertia>, and their places in the matrix.
INERTIA = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
#: Ending of the name of a xacro file: a program that writes a URDF, which amhe does not run.
_XACRO = ".xacro"


@dataclass(frozen=True, slots=True)
class UrdfOptions:
    """How to read a URDF.

    Args:
        packages: Folders of ROS packages by name. Others are looked for above the URDF: folders of that
            name, or whose package.xml has it.
        meshes: Whether links keep their meshes.
    """

    packages: Mapping[str, str | Path] = field(default_factory=dict)
    meshes: bool = True


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF, or the xacro file of one."""
    return path.suffix.lower() in (".urdf", _XACRO)


def urdf_text(path: Path, options: UrdfOptions) -> tuple[str, list[str]]:
    """Text of a URDF that MuJoCo reads, and the links whose shapes were all left out with the meshes.

    Raises:
        ConfigError: It is no XML, or xacro; a mass or inertia is no number, or a mesh is missing or of a
            kind that MuJoCo cannot read.
    """
    check_size(path, limits().model_mib, "model_mib")
    if path.suffix.lower() == _XACRO:
        raise ConfigError(
            f"{path}: a xacro file is a program that writes a URDF; write it, and give that: xacro FILE > "
            "robot.urdf (of ROS, or of pip install xacro)"
        )
    try:
        parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
        root = ElementTree.fromstring(path.read_bytes(), parser)
    except ElementTree.ParseError as error:
        raise ConfigError(f"{path}: not a URDF: {error}") from None
    check_elements(root, path)
    compiler = _compiler(root)
    folder = path.absolute().parent
    places = Places(folder, folder / compiler.pop("meshdir", ""), options.packages)
    compiler["strippath"] = "false"
    bare: list[str] = []
    for link in root.iter("link"):
        before = link.find("collision")
        # MuJoCo leaves visual shapes out, unless the file demands them
        shapes = link.findall("collision") + link.findall("visual") * (
            compiler.get("discardvisual") == "false"
        )
        for shape in shapes:
            mesh = shape.find("geometry/mesh")
            if mesh is not None and options.meshes:
                mesh.set("filename", str(places.mesh(mesh.get("filename", ""), path)))
            elif mesh is not None:
                link.remove(shape)
        if before is not None and link.find("collision") is None:
            bare.append(link.get("name", ""))
    try:
        mended = [link.get("name", "") for link in root.iter("link") if _mended(link)]
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if mended:
        logger.warning(
            "%s: no body has the inertia of link %s; the nearest possible one is used",
            path,
            ", ".join(mended),
        )
    return ElementTree.tostring(root, encoding="unicode"), bare


def _mended(link: ElementTree.Element) -> bool:
    """Replace an inertia that no body can have, which MuJoCo refuses; whether that matters.

    The second moments of a body's mass along its principal axes are not negative: those of tr(I) / 2 - I.
    They are raised to those of a small cube.

    Raises:
        ConfigError: Its mass or inertia is no finite number.
    """
    element, weight = link.find("inertial/inertia"), link.find("inertial/mass")
    if element is None or weight is None:
        return False
    inertia = np.zeros((3, 3))
    try:
        mass = float(weight.get("value", 0.0))
        for name, (row, column) in INERTIA.items():
            inertia[row, column] = inertia[column, row] = float(element.get(name, 0.0))
    except ValueError as error:
        raise ConfigError(f"link {link.get('name', '')!r}: its inertial: {error}") from None
    if not np.isfinite([mass, *inertia.ravel()]).all():
        raise ConfigError(f"link {link.get('name', '')!r}: its mass or inertia is not finite")
    moments, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    if moments[0] > 1e-9 * moments[2]:
        return False
    raised = np.maximum(moments, max(1e-6 * mass, 1e-12)) if mass > 0.0 else np.zeros(3)
    inertia = raised.sum() * np.eye(3) - (axes * raised) @ axes.T
    for name, place in INERTIA.items():
        element.set(name, repr(float(inertia[place])))
    return mass > 1e-3 and bool(moments[0] < -1e-3 * np.abs(moments).max())


def _compiler(root: ElementTree.Element) -> dict[str, str]:
    """Attributes of MuJoCo's compiler in a URDF: <mujoco><compiler/></mujoco>, added if missing."""
    for tag in ("mujoco", "compiler"):
        inner = root.find(tag)
        root = ElementTree.SubElement(root, tag) if inner is None else inner
    return root.attrib
