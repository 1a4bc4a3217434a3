"""Which numbers of a MuJoCo model a target may set: one table, `SETTERS`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.system.description.schema import TargetEntry
from amhe_cli.system.model.elements import id_of, matching_rows
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.edits import Cells, range_cells
from amhe_cli.system.parameters.gear_friction import number_cells
from amhe_cli.system.parameters.inertia import principal_axis
from amhe_cli.system.parameters.servos import servo_cells

#: From a model, the row of an element and a target to the numbers that the target sets; raises ConfigError
#: where they would have no effect.
CellsOf = Callable[[mujoco.MjModel, int, TargetEntry], list[Cells]]

#: MuJoCo's numbers of the gains of a <dcmotor> and a <pid>, and what these are called.
_DC_MOTOR, _PID = int(mujoco.mjtGain.mjGAIN_DCMOTOR), int(mujoco.mjtGain.mjGAIN_PID)
_NAMES = {_PID: "<pid>", _DC_MOTOR: "<dcmotor>"}
#: MuJoCo's number of the bias that servos have.
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
#: Word -> where actuators with numbers of their own have it: field and column. One that is zero switches a
#: part of MuJoCo's model off.
_OF_ACTUATORS = {
    "gain": {_PID: ("actuator_biasprm", 1), _DC_MOTOR: ("actuator_gainprm", 4)},
    "actuator_damping": {_PID: ("actuator_biasprm", 2), _DC_MOTOR: ("actuator_gainprm", 6)},
    "integral_gain": {_PID: ("actuator_gainprm", 0), _DC_MOTOR: ("actuator_gainprm", 5)},
    "integral_limit": {_PID: ("actuator_dynprm", 0), _DC_MOTOR: ("actuator_dynprm", 8)},
    "slew_limit": {_PID: ("actuator_dynprm", 1), _DC_MOTOR: ("actuator_dynprm", 7)},
    "motor_constant": {_DC_MOTOR: ("actuator_gainprm", 1)},
    "resistance": {_DC_MOTOR: ("actuator_gainprm", 0)},
    "bristle_stiffness": {_DC_MOTOR: ("actuator_dynprm", 5)},
    "bristle_damping": {_DC_MOTOR: ("actuator_dynprm", 6)},
    "coulomb_friction": {_DC_MOTOR: ("actuator_biasprm", 3)},
    "static_friction": {_DC_MOTOR: ("actuator_biasprm", 4)},
    "stribeck_velocity": {_DC_MOTOR: ("actuator_biasprm", 5)},
}
#: Word -> field and columns of every degree of freedom of a joint.
_OF_DOFS = {
    "damping": ("dof_damping", ()),
    "damping_quadratic": ("dof_dampingpoly", (0,)),
    "damping_cubic": ("dof_dampingpoly", (1,)),
    "armature": ("dof_armature", ()),
    "friction_loss": ("dof_frictionloss", ()),
}
#: Word -> field of a contact, its column of a geom, and its columns of a pair.
_OF_CONTACTS = {
    "sliding_friction": ("friction", 0, (0, 1)),
    "torsional_friction": ("friction", 1, (2,)),
    "rolling_friction": ("friction", 2, (3, 4)),
    "contact_time_constant": ("solref", 0, (0,)),
    "contact_damping_ratio": ("solref", 1, (1,)),
}
#: MuJoCo's numbers of actuators that filter their command.
_FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))
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
    """Rows of the elements that the target selects; of contact pairs also by the names of their geoms."""
    name = getattr(entry, selector)
    if isinstance(name, str):
        return matching_rows(model, selector, name)
    wanted = {id_of(model, "geom", geom) for geom in name}
    for row in range(model.npair):
        if {int(model.pair_geom1[row]), int(model.pair_geom2[row])} == wanted:
            return [row]
    raise ConfigError(f"no contact pair between {name[0]!r} and {name[1]!r}; add a <pair> to the model")


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
    if entry.carry_limit and selector == "actuator":
        for row in {c.row for c in cells if c.field.startswith("actuator_")}:
            _force_limit(model, row, entry)  # refused where there is none
    if entry.mode == "scale" and not any(np.any(c.of(model)) for c in cells):
        raise ConfigError(f"target {entry.set!r} scales zero, which stays zero; give mode: value")
    return cells


def _of_body(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Mass, centre of mass or moments of inertia."""
    name, word = model.body(row).name, entry.set
    if model.body_weldid[row] == 0:
        raise ConfigError(
            f"body {name!r} is fixed to the world: its {word.replace('_', ' ')} changes nothing"
        )
    if word == "mass":
        if entry.carry_inertia and entry.mode != "add" and model.body_mass[row] <= 0.0:
            raise ConfigError(f"body {name!r} has no mass of its own: give carry_inertia: false")
        return [Cells("body_mass", row)]
    if word == "center_of_mass":
        return [Cells("body_ipos", row, _AXES[entry.axis or "x"])]
    columns = [principal_axis(model.body_iquat[row], axis) for axis in _AXES[entry.axis or "all"]]
    return [Cells("body_inertia", row, tuple(sorted(columns)))]


