"""Where a model has the numbers of a drive: its gains, its limits, the constants of its motor, its backlash.

Each function takes the row of an actuator or joint, and raises ConfigError where the number has no effect.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.description.schema import TargetEntry
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.cells import Cells, range_cells

#: From a model, the row of an element and a target to the numbers that the target sets; raises ConfigError
#: where they would have no effect.
CellsOf = Callable[[mujoco.MjModel, int, TargetEntry], list[Cells]]

_DC_MOTOR, _PID = int(mujoco.mjtGain.mjGAIN_DCMOTOR), int(mujoco.mjtGain.mjGAIN_PID)
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
#: Where a <pid>, and the controller of a <dcmotor>, have their numbers: field and column.
_CONTROLLERS = {
    "gain": {_PID: ("actuator_biasprm", 1), _DC_MOTOR: ("actuator_gainprm", 4)},
    "actuator_damping": {_PID: ("actuator_biasprm", 2), _DC_MOTOR: ("actuator_gainprm", 6)},
    "integral_gain": {_PID: ("actuator_gainprm", 0), _DC_MOTOR: ("actuator_gainprm", 5)},
    "integral_limit": {_PID: ("actuator_dynprm", 0), _DC_MOTOR: ("actuator_dynprm", 8)},
    "slew_limit": {_PID: ("actuator_dynprm", 1), _DC_MOTOR: ("actuator_dynprm", 7)},
}


def motor(field: str, column: int, attribute: str) -> CellsOf:
    """A number of a DC motor; one that is zero switches a part of MuJoCo's model off."""

    def cells(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
        name = model.actuator(row).name
        if int(model.actuator_gaintype[row]) != _DC_MOTOR:
            raise ConfigError(f"actuator {name!r} is no <dcmotor>")
        if not getattr(model, field)[row, column]:
            raise ConfigError(f"the <dcmotor> {name!r} has no {attribute} in the model; give it one")
        if entry.carry_limit:
            force_limit(model, row, entry)  # refused where there is none
        return [Cells(field, row, (column,))]

    return cells


def controller(word: str) -> CellsOf:
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


def gain(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Gain of a motor or servo."""
    if entry.carry_limit:
        force_limit(model, row, entry)  # refused where there is none
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
    own, bias = model.actuator_gainprm[row, 0], model.actuator_biasprm[row]
    cells = [Cells("actuator_gainprm", row, (0,))]
    if int(model.actuator_biastype[row]) == _AFFINE and own:
        tied = next((column for column in (1, 2) if np.isclose(bias[column], -own)), None)
        cells += [Cells("actuator_biasprm", row, (tied,), -1.0)] if tied else []
    return cells


def actuator_damping(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Velocity term of a servo."""
    if int(model.actuator_gaintype[row]) == _DC_MOTOR:
        return controller("actuator_damping")(model, row, entry)
    if int(model.actuator_biastype[row]) != _AFFINE:
        name = model.actuator(row).name
        raise ConfigError(
            f"actuator {name!r} is a motor, which has no velocity term; set the joint's damping"
        )
    return [Cells("actuator_biasprm", row, (2,), -1.0)]


def force_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of an actuator's range of forces."""
    if not model.actuator_forcelimited[row]:
        raise ConfigError(
            f"actuator {model.actuator(row).name!r} has no forcerange in the model; give it one"
        )
    return range_cells(model, "actuator_forcerange", row)


def joint_force_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of a joint's range of actuator forces."""
    if not model.jnt_actfrclimited[row]:
        raise ConfigError(
            f"joint {model.joint(row).name!r} has no actuatorfrcrange in the model; give it one"
        )
    return range_cells(model, "jnt_actfrcrange", row)


def ctrl_limit(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Both ends of an actuator's range of controls."""
    ctrl = int(model.actuator_ctrladr[row])
    if model.actuator_ctrlnum[row] != 1 or not model.actuator_ctrllimited[ctrl]:
        raise ConfigError(f"actuator {model.actuator(row).name!r} has no ctrlrange in the model; give it one")
    return range_cells(model, "actuator_ctrlrange", ctrl)


def backlash(model: mujoco.MjModel, row: int, entry: TargetEntry) -> list[Cells]:
    """Width of the gap between a joint and its drive: half of it is on either side."""
    tendon = next((gap.tendon for gap in gaps(model) if row in (gap.drive, gap.link)), None)
    if tendon is None:
        name = model.joint(row).name
        raise ConfigError(f"joint {name!r} has no gap in the model; `amhe init --backlash {name}` writes one")
    return [Cells("tendon_range", tendon, (1,), 0.5), Cells("tendon_range", tendon, (0,), -0.5)]
