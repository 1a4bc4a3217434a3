"""Boxes whose edges are measured on the spot: `boxes: {NAME: [x, y, z]}` of a system file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of


def resize_boxes(spec: mujoco.MjSpec, boxes: Mapping[str, Sequence[float]]) -> None:
    """Give box geoms of a spec their edge lengths [m].

    Raises:
        ConfigError: The model has no box geom of that name.
    """
    known = [geom.name for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_BOX and geom.name]
    for name, edges in boxes.items():
        if name not in known:
            raise ConfigError(one_of("box geom", name, known))
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