def _of_geom(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    field, column, _ = _OF_CONTACTS[entry.set]
    return [Cells(f"geom_{field}", row, (column,))]


def _of_geoms(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """A number of all colliding geoms of a body."""
    first, count = int(model.body_geomadr[row]), int(model.body_geomnum[row])
    geoms = range(first, first + count)
    colliding = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    if not colliding:
        raise ConfigError(f"body {model.body(row).name!r} has no geom that collides")
    return [cells for geom in colliding for cells in _of_geom(model, geom, entry)]


def _of_pair(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    field, _, columns = _OF_CONTACTS[entry.set]
    return [Cells(f"pair_{field}", row, columns)]


def _of_joint(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """A number of every degree of freedom of a joint, or its spring's stiffness."""
    if entry.set == "stiffness":
        return [Cells("jnt_stiffness", row)]
    field, columns = _OF_DOFS[entry.set]
    return [Cells(field, int(dof), columns) for dof in np.flatnonzero(model.dof_jntid == row)]


def _spring_rest(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Coordinate at which a joint's spring rests."""
    if int(model.jnt_type[row]) not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise ConfigError(f"joint {model.joint(row).name!r} has no one coordinate: only hinges and slides do")
    return [Cells("qpos_spring", int(model.jnt_qposadr[row]))]


def _of_gap(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Between a joint and its drive: width of a gap, half of it on either side, or stiffness."""
    name = model.joint(row).name
    tendon = next((gap.tendon for gap in gaps(model) if row in (gap.drive, gap.link)), None)
    if entry.set == "drive_stiffness":
        if tendon is None or not model.tendon_stiffness[tendon]:
            raise ConfigError(f"joint {name!r} has no elastic drive; `amhe init --elastic {name}` writes one")
        return [Cells("tendon_stiffness", tendon)]
    if tendon is None:
        raise ConfigError(f"joint {name!r} has no gap in the model; `amhe init --backlash {name}` writes one")
    return [Cells("tendon_range", tendon, (1,), 0.5), Cells("tendon_range", tendon, (0,), -0.5)]


def _of_actuator(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """A number of a <pid> or <dcmotor>, which must have it."""
    name, places = model.actuator(row).name, _OF_ACTUATORS[entry.set]
    if int(model.actuator_gaintype[row]) not in places:
        raise ConfigError(f"actuator {name!r} is no {' and no '.join(_NAMES[kind] for kind in places)}")
    if not (cells := _own_number(model, row, entry.set)):
        raise ConfigError(f"actuator {name!r} has no {entry.set} in the model; give it one to start from")
    return cells


def _own_number(model: mujoco.MjModel, row: int, word: str) -> list[Cells]:
    """A number of a <pid> or <dcmotor>; none where it is zero."""
    field, column = _OF_ACTUATORS[word][int(model.actuator_gaintype[row])]
    factor = -1.0 if word in ("gain", "actuator_damping") and field == "actuator_biasprm" else 1.0
    return [Cells(field, row, (column,), factor)] if getattr(model, field)[row, column] else []


def _gain(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Gain of a motor or servo."""
    if cells := gain_cells(model, row):
        return cells
    name = model.actuator(row).name
    raise ConfigError(f"actuator {name!r} has no fixed gain: only motors and servos have one to set")


def gain_cells(model: mujoco.MjModel, row: int) -> list[Cells]:
    """Gain of an actuator; none where it is not fixed.

    A servo's bias holds the same gain, negated, and must follow it.
    """
    kind = int(model.actuator_gaintype[row])
    if kind in _NAMES:
        return _own_number(model, row, "gain")
    if kind != mujoco.mjtGain.mjGAIN_FIXED:
        return []
    gain, bias = model.actuator_gainprm[row, 0], model.actuator_biasprm[row]
    cells = [Cells("actuator_gainprm", row, (0,))]
    if int(model.actuator_biastype[row]) == _AFFINE and gain:
        tied = next((column for column in (1, 2) if np.isclose(bias[column], -gain)), None)
        cells += [Cells("actuator_biasprm", row, (tied,), -1.0)] if tied else []
    return cells


def _actuator_damping(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Velocity term of a servo."""
    if int(model.actuator_gaintype[row]) == _DC_MOTOR:
        return _of_actuator(model, row, entry)
    if int(model.actuator_biastype[row]) != _AFFINE:
        name = model.actuator(row).name
        raise ConfigError(
            f"actuator {name!r} is a motor, which has no velocity term; set the joint's damping"
        )
    return [Cells("actuator_biasprm", row, (2,), -1.0)]


def _force_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of an actuator's range of forces, or of a joint's range of actuator forces."""
    if entry.joint is not None:
        if not model.jnt_actfrclimited[row]:
            name = model.joint(row).name
            raise ConfigError(f"joint {name!r} has no actuatorfrcrange in the model; give it one")
        return range_cells(model, "jnt_actfrcrange", row)
    if not model.actuator_forcelimited[row]:
        name = model.actuator(row).name
        raise ConfigError(f"actuator {name!r} has no forcerange in the model; give it one")
    return range_cells(model, "actuator_forcerange", row)


def _filter(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Time constant of an actuator that filters its command."""
    if int(model.actuator_dyntype[row]) not in _FILTERS:
        name = model.actuator(row).name
        raise ConfigError(
            f"actuator {name!r} filters nothing in the model: give it timeconst, or dyntype='filterexact'"
        )
    return [Cells("actuator_dynprm", row, (0,))]


def _ctrl_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of an actuator's range of controls."""
    ctrl = int(model.actuator_ctrladr[row])
    if model.actuator_ctrlnum[row] != 1 or not model.actuator_ctrllimited[ctrl]:
        raise ConfigError(f"actuator {model.actuator(row).name!r} has no ctrlrange in the model; give it one")
    return range_cells(model, "actuator_ctrlrange", ctrl)


_BODY, _ACTUATOR = {"body": _of_body}, {"actuator": _of_actuator}
_JOINT, _GAP = {"joint": _of_joint}, {"joint": _of_gap}
_CONTACT = {"pair": _of_pair, "geom": _of_geom, "body": _of_geoms}
#: How far two surfaces overlap before they push: MuJoCo's margin, below zero.
_OVERLAP = {"pair": lambda model, row, entry: [Cells("pair_margin", row, factor=-1.0)]}
_GEAR = {"joint": lambda model, row, entry: number_cells(model, row, entry.set)}
_SERVO = {"actuator": lambda model, row, entry: servo_cells(model, row, entry.set)}
#: Words of `set:` that set plain numbers.
SETTERS: Mapping[str, Setter] = {
    "mass": Setter("kg", _BODY, positive=True),
    "inertia": Setter("kg m^2", _BODY, positive=True, axes="optional"),
    "center_of_mass": Setter("m", _BODY, lower=-inf, axes="required"),
    "sliding_friction": Setter("-", _CONTACT),
    "torsional_friction": Setter("m", _CONTACT),
    "rolling_friction": Setter("m", _CONTACT),
    "contact_time_constant": Setter("s", _CONTACT, positive=True),
    "contact_damping_ratio": Setter("-", _CONTACT, positive=True),
    "contact_overlap": Setter("m", _OVERLAP, lower=-inf),
    "damping": Setter("N m s/rad", _JOINT),
    "damping_quadratic": Setter("N m s^2/rad^2", _JOINT),
    "damping_cubic": Setter("N m s^3/rad^3", _JOINT),
    "armature": Setter("kg m^2", _JOINT),
    "friction_loss": Setter("N m", _JOINT),
    "load_friction": Setter("-", _GEAR, lower=-inf),
    "load_friction_motor": Setter("-", _GEAR, lower=-inf),
    "load_friction_external": Setter("-", _GEAR, lower=-inf),
    "load_friction_quadratic": Setter("1/(N m)", _GEAR, lower=-inf),
    "stribeck_friction": Setter("N m", _GEAR, lower=-inf),
    "stribeck_exponent": Setter("-", _GEAR, positive=True),
    "stribeck_load_friction": Setter("-", _GEAR, lower=-inf),
    "stribeck_load_friction_motor": Setter("-", _GEAR, lower=-inf),
    "stribeck_load_friction_external": Setter("-", _GEAR, lower=-inf),
    "stiffness": Setter("N m/rad", _JOINT),
    "spring_rest": Setter("rad", {"joint": _spring_rest}, lower=-inf),
    "backlash": Setter("rad", _GAP, positive=True),
    "drive_stiffness": Setter("N m/rad", _GAP, positive=True),
    "gain": Setter("-", {"actuator": _gain}),
    "actuator_damping": Setter("-", {"actuator": _actuator_damping}),
    "filter_time_constant": Setter("s", {"actuator": _filter}, positive=True),
    "punch": Setter("-", _SERVO, lower=-inf),
    "dead_band": Setter("rad", _SERVO, lower=-inf),
    "supply_sag": Setter("-", _SERVO, lower=-inf),
    "back_emf": Setter("N m s/rad", _SERVO, lower=-inf),
    "supply": Setter("V", _SERVO, positive=True),
    "integral_gain": Setter("-", _ACTUATOR, positive=True),
    "integral_limit": Setter("rad s", _ACTUATOR, positive=True),
    "slew_limit": Setter("rad/s", _ACTUATOR, positive=True),
    "motor_constant": Setter("N m/A", _ACTUATOR, positive=True),
    "resistance": Setter("ohm", _ACTUATOR, positive=True),
    "bristle_stiffness": Setter("N m/rad", _ACTUATOR, positive=True),
    "bristle_damping": Setter("N m s/rad", _ACTUATOR, positive=True),
    "coulomb_friction": Setter("N m", _ACTUATOR, positive=True),
    "static_friction": Setter("N m", _ACTUATOR, positive=True),
    "stribeck_velocity": Setter("rad/s", _ACTUATOR | _GEAR, positive=True),
    "scale": Setter("-", {}, positive=True),
    "bias": Setter("-", {}, lower=-inf),
    "frame": Setter("-", {}, lower=-inf),
    "band": Setter("Hz", {}, positive=True),
    "force_limit": Setter("N m", {"actuator": _force_limit, "joint": _force_limit}, positive=True),
    "ctrl_limit": Setter("-", {"actuator": _ctrl_limit}, positive=True),
}
#: Words that need more than plain numbers, with their selectors.
SPECIAL: Mapping[str, list[str]] = {"pseudo_inertia": ["body"], "command_delay": ["actuator"]}
#: All words that `set:` may be.
WORDS = (*SETTERS, *SPECIAL)
#: Words of numbers that no model file has: of signals, gears' friction, a servo's firmware and supply.
IN_NO_FILE = (
    "command_delay",
    *(
        word
        for word, setter in SETTERS.items()
        if not setter.cells or {*_GEAR.values(), *_SERVO.values()}.intersection(setter.cells.values())
    ),
)


def unit_of(target: TargetEntry, model: mujoco.MjModel) -> str:
    """Unit of what a target sets in a model; '-' of a factor."""
    if target.mode == "scale":
        return "-"
    if target.set == "command_delay":
        return "s"
    unit, joint = SETTERS[target.set].unit, None
    if target.joint is not None:
        joint = rows_of(model, target, "joint")[0]
    elif target.actuator is not None:
        row = rows_of(model, target, "actuator")[0]
        joint = int(model.actuator_trnid[row, 0]) if model.actuator_trntype[row] <= 1 else None
        # a servo's stiffness and damping: its targets are in the unit of its joint
        servo = joint is not None and model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE
        follows = servo and -model.actuator_biasprm[row, 1] == model.actuator_gainprm[row, 0] != 0.0
        unit = {"gain": "N m/rad", "actuator_damping": "N m s/rad"}.get(target.set, unit) if follows else unit
    if joint is None or int(model.jnt_type[joint]) != mujoco.mjtJoint.mjJNT_SLIDE:
        return unit
    return {"kg m^2": "kg", "1/(N m)": "1/N"}.get(unit) or unit.replace("N m", "N").replace("rad", "m")
