"""Which numbers of a MuJoCo model a target may set: one table, `SETTERS`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import inf

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.system.description import drive_targets as drives
from amhe_cli.system.description.drive_targets import CellsOf
from amhe_cli.system.description.schema import TargetEntry
from amhe_cli.system.parameters.cells import Cells
from amhe_cli.system.parameters.inertia import principal_axis

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "pair": mujoco.mjtObj.mjOBJ_PAIR,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
    "keyframe": mujoco.mjtObj.mjOBJ_KEY,
}
_COUNTS = {
    "body": "nbody",
    "geom": "ngeom",
    "pair": "npair",
    "joint": "njnt",
    "actuator": "nactuator",
    "site": "nsite",
    "sensor": "nsensor",
    "keyframe": "nkey",
}
#: Axis of a target -> columns.
_AXES = {"x": (0,), "y": (1,), "z": (2,), "all": (0, 1, 2)}
#: Axes of a frame, in the order of its numbers.
FRAME_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True)
class Setter:
    """What one word `set:` means.

    Args:
        unit: SI unit of the value.
        cells: Selector ('body', 'pair', ...) -> the numbers of the element that it selects; none of what
            calibrates a signal, whose numbers `CalibrationDraft` has.
        lower: Smallest value that is physically possible.
        positive: The value must be greater than `lower`.
        axes: Whether the target takes an axis, and which is the default; None: it takes none.
    """

    unit: str
    cells: Mapping[str, CellsOf]
    lower: float = 0.0
    positive: bool = False
    axes: str | None = None


def names_of(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind, without the unnamed ones."""
    count = getattr(model, _COUNTS[kind])
    names = (mujoco.mj_id2name(model, _OBJECTS[kind], i) for i in range(count))
    return [name for name in names if name and not name.startswith("amhe/")]


def id_of(model: mujoco.MjModel, kind: str, name: str) -> int:
    """Row of a named element.

    Raises:
        ConfigError: There is none; the text lists those there are.
    """
    row = mujoco.mj_name2id(model, _OBJECTS[kind], name)
    if row < 0:
        raise ConfigError(one_of(kind, name, names_of(model, kind)))
    return row


def _matching(model: mujoco.MjModel, kind: str, pattern: str) -> list[int]:
    """Rows of the elements that a name or a glob such as 'foot_*' means."""
    names = names_of(model, kind)
    if pattern in names or not any(sign in pattern for sign in "*?["):
        return [id_of(model, kind, pattern)]
    rows = [id_of(model, kind, name) for name in names if fnmatchcase(name, pattern)]
    if not rows:
        raise ConfigError(one_of(f"{kind} that matches", pattern, names))
    return rows


def _pair_rows(model: mujoco.MjModel, pair: str | list[str]) -> list[int]:
    """Rows of contact pairs, by the pair's name or by the names of its two geoms."""
    if isinstance(pair, str):
        return _matching(model, "pair", pair)
    wanted = {id_of(model, "geom", name) for name in pair}
    for row in range(model.npair):
        if {int(model.pair_geom1[row]), int(model.pair_geom2[row])} == wanted:
            return [row]
    raise ConfigError(f"no contact pair between {pair[0]!r} and {pair[1]!r}; add a <pair> to the model")


def selector_of(entry: TargetEntry) -> str | None:
    """Which selector the target gives; None for a `command_delay` of all commands.

    Raises:
        ConfigError: The word or the selector is unknown, or there are several selectors.
    """
    if entry.set not in WORDS:
        raise ConfigError(one_of("target", entry.set, WORDS))
    kinds = ("body", "geom", "pair", "joint", "actuator")
    given = [kind for kind in kinds if getattr(entry, kind) is not None]
    given = ["signal"] if entry.signal is not None else given  # whose joint says which of its numbers
    allowed = list(SETTERS[entry.set].cells) or ["signal"] if entry.set in SETTERS else SPECIAL[entry.set]
    if entry.set == "command_delay" and not given:
        return None
    if len(given) != 1 or given[0] not in allowed:
        valid = " or ".join(f"{kind}: NAME" for kind in allowed)
        raise ConfigError(f"target {entry.set!r} needs {valid}, not {', '.join(given) or 'nothing'}")
    return given[0]


def rows_of(model: mujoco.MjModel, entry: TargetEntry, selector: str) -> list[int]:
    """Rows of the elements that the target selects."""
    name = getattr(entry, selector)
    return _pair_rows(model, name) if selector == "pair" else _matching(model, selector, name)


def cells_of(model: mujoco.MjModel, entry: TargetEntry) -> list[Cells]:
    """All numbers of the model that the target sets.

    Raises:
        ConfigError: A name is unknown, or the target would change nothing.
    """
    selector = selector_of(entry)
    setter = SETTERS[entry.set]
    assert selector is not None
    if entry.axis and setter.axes is None:
        raise ConfigError(f"target {entry.set!r} takes no axis")
    if setter.axes == "required" and entry.axis not in ("x", "y", "z"):
        raise ConfigError(f"target {entry.set!r} needs axis: x, y or z")
    cells = [c for row in rows_of(model, entry, selector) for c in setter.cells[selector](model, row, entry)]
    if entry.mode == "scale" and not any(np.any(c.of(model)) for c in cells):
        raise ConfigError(f"target {entry.set!r} scales zero, which stays zero; give mode: value")
    return cells


def _movable(model: mujoco.MjModel, row: int, what: str) -> None:
    if model.body_weldid[row] == 0:
        name = model.body(row).name
        raise ConfigError(f"body {name!r} is fixed to the world: its {what} changes nothing")


