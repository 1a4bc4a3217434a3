"""Edits: how some parameters are written into some numbers, of one candidate or of thousands.

Most numbers are those of the model. Two arrays stand beside it: the signals' calibration, and the delays of
commands [s].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.parameters.inertia import body_numbers, log_cholesky, pseudo_inertia, upper_factor

#: The arrays that are not the model's.
CALIBRATION, DELAYS = "calibration", "command_delay"
#: Fields of the inertia of a body, in the order of `body_numbers`.
_BODY_FIELDS = ("body_mass", "body_ipos", "body_iquat", "body_inertia")

#: Whether a value is set into a number, multiplied onto it or added to it.
Mode = Literal["value", "scale", "add"]


@dataclass(frozen=True, slots=True)
class Cells:
    """Numbers of one array that take the same value, times a factor.

    Args:
        field: Name of the array: a field of MjModel, or one that is not the model's.
        row: Row in the array.
        columns: Columns of that row; empty for arrays of one column, which have none.
        factor: MuJoCo stores the value times this: -1 for a servo's bias, 1/2 for either end of a gap.
        name: What people call it, of a number that belongs to no element of the model.
        own: Its value without parameters, if the array is not the model's.
    """

    field: str
    row: int
    columns: tuple[int, ...] = ()
    factor: float = 1.0
    name: str = ""
    own: float = 0.0

    @property
    def index(self) -> tuple[slice | int | list[int], ...]:
        """Index of these numbers in an array (n, ...) of n candidates."""
        return (slice(None), self.row, list(self.columns)) if self.columns else (slice(None), self.row)

    @property
    def beside(self) -> bool:
        """Whether the array is not the model's."""
        return self.field in (CALIBRATION, DELAYS)

    def of(self, model: mujoco.MjModel) -> FloatArray:
        """The values without parameters, factor taken out."""
        values = self.own if self.beside else getattr(model, self.field)[self.index[1:]]
        return np.atleast_1d(np.asarray(values, dtype=np.float64)) / self.factor


def range_cells(model: mujoco.MjModel, field: str, row: int) -> list[Cells]:
    """Both ends of a range about zero, or its upper end alone where it begins at zero."""
    lower = getattr(model, field)[row, 0]
    return [Cells(field, row, (1,)), *([Cells(field, row, (0,), -1.0)] if lower else [])]


class Edit(Protocol):
    """Writes some parameters into some numbers."""

    @property
    def columns(self) -> Sequence[int]:
        """Columns of theta that the edit writes."""
        ...

    @property
    def cells(self) -> tuple[Cells, ...]:
        """Every number that the edit may change."""
        ...

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """Write theta (n, d) into arrays (n, ...) that hold the numbers' own or earlier edits' values."""
        ...


@dataclass(frozen=True, slots=True)
class ScalarEdit:
    """One parameter, set into, multiplied onto or added to numbers.

    Args:
        column: Column of theta.
        written: The numbers that the parameter sets.
        mode: Whether it is set into them, multiplied onto them or added to them.
        carried: For some of the written, numbers that are scaled with them: inertia with mass, a servo's
            limit of force with its gain.
    """

    column: int
    written: tuple[Cells, ...]
    mode: Mode
    carried: Mapping[Cells, tuple[Cells, ...]] = field(default_factory=dict)

    @property
    def columns(self) -> Sequence[int]:
        """See `Edit`."""
        return (self.column,)

    @property
    def cells(self) -> tuple[Cells, ...]:
        """The numbers that are set, and those that follow."""
        return self.written + tuple(cells for following in self.carried.values() for cells in following)

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        value = theta[:, self.column]
        for cells in self.written:
            array = arrays[cells.field]
            wide = value[:, None] if cells.columns else value
            old = array[cells.index]
            if self.mode == "value":
                new = np.broadcast_to(cells.factor * wide, old.shape)
            else:
                new = old * wide if self.mode == "scale" else old + cells.factor * wide
            for following in self.carried.get(cells, ()):
                arrays[following.field][following.index] *= (new / old).reshape(len(theta), 1)
            array[cells.index] = new


