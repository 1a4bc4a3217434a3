"""Edits: how some parameters are written into some numbers, of one candidate or of thousands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.system.parameters.cells import Cells
from amhe_cli.system.parameters.inertia import body_numbers, log_cholesky, pseudo_inertia, upper_factor

#: Fields of the inertia of a body, in the order of `body_numbers`.
_BODY_FIELDS = ("body_mass", "body_ipos", "body_iquat", "body_inertia")


#: Whether a value is set into a number, multiplied onto it or added to it.
Mode = Literal["value", "scale", "add"]


class Edit(Protocol):
    """Writes some parameters into some numbers of the model."""

    @property
    def columns(self) -> Sequence[int]:
        """Columns of theta that the edit writes."""
        ...

    @property
    def cells(self) -> tuple[Cells, ...]:
        """Every number that the edit may change."""
        ...

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """Write theta (n, d) into arrays (n, ...) that hold the model's own or earlier edits' values."""
        ...


@dataclass(frozen=True, slots=True)
class ScalarEdit:
    """One parameter, set into, multiplied onto or added to numbers of the model.

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
        """See `Edit.columns`."""
        return (self.column,)

    @property
    def target(self) -> str:
        """What has the numbers: an array of the model, 'command_delay' or 'calibration'."""
        return self.written[0].field

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
        try:
            self._nominal = upper_factor(
                pseudo_inertia(
                    float(model.body_mass[body]),
                    model.body_ipos[body],
                    model.body_iquat[body],
                    model.body_inertia[body],
                )
            )
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"body {model.body(body).name!r} has an inertia that no real body has: mass "
                f"{model.body_mass[body]:g}, principal moments {model.body_inertia[body]}; correct it first"
            ) from None

    @property
    def cells(self) -> tuple[Cells, ...]:
        """Mass, centre of mass, principal axes and moments."""
        body = self.body
        wide = (("body_ipos", 3), ("body_iquat", 4), ("body_inertia", 3))
        return (Cells("body_mass", body), *(Cells(field, body, tuple(range(k))) for field, k in wide))

    def factor(self, theta: FloatArray) -> FloatArray:
        """Factor of the pseudo-inertia of candidates theta (n, d), shape (n, 4, 4)."""
        return self._nominal @ log_cholesky(theta[:, self.columns])

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        numbers = body_numbers(self.factor(theta))
        for name, values in zip(_BODY_FIELDS, numbers, strict=True):
            arrays[name][:, self.body] = values
