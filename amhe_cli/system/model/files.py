"""Model files, MJCF or URDF, with MuJoCo's errors and warnings in our words."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.system.model.cost import check_model
from amhe_cli.system.model.urdf import (
    INERTIA,
    UrdfOptions,
    is_urdf,
    possible_inertia,
    report_mended,
    urdf_text,
)

logger = logging.getLogger(__name__)

#: Least half edge of a box in place of a mesh [m].
_THIN = 1e-3
#: Share of a moment of inertia that the rounding of a file may hide.
_ROUNDING = 1e-3


def read_spec(path: Path, urdf: UrdfOptions | None = None) -> mujoco.MjSpec:
    """Read a model file; the fixed links of a URDF stay bodies that parameters can name.

    Args:
        path: MJCF or URDF.
        urdf: How to read a URDF; None: with its meshes, and packages in the folders above it.

    Raises:
        ConfigError: MuJoCo cannot read it, or a mesh of a URDF is missing.
    """
    reading = _in_our_words(f"MuJoCo cannot read {path.name!r}")
    if not is_urdf(path):
        check_model(path)
        with reading:
            spec = mujoco.MjSpec.from_file(str(path.absolute()))  # its meshes are found from any folder
        report_mended(path, _mended(spec))
        return spec
    text, bare = urdf_text(path, urdf or UrdfOptions())
    with reading:
        spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # meshes of ROS are seldom closed
    if bare:
        _add_boxes(spec, bare)
    _exclude_overlaps(spec, path.name)
    return spec


def _mended(spec: mujoco.MjSpec) -> list[str]:
    """Give bodies of an MJCF whose inertia MuJoCo refuses the nearest possible one; their names.

    A flat body that only the file's rounding makes impossible has no name here.
    """
    of_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    found, places = [], tuple(np.transpose([*INERTIA.values()]))
    for body in () if spec.compiler.balanceinertia else spec.bodies:
        given, whole = np.diag(body.inertia), not np.isnan(body.fullinertia[0])
        if whole:
            given[places] = given.T[places] = body.fullinertia
        if not (body.explicitinertial and np.isfinite(given).all()) or (of_shapes and body.geoms):
            continue
        least, middle, most = np.linalg.eigvalsh(given)
        if least < 0.0 or least + middle < most:
            inertia, _ = possible_inertia(given, float(body.mass))
            if whole:
                body.fullinertia = inertia[places]
            else:
                body.inertia = inertia.diagonal()
            if least < 0.0 or least + middle < (1.0 - _ROUNDING) * most:
                found.append(body.name or "a body")
    return found


def _add_boxes(spec: mujoco.MjSpec, links: Sequence[str]) -> None:
    """Give links without a shape boxes of their mass and inertia, which do not collide with each other."""
    model = compiled(spec.copy())
    for body in (body for body in spec.bodies if body.name in links):
        row = model.body(body.name)
        mass, inertia = float(row.mass[0]), np.asarray(row.inertia)
        if mass > 0.0:  # the moments of inertia of a solid cuboid are mass / 3 (|h|^2 - h_i^2)
            half = np.sqrt(np.maximum(1.5 / mass * (inertia.sum() - 2.0 * inertia), _THIN**2))
            box = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, contype=1, conaffinity=0)
            box.pos, box.quat = row.ipos, row.iquat


def _exclude_overlaps(spec: mujoco.MjSpec, name: str) -> None:
    """Let links of a URDF that are joined, or that overlap at its zero pose, not collide.

    Shapes in a URDF are rough, and ROS keeps such pairs in a file of its own (SRDF). MuJoCo itself leaves out
    joined links only where neither of them is fixed to the world.
    """
    model = compiled(spec, repr(name))
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    pairs = {tuple(sorted(map(int, model.geom_bodyid[contact.geom]))) for contact in data.contact}
    weld = model.body_weldid
    bodies = [int(row) for row in np.unique(model.geom_bodyid[model.geom_contype != 0])]
    fixed = [row for row in bodies if row and not weld[row]]
    joined = [row for row in bodies if weld[row] and not weld[model.body_parentid[weld[row]]]]
    for first, second in sorted(pairs | {(a, b) for a in fixed for b in joined}):
        spec.add_exclude(bodyname1=model.body(first).name, bodyname2=model.body(second).name)


def spec_of(model: mujoco.MjSpec | str | Path, urdf: UrdfOptions | None = None) -> mujoco.MjSpec:
    """A spec of a model that the caller may change: read from its MJCF or URDF file, or copied.

    Raises:
        ConfigError: There is no such file, or it cannot be read.
    """
    if isinstance(model, mujoco.MjSpec):
        return cast("mujoco.MjSpec", model).copy()
    if not (isinstance(model, str | Path) and Path(model).is_file()):
        raise ConfigError(f"`model`: there is no file {str(model)!r}; give an MJCF, a URDF or an MjSpec")
    return read_spec(Path(model), urdf)


def compiled(spec: mujoco.MjSpec, name: str = "the model") -> mujoco.MjModel:
    """Compile a spec; its elements then know their rows in the model.

    Args:
        spec: The spec to compile.
        name: Name of the model in error messages.

    Raises:
        ConfigError: MuJoCo cannot compile it.
    """
    with _in_our_words(f"MuJoCo cannot compile {name}"):
        return spec.compile()


@contextmanager
def _in_our_words(what: str) -> Iterator[None]:
    """Turn errors into ConfigErrors, and warnings into log lines."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            yield
        except (ValueError, RuntimeError, MemoryError, mujoco.FatalError) as error:
            raise ConfigError(f"{what}: {' '.join(str(error).split()) or 'out of memory'}") from None
    for text in dict.fromkeys(" ".join(str(warning.message).split()) for warning in caught):
        logger.warning("MuJoCo: %s", text)


def resize_boxes(spec: mujoco.MjSpec, boxes: Mapping[str, Sequence[float]]) -> None:
    """Give box geoms of a spec their edge lengths [m].

    Raises:
        ConfigError: The model has no box geom of that name.
    """
    names = [geom.name for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_BOX and geom.name]
    for name, edges in boxes.items():
        if name not in names:
            raise ConfigError(one_of("box geom", name, names))
        resize(spec.geom(name), edges)


def resize(geom: mujoco.MjsGeom, edges: Sequence[float]) -> None:
    """Give a box geom its edge lengths [m]; its body's other shapes keep their places on it.

    Where the body has an inertia of its own, it becomes that of a solid cuboid of the same mass.
    """
    half, body = 0.5 * np.asarray(edges, dtype=float), geom.parent
    ratio = half / geom.size
    for part in body.geoms:
        part.size, part.pos = part.size * ratio, part.pos * ratio
    if body.explicitinertial:
        squares = (2.0 * half) ** 2
        body.inertia = body.mass / 12.0 * (squares.sum() - squares)
