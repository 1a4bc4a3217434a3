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
from amhe_cli.system.parameters.cells import Cells, range_cells
from amhe_cli.system.parameters.gear_friction import number_cells
from amhe_cli.system.parameters.inertia import principal_axis
from amhe_cli.system.parameters.servos import servo_cells

#: From a model, the row of an element and a target to the numbers that the target sets; raises ConfigError
#: where they would have no effect.
CellsOf = Callable[[mujoco.MjModel, int, TargetEntry], list[Cells]]

#: MuJoCo's number of the gain of a <dcmotor>.
_DC_MOTOR = int(mujoco.mjtGain.mjGAIN_DCMOTOR)
#: MuJoCo's number of the gain of a <pid>.
_PID = int(mujoco.mjtGain.mjGAIN_PID)
#: MuJoCo's number of the bias that servos have.
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
#: Where a <pid>, and the controller of a <dcmotor>, have their numbers: field and column.
_CONTROLLERS = {
    "gain": {_PID: ("actuator_biasprm", 1), _DC_MOTOR: ("actuator_gainprm", 4)},
    "actuator_damping": {_PID: ("actuator_biasprm", 2), _DC_MOTOR: ("actuator_gainprm", 6)},
    "integral_gain": {_PID: ("actuator_gainprm", 0), _DC_MOTOR: ("actuator_gainprm", 5)},
    "integral_limit": {_PID: ("actuator_dynprm", 0), _DC_MOTOR: ("actuator_dynprm", 8)},
    "slew_limit": {_PID: ("actuator_dynprm", 1), _DC_MOTOR: ("actuator_dynprm", 7)},
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


def _pair_rows(model: mujoco.MjModel, pair: str | list[str]) -> list[int]:
    """Rows of contact pairs, by the pair's name or by the names of its two geoms."""
    if isinstance(pair, str):
        return matching_rows(model, "pair", pair)
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
    return _pair_rows(model, name) if selector == "pair" else matching_rows(model, selector, name)


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


def _spring_rest(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Coordinate at which a joint's spring rests."""
    if int(model.jnt_type[row]) not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
        raise ConfigError(f"joint {model.joint(row).name!r} has no one coordinate: only hinges and slides do")
    return [Cells("qpos_spring", int(model.jnt_qposadr[row]))]


def _gear(word: str) -> Mapping[str, CellsOf]:
    """Setters of a number of a joint's gear friction."""
    return {"joint": lambda model, row, entry: number_cells(model, row, word)}


def _servo(word: str) -> Mapping[str, CellsOf]:
    """Setters of a number of a servo's firmware or supply."""
    return {"actuator": lambda model, row, entry: servo_cells(model, row, word)}


def _motor(array: str, column: int, attribute: str) -> Mapping[str, CellsOf]:
    """Setters of a number of a DC motor."""
    return {"actuator": _of_motor(f"actuator_{array}", column, attribute)}


def _of_motor(field: str, column: int, attribute: str) -> CellsOf:
    """A number of a DC motor; one that is zero switches a part of MuJoCo's model off."""

    def cells(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        name = model.actuator(row).name
        if int(model.actuator_gaintype[row]) != _DC_MOTOR:
            raise ConfigError(f"actuator {name!r} is no <dcmotor>")
        if not getattr(model, field)[row, column]:
            raise ConfigError(f"the <dcmotor> {name!r} has no {attribute} in the model; give it one")
        if entry.carry_limit:
            _force_limit(model, row, entry)  # refused where there is none
        return [Cells(field, row, (column,))]

    return cells


def _controller(word: str) -> CellsOf:
    """A number of a <pid>, or of the controller of a <dcmotor>."""

    def cells(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        name, kind = model.actuator(row).name, int(model.actuator_gaintype[row])
        if kind not in _CONTROLLERS[word]:
            raise ConfigError(f"actuator {name!r} is no <pid>, and no <dcmotor> with a controller")
        field, column = _CONTROLLERS[word][kind]
        if not getattr(model, field)[row, column]:
            raise ConfigError(f"actuator {name!r} has no {word} in the model; give it one to start from")
        return [Cells(field, row, (column,), -1.0 if field == "actuator_biasprm" else 1.0)]

    return cells


def _gain(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Gain of a motor or servo."""
    if entry.carry_limit:
        _force_limit(model, row, entry)  # refused where there is none
    cells = gain_cells(model, row)
    if not cells:
        name = model.actuator(row).name
        raise ConfigError(f"actuator {name!r} has no fixed gain: only motors and servos have one to set")
    return cells


def gain_cells(model: mujoco.MjModel, row: int) -> list[Cells]:
    """Gain of an actuator; none where it is not fixed.

    A servo's bias holds the same gain, negated, and must follow it.
    """
    kind = int(model.actuator_gaintype[row])
    if kind in _CONTROLLERS["gain"]:
        field, column = _CONTROLLERS["gain"][kind]
        factor = -1.0 if field == "actuator_biasprm" else 1.0
        return [Cells(field, row, (column,), factor)] if getattr(model, field)[row, column] else []
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
        return _controller("actuator_damping")(model, row, entry)
    if int(model.actuator_biastype[row]) != _AFFINE:
        name = model.actuator(row).name
        raise ConfigError(
            f"actuator {name!r} is a motor, which has no velocity term; set the joint's damping"
        )
    return [Cells("actuator_biasprm", row, (2,), -1.0)]


def _force_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of an actuator's range of forces."""
    if not model.actuator_forcelimited[row]:
        raise ConfigError(
            f"actuator {model.actuator(row).name!r} has no forcerange in the model; give it one"
        )
    return range_cells(model, "actuator_forcerange", row)


def _joint_force_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of a joint's range of actuator forces."""
    if not model.jnt_actfrclimited[row]:
        raise ConfigError(
            f"joint {model.joint(row).name!r} has no actuatorfrcrange in the model; give it one"
        )
    return range_cells(model, "jnt_actfrcrange", row)


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


def _backlash(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Width of the gap between a joint and its drive: half of it is on either side."""
    tendon = next((gap.tendon for gap in gaps(model) if row in (gap.drive, gap.link)), None)
    if tendon is None:
        name = model.joint(row).name
        raise ConfigError(f"joint {name!r} has no gap in the model; `amhe init --backlash {name}` writes one")
    return [Cells("tendon_range", tendon, (1,), 0.5), Cells("tendon_range", tendon, (0,), -0.5)]


def _drive_stiffness(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Stiffness between a joint and its drive."""
    tendon = next((gap.tendon for gap in gaps(model) if row in (gap.drive, gap.link)), None)
    if tendon is None or not model.tendon_stiffness[tendon]:
        name = model.joint(row).name
        raise ConfigError(f"joint {name!r} has no elastic drive; `amhe init --elastic {name}` writes one")
    return [Cells("tendon_stiffness", tendon)]


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
    "load_friction": Setter("-", _gear("load_friction"), lower=-inf),
    "load_friction_motor": Setter("-", _gear("load_friction_motor"), lower=-inf),
    "load_friction_external": Setter("-", _gear("load_friction_external"), lower=-inf),
    "load_friction_quadratic": Setter("1/(N m)", _gear("load_friction_quadratic"), lower=-inf),
    "stribeck_friction": Setter("N m", _gear("stribeck_friction"), lower=-inf),
    "stribeck_exponent": Setter("-", _gear("stribeck_exponent"), positive=True),
    "stribeck_load_friction": Setter("-", _gear("stribeck_load_friction"), lower=-inf),
    "stribeck_load_friction_motor": Setter("-", _gear("stribeck_load_friction_motor"), lower=-inf),
    "stribeck_load_friction_external": Setter("-", _gear("stribeck_load_friction_external"), lower=-inf),
    "stiffness": Setter("N m/rad", _joint("jnt_stiffness")),
    "spring_rest": Setter("rad", {"joint": _spring_rest}, lower=-inf),
    "backlash": Setter("rad", {"joint": _backlash}, positive=True),
    "drive_stiffness": Setter("N m/rad", {"joint": _drive_stiffness}, positive=True),
    "gain": Setter("-", {"actuator": _gain}),
    "actuator_damping": Setter("-", {"actuator": _actuator_damping}),
    "filter_time_constant": Setter("s", {"actuator": _filter}, positive=True),
    "punch": Setter("-", _servo("punch"), lower=-inf),
    "dead_band": Setter("rad", _servo("dead_band"), lower=-inf),
    "supply_sag": Setter("-", _servo("supply_sag"), lower=-inf),
    "back_emf": Setter("N m s/rad", _servo("back_emf"), lower=-inf),
    "supply": Setter("V", _servo("supply"), positive=True),
    "integral_gain": Setter("-", {"actuator": _controller("integral_gain")}, positive=True),
    "integral_limit": Setter("rad s", {"actuator": _controller("integral_limit")}, positive=True),
    "slew_limit": Setter("rad/s", {"actuator": _controller("slew_limit")}, positive=True),
    "motor_constant": Setter("N m/A", _motor("gainprm", 1, "motorconst"), positive=True),
    "resistance": Setter("ohm", _motor("gainprm", 0, "resistance"), positive=True),
    "bristle_stiffness": Setter("N m/rad", _motor("dynprm", 5, "lugre"), positive=True),
    "bristle_damping": Setter("N m s/rad", _motor("dynprm", 6, "lugre"), positive=True),
    "coulomb_friction": Setter("N m", _motor("biasprm", 3, "lugre"), positive=True),
    "static_friction": Setter("N m", _motor("biasprm", 4, "lugre"), positive=True),
    "stribeck_velocity": Setter(
        "rad/s", {**_motor("biasprm", 5, "lugre"), **_gear("stribeck_velocity")}, positive=True
    ),
    "scale": Setter("-", {}, positive=True),
    "bias": Setter("-", {}, lower=-inf),
    "frame": Setter("-", {}, lower=-inf),
    "band": Setter("Hz", {}, positive=True),
    "force_limit": Setter("N m", {"actuator": _force_limit, "joint": _joint_force_limit}, positive=True),
    "ctrl_limit": Setter("-", {"actuator": _ctrl_limit}, positive=True),
}
#: Words that need more than plain numbers, with their selectors.
SPECIAL: Mapping[str, list[str]] = {"pseudo_inertia": ["body"], "command_delay": ["actuator"]}
#: All words that `set:` may be.
WORDS = (*SETTERS, *SPECIAL)
