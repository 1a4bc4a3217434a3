"""Where the files of a URDF lie: beside it, or in ROS packages, which are found without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

from amhe_cli.core.errors import ConfigError

#: Formats of meshes that MuJoCo reads.
_FORMATS = (".stl", ".obj", ".msh")


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
