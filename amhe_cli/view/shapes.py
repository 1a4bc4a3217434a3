"""Triangles of every kind of geom, and fewer triangles of a mesh that has too many for a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray

#: Half the edge of what stands for a plane without edges [m].
ENDLESS = 30.0
#: Faces around a round shape.
_ROUND = 20
#: Cells along a drawn height field.
_HILLY = 64

_TYPES = mujoco.mjtGeom


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Triangles.

    Args:
        vertices: Corners, shape (v, 3).
        faces: Rows of the corners of each triangle, counterclockwise from outside, shape (f, 3).
        flat: Each triangle is shaded as a plane; else the surface is round.
    """

    vertices: FloatArray
    faces: IntArray
    flat: bool = True


def shape_of(model: mujoco.MjModel, geom: int, most: int) -> Shape | None:
    """Triangles of a geom in its own frame [m], at most about so many; None for what is no surface."""
    kind, size = _TYPES(model.geom_type[geom]), np.array(model.geom_size[geom])
    if kind == _TYPES.mjGEOM_PLANE:
        half = np.where(size[:2] > 0.0, size[:2], ENDLESS)
        return _scaled(_SQUARE, np.array([*half, 1.0]))
    if kind == _TYPES.mjGEOM_SPHERE:
        return _scaled(_round(0.0), np.full(3, size[0]))
    if kind == _TYPES.mjGEOM_ELLIPSOID:
        return _scaled(_round(0.0), size)
    if kind == _TYPES.mjGEOM_CAPSULE:
        return _scaled(_round(size[1] / size[0]), np.full(3, size[0]))
    if kind == _TYPES.mjGEOM_CYLINDER:
        return _scaled(_cylinder(), np.array([size[0], size[0], size[1]]))
    if kind == _TYPES.mjGEOM_BOX:
        return _scaled(_CUBE, size)
    if kind == _TYPES.mjGEOM_HFIELD:
        return _hills(model, int(model.geom_dataid[geom]))
    if kind in (_TYPES.mjGEOM_MESH, _TYPES.mjGEOM_SDF) and model.geom_dataid[geom] >= 0:
        return _mesh(model, int(model.geom_dataid[geom]), most)
    return None


def boxed(half: Sequence[float]) -> Shape:
    """A box of so many metres to each side of its centre."""
    return _scaled(_CUBE, np.array(half))


def decimated(shape: Shape, most: int) -> Shape:
    """The shape with at most so many triangles: corners in the same cell of a grid become one."""
    cells = 256
    while len(shape.faces) > most and cells > 1:
        low, extent = shape.vertices.min(axis=0), np.ptp(shape.vertices, axis=0).max()
        grid = np.floor((shape.vertices - low) / max(extent, 1e-12) * cells).astype(np.int64)
        _, own = np.unique(grid, axis=0, return_inverse=True)
        own = own.ravel()
        count = np.bincount(own)
        merged = np.stack([np.bincount(own, column) / count for column in shape.vertices.T], axis=1)
        faces = own[shape.faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        shape, cells = Shape(merged, np.unique(_turned(faces), axis=0), shape.flat), int(0.8 * cells)
    return shape


def _turned(faces: IntArray) -> IntArray:
    """The same triangles, each beginning with its lowest corner."""
    first = faces.argmin(axis=1)
    return faces[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3]


def _mesh(model: mujoco.MjModel, mesh: int, most: int) -> Shape:
    corners, triangles = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    vertices = np.array(model.mesh_vert[corners : corners + int(model.mesh_vertnum[mesh])], dtype=float)
    faces = np.array(model.mesh_face[triangles : triangles + int(model.mesh_facenum[mesh])], dtype=np.int64)
    return decimated(Shape(vertices, faces), most)


def _hills(model: mujoco.MjModel, field: int) -> Shape:
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    start = int(model.hfield_adr[field])
    height = np.array(model.hfield_data[start : start + rows * columns]).reshape(rows, columns)
    height = height[:: -(-rows // _HILLY), :: -(-columns // _HILLY)]
    x, y, top, _ = model.hfield_size[field]
    across, along = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in height.shape[::-1]))
    vertices = np.stack((x * across, y * along, top * height), axis=-1).reshape(-1, 3)
    return Shape(vertices, _net(*height.shape), flat=False)


def _net(rows: int, columns: int) -> IntArray:
    """Triangles between neighbours of a grid of corners, shape (f, 3)."""
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    return np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])


def _round(straight: float) -> Shape:
    """A sphere of radius 1, its halves moved apart along z by `straight` each: a capsule."""
    around = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _ROUND // 2)
    if straight:
        rise = np.concatenate((rise[: _ROUND // 4], [0.0, 0.0], rise[_ROUND // 4 :]))
    z = np.sin(rise) + straight * np.concatenate((-np.ones(rise.size // 2), np.ones(rise.size // 2)))
    rim = np.stack((np.cos(around), np.sin(around)), axis=1)
    rings = np.cos(rise)[:, None, None] * rim
    vertices = np.concatenate((rings, np.broadcast_to(z[:, None, None], (*rings.shape[:2], 1))), axis=2)
    closed = np.concatenate((vertices, vertices[:, :1]), axis=1)
    faces = _net(*closed.shape[:2])
    row, column = np.divmod(faces, _ROUND + 1)
    return Shape(vertices.reshape(-1, 3), row * _ROUND + column % _ROUND, flat=False)


def _cylinder() -> Shape:
    """A cylinder of radius 1 from z = -1 to z = 1; its lids have corners of their own: edges are sharp."""
    around = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    rim = np.stack((np.cos(around), np.sin(around)), axis=1)
    low, high = (np.column_stack((rim, np.full(_ROUND, z))) for z in (-1.0, 1.0))
    this, following = np.arange(_ROUND), (np.arange(_ROUND) + 1) % _ROUND
    sides = [
        np.stack((this, following, following + _ROUND), axis=1),
        np.stack((this, following + _ROUND, this + _ROUND), axis=1),
    ]
    fan = np.arange(1, _ROUND - 1)
    lids = [
        np.stack((np.zeros_like(fan), fan + 1, fan), axis=1) + 2 * _ROUND,
        np.stack((np.zeros_like(fan), fan, fan + 1), axis=1) + 3 * _ROUND,
    ]
    return Shape(np.concatenate((low, high, low, high)), np.concatenate((*sides, *lids)), flat=False)


def _scaled(shape: Shape, size: FloatArray) -> Shape:
    return Shape(shape.vertices * size, shape.faces, shape.flat)


_SQUARE = Shape(
    np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]),
    np.array([[0, 1, 2], [0, 2, 3]]),
)
_CUBE = Shape(
    np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]),
    np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    ),
)  # fmt: skip
