"""How parameters are written into a model: one candidate or thousands, in one place."""

from __future__ import annotations

import copy
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.system.inertia import body_numbers, log_cholesky, pseudo_inertia, upper_factor
from amhe_cli.system.targets import Cells

_BODY_FIELDS = ("body_mass", "body_ipos", "body_iquat", "body_inertia")


class Edit(Protocol):
    """Writes some parameters into some numbers of the model."""

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
        carried: Bodies whose inertia is scaled with their mass.
    """

    column: int
    written: tuple[Cells, ...]
    mode: Literal["value", "scale", "add"]
    carried: tuple[int, ...] = ()

    @property
    def cells(self) -> tuple[Cells, ...]:
        """The numbers that are set, and the inertias that follow."""
        return self.written + tuple(Cells("body_inertia", row, (0, 1, 2)) for row in self.carried)

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
            if cells.field == "body_mass" and cells.row in self.carried:
                arrays["body_inertia"][:, cells.row] *= (new / old)[:, None]
            array[cells.index] = new


class PseudoInertiaEdit:
    """Ten parameters that are one body's whole inertia, relative to the nominal body."""

    def __init__(self, model: mujoco.MjModel, body: int, columns: Sequence[int]) -> None:
        """Take the nominal body from the model.

        Raises:
            ConfigError: The body's own inertia is not that of any real body.
        """
        self._body, self._columns = body, list(columns)
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
        body = self._body
        wide = (("body_ipos", 3), ("body_iquat", 4), ("body_inertia", 3))
        return (Cells("body_mass", body), *(Cells(field, body, tuple(range(k))) for field, k in wide))

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """See `Edit.write`."""
        numbers = body_numbers(self._nominal @ log_cholesky(theta[:, self._columns]))
        for field, values in zip(_BODY_FIELDS, numbers, strict=True):
            arrays[field][:, self._body] = values


def inputs_of_set_const() -> frozenset[str]:
    """Fields of MjModel from which `mj_setConst` derives others.

    MuJoCo's bindings list them in a private attribute; nothing else of ours reads it.
    """
    fields = getattr(mujoco.MjModel, "_setconst_inputs", None)
    if fields is None:
        raise AmheError(
            f"mujoco {mujoco.__version__} lists no inputs of mj_setConst; install the version 4.0.0"
        )
    return frozenset(fields)


class ModelEdits:
    """Writes parameter vectors into a model's arrays.

    Edits act in the order given, always upon the base model's own values: writing twice is the same
    as writing once. Where single moments of inertia are parameters, the largest is kept to the sum of
    the other two: no real body has more, and MuJoCo would load none.

    Args:
        model: The base model.
        space: The parameters, columns of theta.
        edits: The edits, which write these parameters into the model.
        delay_column: The parameter that is the common command delay [s].
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: ParameterSpace,
        edits: Sequence[Edit],
        delay_column: int | None = None,
    ) -> None:
        self.space = space
        self.delay_column = delay_column
        self._edits = tuple(edits)
        self.cells = tuple(cells for edit in self._edits for cells in edit.cells)
        self.fields: tuple[str, ...] = tuple(dict.fromkeys(cells.field for cells in self.cells))
        self.needs_set_const = bool(inputs_of_set_const() & set(self.fields))
        single = (c for c in self.cells if c.field == "body_inertia" and len(c.columns) == 1)
        self._moments = tuple(dict.fromkeys(c.row for c in single))
        self._base = [(c, np.array(getattr(model, c.field)[c.index[1:]])) for c in self.cells]

    def upon(self, model: mujoco.MjModel) -> ModelEdits:
        """The same edits upon another model of the same layout: another box in the same scene."""
        return ModelEdits(model, self.space, self._edits, self.delay_column)

    def by_parameter(self) -> list[tuple[Parameter, tuple[Cells, ...]]]:
        """Each parameter that sets plain numbers, with all of them."""
        reached: dict[int, tuple[Cells, ...]] = {}
        for edit in self._edits:
            if isinstance(edit, ScalarEdit):
                reached[edit.column] = reached.get(edit.column, ()) + edit.written
        return [(self.space.parameters[column], cells) for column, cells in reached.items()]

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """Write all candidates in place.

        Args:
            arrays: MjModel field -> array (n, ...); every one of `fields` must be there.
            theta: Candidate parameters, shape (n, d).
        """
        for cells, own in self._base:
            arrays[cells.field][cells.index] = own
        for edit in self._edits:
            edit.write(arrays, theta)
        for row in self._moments:
            inertia = arrays["body_inertia"][:, row]
            inertia[:] = np.minimum(inertia, inertia.sum(axis=-1, keepdims=True) - inertia)

    def apply(self, model: mujoco.MjModel, theta: FloatArray) -> mujoco.MjModel:
        """Copy of the model with one candidate (d,) in it, derived constants included.

        Raises:
            ConfigError: MuJoCo refuses the values.
        """
        edited = copy.copy(model)
        arrays: MutableMapping[str, FloatArray] = {f: getattr(edited, f)[None] for f in self.fields}
        self.write(arrays, np.asarray(theta, dtype=np.float64)[None])
        if self.needs_set_const:
            try:
                mujoco.mj_setConst(edited, mujoco.MjData(edited))
            except (mujoco.FatalError, ValueError) as error:
                raise ConfigError(f"MuJoCo refuses these parameters: {error}") from None
        return edited

    def delays(self, theta: FloatArray) -> FloatArray:
        """Common command delay [s] of each candidate of theta (n, d), shape (n,); zero without one."""
        return np.zeros(len(theta)) if self.delay_column is None else theta[:, self.delay_column]