def _mass(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    _movable(model, row, "mass")
    if entry.carry_inertia and entry.mode != "add" and model.body_mass[row] <= 0.0:
        raise ConfigError(f"body {model.body(row).name!r} has no mass of its own: give carry_inertia: false")
    return [Cells("body_mass", row)]


def _inertia(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    _movable(model, row, "inertia")
    columns = [principal_axis(model.body_iquat[row], axis) for axis in _AXES[entry.axis or "all"]]
    return [Cells("body_inertia", row, tuple(sorted(columns)))]


def _center_of_mass(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    _movable(model, row, "centre of mass")
    return [Cells("body_ipos", row, _AXES[entry.axis or "x"])]


def _contact(geom_field: str, pair_field: str, geom: int, pair: tuple[int, ...]) -> Mapping:
    """Setters of a contact's number: of a pair, a geom, or all colliding geoms of a body."""

    def of_geom(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        return [Cells(geom_field, row, (geom,))]

    def of_body(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        first, count = int(model.body_geomadr[row]), int(model.body_geomnum[row])
        colliding = [
            g for g in range(first, first + count) if model.geom_contype[g] or model.geom_conaffinity[g]
        ]
        if not colliding:
            raise ConfigError(f"body {model.body(row).name!r} has no geom that collides")
        return [Cells(geom_field, g, (geom,)) for g in colliding]

    def of_pair(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        return [Cells(pair_field, row, pair)]

    return {"pair": of_pair, "geom": of_geom, "body": of_body}


def _joint(field: str, columns: tuple[int, ...] = ()) -> Mapping:
    """Setters of a number of every degree of freedom of a joint."""

    def cells(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        if field.startswith("jnt_"):
            return [Cells(field, row)]
        return [Cells(field, int(dof), columns) for dof in np.flatnonzero(model.dof_jntid == row)]

    return {"joint": cells}


def _motor(array: str, column: int, attribute: str) -> Mapping[str, CellsOf]:
    """Setters of a number of a DC motor."""
    return {"actuator": drives.motor(f"actuator_{array}", column, attribute)}


#: Words of `set:` that set plain numbers.
SETTERS: Mapping[str, Setter] = {
    "mass": Setter("kg", {"body": _mass}, positive=True),
    "inertia": Setter("kg m^2", {"body": _inertia}, positive=True, axes="optional"),
    "center_of_mass": Setter("m", {"body": _center_of_mass}, lower=-inf, axes="required"),
    "sliding_friction": Setter("-", _contact("geom_friction", "pair_friction", 0, (0, 1))),
    "torsional_friction": Setter("m", _contact("geom_friction", "pair_friction", 1, (2,))),
    "rolling_friction": Setter("m", _contact("geom_friction", "pair_friction", 2, (3, 4))),
    "contact_time_constant": Setter("s", _contact("geom_solref", "pair_solref", 0, (0,)), positive=True),
    "contact_damping_ratio": Setter("-", _contact("geom_solref", "pair_solref", 1, (1,)), positive=True),
    "damping": Setter("N m s/rad", _joint("dof_damping")),
    "damping_quadratic": Setter("N m s^2/rad^2", _joint("dof_dampingpoly", (0,))),
    "damping_cubic": Setter("N m s^3/rad^3", _joint("dof_dampingpoly", (1,))),
    "armature": Setter("kg m^2", _joint("dof_armature")),
    "friction_loss": Setter("N m", _joint("dof_frictionloss")),
    "stiffness": Setter("N m/rad", _joint("jnt_stiffness")),
    "backlash": Setter("rad", {"joint": drives.backlash}, positive=True),
    "gain": Setter("-", {"actuator": drives.gain}, positive=True),
    "actuator_damping": Setter("-", {"actuator": drives.actuator_damping}),
    "integral_gain": Setter("-", {"actuator": drives.controller("integral_gain")}, positive=True),
    "integral_limit": Setter("rad s", {"actuator": drives.controller("integral_limit")}, positive=True),
    "slew_limit": Setter("rad/s", {"actuator": drives.controller("slew_limit")}, positive=True),
    "motor_constant": Setter("N m/A", _motor("gainprm", 1, "motorconst"), positive=True),
    "resistance": Setter("ohm", _motor("gainprm", 0, "resistance"), positive=True),
    "bristle_stiffness": Setter("N m/rad", _motor("dynprm", 5, "lugre"), positive=True),
    "bristle_damping": Setter("N m s/rad", _motor("dynprm", 6, "lugre"), positive=True),
    "coulomb_friction": Setter("N m", _motor("biasprm", 3, "lugre"), positive=True),
    "static_friction": Setter("N m", _motor("biasprm", 4, "lugre"), positive=True),
    "stribeck_velocity": Setter("rad/s", _motor("biasprm", 5, "lugre"), positive=True),
    "scale": Setter("-", {}, positive=True),
    "bias": Setter("-", {}, lower=-inf),
    "frame": Setter("-", {}, lower=-inf),
    "band": Setter("Hz", {}, positive=True),
    "force_limit": Setter(
        "N m", {"actuator": drives.force_limit, "joint": drives.joint_force_limit}, positive=True
    ),
    "ctrl_limit": Setter("-", {"actuator": drives.ctrl_limit}, positive=True),
}
#: Words that need more than plain numbers, with their selectors.
SPECIAL: Mapping[str, list[str]] = {"pseudo_inertia": ["body"], "command_delay": ["actuator"]}
#: All words that `set:` may be.
WORDS = (*SETTERS, *SPECIAL)
