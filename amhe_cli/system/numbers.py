"""What a model file says: each of its numbers that decides a motion, by kind and element."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.description.schema import TargetEntry
from amhe_cli.system.description.targets import cells_of, unit_of
from amhe_cli.system.model.elements import names_of
from amhe_cli.system.parameters.edits import Cells

#: Word in `set:`, the element that has it, how people call it, and by which axes it is told apart.
_KINDS = (
    ("mass", "body", "mass", ""),
    ("center_of_mass", "body", "centre of mass", "xyz"),
    ("inertia", "body", "inertia", ""),
    ("damping", "joint", "damping", ""),
    ("friction_loss", "joint", "dry friction", ""),
    ("armature", "joint", "armature", ""),
    ("stiffness", "joint", "stiffness", ""),
    ("gain", "actuator", "gain", ""),
    ("actuator_damping", "actuator", "velocity gain", ""),
    ("force_limit", "actuator", "force limit", ""),
    ("force_limit", "joint", "force limit", ""),
)


@dataclass(frozen=True, slots=True)
class ModelNumber:
    """One number that a model file says, or several that belong together.

    Args:
        kind: Word in `set:`, or 'place' and 'range' of what no parameter sets.
        element, of: Kind and name of what has it: a body, joint or actuator.
        what: What people call it, such as 'centre of mass x'.
        unit: Its unit.
        cells: Where the model has it.
        target: What a parameter that sets it says.
    """

    kind: str
    element: str
    of: str
    what: str
    unit: str
    cells: tuple[Cells, ...]
    target: dict[str, Any]

    def values(self, model: mujoco.MjModel) -> FloatArray:
        """Its values, shape (n,); principal moments of inertia by size."""
        found = self.cells[0].of(model)
        return np.sort(found)[::-1] if self.kind == "inertia" else found

    def value(self, model: mujoco.MjModel) -> float:
        """Its value; of an inertia the largest moment."""
        return float(self.values(model)[0])

    def written(self, model: mujoco.MjModel, values: FloatArray) -> mujoco.MjModel:
        """A copy of a model with values (n,) in place of its own, and all that derives from them."""
        model = copy.copy(model)
        for cells in self.cells:
            put = values[np.argsort(np.argsort(-cells.of(model)))] if self.kind == "inertia" else values
            getattr(model, cells.field)[cells.index[1:]] = cells.factor * (put if cells.columns else put[0])
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model


def numbers_of(model: mujoco.MjModel, axes: bool = True) -> list[ModelNumber]:
    """What a model says of its masses, joints and drives; elements without a name are left out.

    Args:
        axes: The axes of a centre of mass are numbers of their own.
    """
    return [number for kind in _KINDS for number in _of_kind(model, *kind, axes)]


def shape_of(model: mujoco.MjModel) -> list[ModelNumber]:
    """Where bodies stand on those before them, and how far joints go."""
    bodies = [(name, model.body(name)) for name in names_of(model, "body")]
    moving = [(name, body.id) for name, body in bodies if model.body_weldid[body.id]]
    limited = [name for name in names_of(model, "joint") if model.joint(name).limited[0]]
    places = [
        ModelNumber("place", "body", name, "place", "m", (Cells("body_pos", row, (0, 1, 2)),), {})
        for name, row in moving
    ]
    return places + [
        ModelNumber(
            "range", "joint", name, "range", "rad", (Cells("jnt_range", model.joint(name).id, (0, 1)),), {}
        )
        for name in limited
    ]


def _of_kind(
    model: mujoco.MjModel, kind: str, element: str, what: str, by: str, axes: bool
) -> Iterator[ModelNumber]:
    for name in names_of(model, element):
        if element == "body" and not model.body(name).mass[0] > 0.0:
            continue  # a frame
        for axis in (by if axes else by[:1]) or ("",):
            target = {element: name, "set": kind} | ({"axis": axis} if axis else {})
            entry = TargetEntry.model_validate(target)
            try:
                cells = cells_of(model, entry)
            except ConfigError:
                continue  # the element has no such number, or it changes nothing
            if by and not axes and cells:
                cells = [Cells(cells[0].field, cells[0].row, (0, 1, 2))]
            if cells:
                called = f"{what} {axis}" if by and axes else what
                yield ModelNumber(kind, element, name, called, unit_of(entry, model), tuple(cells), target)