class PseudoInertiaEdit:
    """Ten parameters that are one body's whole inertia, relative to the nominal body."""

    def __init__(self, model: mujoco.MjModel, body: int, columns: Sequence[int]) -> None:
        """Take the nominal body from the model.

        Raises:
            ConfigError: The body's own inertia is not that of any real body.
        """
        self.body, self.columns = body, list(columns)
        mass, *rest = (getattr(model, name)[body] for name in _BODY_FIELDS)
        try:
            self._nominal = upper_factor(pseudo_inertia(float(mass), *rest))
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"body {model.body(body).name!r} has an inertia that no real body has: mass "
                f"{mass:g}, principal moments {rest[-1]}; correct it first"
            ) from None

    @property
    def cells(self) -> tuple[Cells, ...]:
        """Mass, centre of mass, principal axes and moments."""
        return tuple(
            Cells(name, self.body, tuple(range(width)))
            for name, width in zip(_BODY_FIELDS, (0, 3, 4, 3), strict=True)
        )

    def factor(self, theta: FloatArray) -> FloatArray:
        """Factor of the pseudo-inertia of candidates theta (n, d), shape (n, 4, 4)."""
        return self._nominal @ log_cholesky(theta[:, self.columns])

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        numbers = body_numbers(self.factor(theta))
        for name, values in zip(_BODY_FIELDS, numbers, strict=True):
            arrays[name][:, self.body] = values


@dataclass(frozen=True, slots=True)
class ZeroEdit:
    """The zeros of joints' encoders: coordinate and mechanical stops of each joint move by its bias.

    Args:
        rows: Joint -> where its coordinate begins in qpos, and the row of its bias in the calibration.
    """

    rows: Mapping[int, tuple[int, int]]
    columns: tuple[int, ...] = ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """See `Edit`."""
        zeros = [Cells(name, at) for at, _ in self.rows.values() for name in ("qpos0", "qpos_spring")]
        return (*zeros, *(Cells("jnt_range", joint, (0, 1)) for joint in self.rows))

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        for joint, (address, row) in self.rows.items():
            bias = arrays[CALIBRATION][:, row]
            arrays["qpos0"][:, address] += bias
            arrays["qpos_spring"][:, address] += bias
            arrays["jnt_range"][:, joint] += bias[:, None]


@dataclass(frozen=True, slots=True)
class ForceEdit:
    """Scale and bias of a logged force that drives the model: its actuators take (reading - bias) / scale.

    Args:
        rows: Actuator -> rows of its scale and of its bias in the calibration.
    """

    rows: Mapping[int, tuple[int, int]]
    columns: tuple[int, ...] = ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """See `Edit`."""
        fields = ("actuator_gainprm", "actuator_biasprm")
        return tuple(Cells(name, actuator, (0,)) for actuator in self.rows for name in fields)

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        for actuator, (scale, bias) in self.rows.items():
            numbers = arrays[CALIBRATION]
            arrays["actuator_gainprm"][:, actuator, 0] = 1.0 / numbers[:, scale]
            arrays["actuator_biasprm"][:, actuator, 0] = -numbers[:, bias] / numbers[:, scale]


@dataclass(frozen=True, slots=True)
class CommandEdit:
    """Zeros of commands: servos go to what the log has as their command, less its bias.

    Args:
        rows: Actuator -> row of its bias in the calibration.
    """

    rows: Mapping[int, int]
    columns: tuple[int, ...] = ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """See `Edit`."""
        return tuple(Cells("actuator_biasprm", actuator, (0,)) for actuator in self.rows)

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`: gains are set before."""
        for actuator, row in self.rows.items():
            bias = arrays["actuator_biasprm"][:, actuator]
            bias[:, 0] += bias[:, 1] * arrays[CALIBRATION][:, row]  # minus the gain
