"""What a belief about a system is about: short hashes of its model's parts, and what each parameter sets.

The hashes cover the numbers that decide the motion, at the six digits that MuJoCo writes, and no names,
paths, visual geoms or sensors: the same model in another folder has the same ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator

import mujoco
import numpy as np

from amhe_cli.system.parameters.edits import Cells, PseudoInertiaEdit, ScalarEdit
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.parameters.servos import SERVOS

#: Part of a model -> the fields of MjModel that describe it, by prefix.
_FIELDS = {
    "bodies": "body_ parentid pos quat ipos iquat mass inertia gravcomp mocapid",
    "joints": (
        "jnt_ type bodyid pos axis range limited stiffness stiffnesspoly margin solref solimp "
        "actfrclimited actfrcrange actgravcomp, "
        "dof_ damping dampingpoly armature frictionloss solref solimp, qpos 0 _spring"
    ),
    "geoms": (
        "geom_ type bodyid contype conaffinity condim priority pos quat size aabb friction solmix solref "
        "solimp margin gap"
    ),
    "contact pairs": (
        "pair_ dim geom1 geom2 friction solref solreffriction solimp margin gap, exclude_ signature"
    ),
    "actuators": (
        "actuator_ trntype trnid gear dyntype dynprm gaintype gainprm biastype biasprm ctrllimited "
        "ctrlrange forcelimited forcerange actlimited actrange armature damping dampingpoly delay"
    ),
    "tendons": (
        "tendon_ stiffness damping frictionloss armature limited range lengthspring, wrap_ type objid prm"
    ),
    "equalities": "eq_ type obj1id obj2id active0 data solref solimp",
}
#: Fields of `opt` that decide the motion.
_OPTIONS = (
    "timestep gravity wind density viscosity integrator cone impratio solver disableflags enableflags "
    "o_margin o_solref o_solimp o_friction"
)
#: Row of a field with this prefix -> kind of element whose name it has.
_KINDS = {
    "body": "body",
    "geom": "geom",
    "pair": "pair",
    "jnt": "joint",
    "dof": "joint",
    "qpos": "joint",
    "actuator": "actuator",
    "tendon": "tendon",
}


def parts_of(model: mujoco.MjModel, edits: ModelEdits) -> dict[str, str]:
    """Hash of each part of a model, as it is without its parameters' values.

    Args:
        model: The model, with parameters in it.
        edits: What wrote them; they know the model's own numbers.
    """
    unedited = edits.own(model)
    parts = {part: _hash(_values(unedited, fields)) for part, fields in _FIELDS.items()}
    if (gear := GearFriction.of(unedited)) is not None:
        parts["gear friction"] = _hash((gear.dofs, unedited.numeric_data[gear.at]))
    if servos := SERVOS.acting(unedited, ()):
        parts["servos"] = _hash((np.array(list(servos)), unedited.numeric_data[list(servos.values())]))
    return {"options": _hash(np.asarray(getattr(model.opt, name)) for name in _OPTIONS.split())} | parts


def _values(model: mujoco.MjModel, fields: str) -> Iterator[np.ndarray]:
    for group in fields.split(", "):
        prefix, *names = group.split()
        for name in names:
            array = np.asarray(getattr(model, prefix + name))
            if prefix == "geom_":
                array = array[_colliding(model)]
            elif name in ("geom1", "geom2"):
                array = np.cumsum(_colliding(model))[array]  # visual geoms do not count
            yield array


def _colliding(model: mujoco.MjModel) -> np.ndarray:
    """Which geoms can touch something, shape (ngeom,)."""
    colliding = (model.geom_contype | model.geom_conaffinity) != 0
    colliding[[*model.pair_geom1, *model.pair_geom2]] = True
    return colliding


def _hash(arrays: Iterable[np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.shape}:".encode())
        # + 0.0 turns -0.0 into 0.0
        digest.update(",".join(f"{value + 0.0:.6g}" for value in array.ravel().tolist()).encode())
    return digest.hexdigest()[:12]


def sets_of(model: mujoco.MjModel, edits: ModelEdits) -> dict[str, str]:
    """What each parameter sets in a model, in words: 'body_mass of load', 'scale dof_damping of hip'."""
    words: dict[str, str] = {}
    for name, edit in edits.by_name():
        if isinstance(edit, PseudoInertiaEdit):
            text = f"pseudo_inertia of {_name(model, edit.cells[0])}"
        else:
            assert isinstance(edit, ScalarEdit)
            text = _scalar(model, edit)
        words[name] = f"{words[name]}; {text}" if name in words else text
    return words


def _scalar(model: mujoco.MjModel, edit: ScalarEdit) -> str:
    fields: dict[str, list[str]] = {}
    for cells in edit.written:
        columns = f"[{', '.join(map(str, cells.columns))}]" if cells.columns else ""
        fields.setdefault(cells.field + columns, []).append(_name(model, cells))
    mode = "" if edit.mode == "value" else f"{edit.mode} "
    carried = " with its inertia" if edit.carried else ""
    return "; ".join(
        f"{mode}{field}{' of ' if any(names) else ''}{', '.join(dict.fromkeys(names))}{carried}"
        for field, names in fields.items()
    )


def _name(model: mujoco.MjModel, cells: Cells) -> str:
    """Name of the element that a row belongs to; of its body, or its number, where it has none."""
    if cells.beside or cells.name:
        return cells.name
    prefix = cells.field.partition("_")[0]
    row = int(model.dof_jntid[cells.row]) if prefix == "dof" else cells.row
    row = int(np.flatnonzero(model.jnt_qposadr == row)[0]) if prefix == "qpos" else row
    name = getattr(model, _KINDS[prefix])(row).name
    if not name and prefix == "geom":
        name = model.body(model.geom_bodyid[row]).name
    return name or str(row)
