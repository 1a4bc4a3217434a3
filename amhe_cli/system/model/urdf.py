"""URDF as ROS writes it, as text that MuJoCo reads.

MuJoCo reads links, joints, limits, `<dynamics>` and `<mimic>` by itself, but it knows no packages: it looks
for a mesh by its base name only, beside the file. Here each mesh gets its absolute path.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.core.limits import limits
from amhe_cli.system.model.cost import check_elements, check_size

logger = logging.getLogger(__name__)

#: Attributes of <inertia>, and their places in the matrix.
INERTIA = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
#: Ending of the name of a xacro file: a program that writes a URDF, which amhe does not run.
_XACRO = ".xacro"
#: Formats of meshes that MuJoCo reads.
_FORMATS = (".stl", ".obj", ".msh")


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


@dataclass(frozen=True, slots=True)
class Places:
    """Where a URDF's files may lie.

    Args:
        folder: Folder of the URDF.
        meshdir: Folder that the URDF names for MuJoCo.
        packages: Folders of ROS packages by name.
    """

    folder: Path
    meshdir: Path
    packages: Mapping[str, str | Path]

    def mesh(self, uri: str, urdf: Path) -> Path:
        """Path of a mesh file that exists and that MuJoCo can read."""
        scheme, _, rest = uri.replace("\\", "/").rpartition("://")
        rest = unquote(rest) if scheme else rest
        candidates, cure = [self.folder / rest, self.meshdir / rest], "correct its path"
        if scheme in ("package", "model"):
            package, _, inner = rest.lstrip("/").partition("/")
            candidates = [home / inner for home in self.homes(package)]
            cure = f"give the folder of package {package!r} in `packages`"
        candidates.append(self.meshdir / Path(rest).name)  # the only place where MuJoCo would look
        file = next((place for place in candidates if place.is_file()), None)
        problem = f"mesh {uri!r} is not there"
        if file is not None:
            problem, cure = _unreadable(file), "convert it"
            if not problem:
                return file.resolve()
            problem = f"mesh {uri!r} is {problem}, which MuJoCo cannot read"
        raise ConfigError(f"{urdf}: {problem}; {cure}, or give `meshes=False` to do without meshes")

    def homes(self, package: str) -> list[Path]:
        """Folders that may be a package, the likeliest first."""
        if package in self.packages:
            return [Path(self.packages[package])]
        above = (self.folder, *self.folder.parents)
        around = (place for home in above for place in (home, home / package))
        return [place for place in around if _is_package(place, package)]


def _unreadable(mesh: Path) -> str:
    """What a mesh file is, if MuJoCo cannot read it; else nothing."""
    kind = mesh.suffix.lower()
    if kind not in _FORMATS:
        return f"a {kind or 'nameless'} file"
    if kind == ".stl":
        with mesh.open("rb") as file:
            head = file.read(1024)
        if head.lstrip().startswith(b"solid") and b"facet" in head:  # binary ones may begin with "solid" too
            return "an STL file of text"
    return ""


def _is_package(folder: Path, name: str) -> bool:
    manifest = folder / "package.xml"
    if not manifest.is_file():
        return folder.name == name and folder.is_dir()
    try:
        return ElementTree.parse(manifest).findtext("name", "").strip() == name or folder.name == name
    except ElementTree.ParseError:
        return folder.name == name


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
    inner = root
    for tag in ("mujoco", "compiler"):  # MuJoCo's own in a URDF
        found = inner.find(tag)
        inner = ElementTree.SubElement(inner, tag) if found is None else found
    compiler = inner.attrib
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
    report_mended(path, mended)
    return ElementTree.tostring(root, encoding="unicode"), bare


def _mended(link: ElementTree.Element) -> bool:
    """Replace an inertia that no body can have, which MuJoCo refuses; whether that matters.

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
    mended, moments = possible_inertia(inertia, mass)
    if moments[0] > 1e-9 * moments[2]:
        return False
    for name, place in INERTIA.items():
        element.set(name, repr(float(mended[place])))
    return mass > 1e-3 and bool(moments[0] < -1e-3 * np.abs(moments).max())


def possible_inertia(inertia: FloatArray, mass: float) -> tuple[FloatArray, FloatArray]:
    """The nearest inertia (3, 3) that a body of some mass [kg] can have, to one that none can [kg m^2].

    The second moments of a body's mass along its principal axes are not negative: those of tr(I) / 2 - I.
    They are raised to those of a small cube. Those of the given one are returned, too, (3,), the least first.
    """
    moments, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    raised = np.maximum(moments, max(1e-6 * mass, 1e-12)) if mass > 0.0 else np.zeros(3)
    return raised.sum() * np.eye(3) - (axes * raised) @ axes.T, moments


def report_mended(path: Path, names: Sequence[str]) -> None:
    """Warn of bodies whose inertia no body has."""
    if names:
        logger.warning(
            "%s: no body has the inertia of %s; the nearest possible one is used", path, ", ".join(names)
        )
