"""All edits of a system: how parameter vectors are written into its model, its delays and its calibration."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.edits import (
    CALIBRATION,
    DELAYS,
    Cells,
    Edit,
    Mode,
    PseudoInertiaEdit,
    ScalarEdit,
)
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.inertia import inertia_about_com
from amhe_cli.system.parameters.servos import Servos

#: Fields with the gain of an actuator and the limit of its force.
_GAIN, _LIMIT = "actuator_gainprm", "actuator_forcerange"


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


class Held(NamedTuple):
    """Value of a parameter that nobody asked for, and how well it is known (sd); 0: nobody measured it."""

    value: float
    sd: float = 0.0


class ModelEdits:
    """Writes parameter vectors into a model's arrays.

    Edits act in the order given, always upon the base model's own values: writing twice is the same
    as writing once. Where single moments of inertia are parameters, the largest is kept to the sum of
    the other two: no real body has more, and MuJoCo would load none.

    Args:
        model: The base model.
        space: The parameters, columns that the edits write.
        edits: The edits, which write these parameters.
        beside: The arrays that are not the model's, without parameters, each (k,).
        commands: The delay of each command.
        fixed: Parameters that have one value in all candidates, by name: theta has the others only.
        held: Parameters that nobody asked for, by name, likewise.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        space: ParameterSpace,
        edits: Sequence[Edit],
        beside: Mapping[str, FloatArray],
        commands: Sequence[Cells] = (),
        fixed: Mapping[str, float] | None = None,
        held: Mapping[str, Held] | None = None,
    ) -> None:
        self._model, self._beside, self._commands = model, dict(beside), tuple(commands)
        self.fixed, self.held = dict(fixed or {}), dict(held or {})
        self.space = space.without(self._known)
        self._all = space
        self._free = [i for i, name in enumerate(space.names) if name not in self._known]
        self._edits = tuple(edit for edit in edits if not edit.cells[0].beside)
        self._edits_beside = tuple(edit for edit in edits if edit.cells[0].beside)
        self.cells = tuple(cells for edit in self._edits for cells in edit.cells)
        self.fields: tuple[str, ...] = tuple(dict.fromkeys(cells.field for cells in self.cells))
        self.needs_set_const = bool(inputs_of_set_const() & set(self.fields))
        single = (c for c in self.cells if c.field == "body_inertia" and len(c.columns) == 1)
        self._moments = tuple(dict.fromkeys(c.row for c in single))
        self._base = [(c, np.array(getattr(model, c.field)[c.index[1:]])) for c in self.cells]

    @property
    def _every(self) -> tuple[Edit, ...]:
        return (*self._edits, *self._edits_beside)

    def upon(self, model: mujoco.MjModel) -> ModelEdits:
        """The same edits upon another model of the same layout: another box in the same scene."""
        return self.extended(model)

    def extended(
        self,
        model: mujoco.MjModel,
        more: Sequence[tuple[Parameter, tuple[Cells, ...], Mode]] = (),
        calibration: SignalCalibration | None = None,
    ) -> ModelEdits:
        """These edits upon a model of the same layout, and after them those of further parameters.

        Args:
            more: Each parameter with the numbers that it sets.
            calibration: The signals' calibration, with all numbers that these parameters set.
        """
        space = ParameterSpace((*self._all.parameters, *(parameter for parameter, _, _ in more)))
        scalar = [ScalarEdit(len(self._all) + i, cells, mode) for i, (_, cells, mode) in enumerate(more)]
        beside = self._beside | ({} if calibration is None else {CALIBRATION: calibration.own})
        edits = (*self._every, *scalar)
        return ModelEdits(
            model, space if more else self._all, edits, beside, self._commands, self.fixed, self.held
        )

    def fixing(self, values: Mapping[str, float]) -> ModelEdits:
        """The same edits with more parameters at fixed values, by name."""
        other = copy.copy(self)
        other.fixed = self.fixed | dict(values)
        other.held = {name: held for name, held in self.held.items() if name not in values}
        other.space = self._all.without(other._known)
        other._free = [i for i, name in enumerate(self._all.names) if name not in other._known]
        return other

    @property
    def _known(self) -> dict[str, float]:
        """Values of the parameters that are not free."""
        return {name: held.value for name, held in self.held.items()} | self.fixed

    @property
    def taken(self) -> set[tuple[str, int]]:
        """Field and row of the numbers that parameters set, held ones only where somebody measured them.

        A limit of force that follows a gain is one only where a gain beside it, or a limit, is set too:
        nothing else says how exact the ratio of the two is.
        """
        guessed = {name for name, held in self.held.items() if not held.sd}
        edits = [e for e in self._every if not {self._all.names[i] for i in e.columns[:1]} & guessed]
        alone = {
            cells.row
            for edit in edits
            if isinstance(edit, ScalarEdit)
            for cells in edit.written
            if cells.field == _LIMIT or (cells.field == _GAIN and cells not in edit.carried)
        }
        every = ((cells.field, cells.row) for edit in edits for cells in edit.cells)
        return {one for one in every if one[0] != _LIMIT or one[1] in alone}

    def considered(self) -> Iterator[tuple[Parameter, Held, tuple[Cells, ...], Mode]]:
        """Held parameters that somebody measured: each with its value, what it sets, and how."""
        for parameter, edits in self._scalar(self._every).items():
            if (held := self.held.get(parameter.name, Held(0.0))).sd:
                yield parameter, held, tuple(c for edit in edits for c in edit.written), edits[0].mode

    def by_parameter(self) -> list[tuple[Parameter, tuple[Cells, ...]]]:
        """Each parameter that sets plain numbers of the model, with all of them."""
        scalar = self._scalar(self._edits).items()
        return [(parameter, tuple(c for edit in edits for c in edit.written)) for parameter, edits in scalar]

    def _scalar(self, edits: Sequence[Edit]) -> dict[Parameter, list[ScalarEdit]]:
        """Those of the edits that write one parameter, by it."""
        found: dict[Parameter, list[ScalarEdit]] = {}
        for edit in edits:
            if isinstance(edit, ScalarEdit):
                found.setdefault(self._all.parameters[edit.column], []).append(edit)
        return found

    def own(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """Copy of a model that these edits have written to, with the base model's own numbers again."""
        plain = copy.copy(model)
        for cells, numbers in self._base:
            getattr(plain, cells.field)[cells.index[1:]] = numbers
        return plain

    def by_name(self) -> Iterator[tuple[str, Edit]]:
        """Each parameter, fixed ones too, with an edit that writes it."""
        for edit in self._every:
            for column in edit.columns:
                yield self._all.names[column], edit

    @property
    def bodies(self) -> dict[str, PseudoInertiaEdit]:
        """Edits of whole inertias, by the name of their parameter."""
        whole = [edit for edit in self._edits if isinstance(edit, PseudoInertiaEdit)]
        return {self._all.names[edit.columns[0]].rpartition(".")[0]: edit for edit in whole}

    def inertias(self, theta: FloatArray) -> Iterator[tuple[str, dict[str, FloatArray]]]:
        """Mass, centre of mass and inertia of each such body for candidates theta (n, d)."""
        for name, edit in self.bodies.items():
            yield name, inertia_about_com(edit.factor(self._whole(theta)))

    def _whole(self, theta: FloatArray) -> FloatArray:
        """Columns of all parameters (n, D) from those that are free (n, d)."""
        known = self._known
        if not known:
            return theta
        whole = np.tile([known.get(name, np.nan) for name in self._all.names], (len(theta), 1))
        whole[:, self._free] = theta
        return whole

    def _arrays_beside(self, whole: FloatArray) -> dict[str, FloatArray]:
        """The arrays that are not the model's under all parameters (n, D), each (n, k)."""
        arrays = {name: np.tile(own, (len(whole), 1)) for name, own in self._beside.items()}
        for edit in self._edits_beside:
            edit.write(arrays, whole)
        return arrays

    def write(self, arrays: Mapping[str, FloatArray], theta: FloatArray) -> None:
        """Write all candidates in place.

        Args:
            arrays: MjModel field -> array (n, ...); every one of `fields` must be there.
            theta: Candidate parameters, shape (n, d).
        """
        for cells, numbers in self._base:
            arrays[cells.field][cells.index] = numbers
        whole = self._whole(theta)
        every = {**arrays, **self._arrays_beside(whole)}
        for edit in self._edits:
            edit.write(every, whole)
        for row in self._moments:
            inertia = arrays["body_inertia"][:, row]
            inertia[:] = np.minimum(inertia, inertia.sum(axis=-1, keepdims=True) - inertia)

    def written(self, theta: FloatArray) -> dict[str, FloatArray]:
        """The arrays of the model that parameters write into, (n, ...), under candidates theta (n, d)."""
        arrays = {name: np.repeat(getattr(self._model, name)[None], len(theta), 0) for name in self.fields}
        self.write(arrays, theta)
        return arrays

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

    @property
    def gear_friction(self) -> GearFriction | None:
        """The joints whose friction is not constant; None where there is none."""
        return GearFriction.of(self._model, self.numerics)

    @property
    def servos(self) -> Servos | None:
        """The servos that are more than a gain and a limit; None where there is none."""
        return Servos.of(self._model, self.numerics)

    @property
    def numerics(self) -> set[int]:
        """Places in `numeric_data` that parameters set."""
        return {cells.row for cells in self.cells if cells.field == "numeric_data"}

    @property
    def calibrated(self) -> set[int]:
        """Rows of the signals' calibration that parameters set."""
        return {c.row for edit in self._edits_beside for c in edit.cells if c.field == CALIBRATION}

    def numbers(self, theta: FloatArray) -> FloatArray:
        """Numbers of the signals' calibration under candidates theta (n, d), shape (n, k)."""
        return self._arrays_beside(self._whole(theta))[CALIBRATION]

    def delays(self, theta: FloatArray) -> FloatArray:
        """Delays [s] of the engine's inputs under candidates theta (n, d), shape (n, nu).

        Of a system without commands they are zero, shape (n, 1).
        """
        return self._delays(self._whole(theta))

    def _delays(self, whole: FloatArray) -> FloatArray:
        return np.maximum(self._arrays_beside(whole)[DELAYS], 0.0)  # nothing acts before it was commanded

    @property
    def late(self) -> frozenset[str]:
        """Names of the free parameters that delay commands."""
        edits = [edit for edit in self._edits_beside if edit.cells[0].field == DELAYS]
        return frozenset(self._all.names[i] for edit in edits for i in edit.columns) - set(self._known)

    @property
    def prompt(self) -> tuple[Cells, ...]:
        """The delays of all commands, where no parameter delays any."""
        return () if self.longest_delay > 0.0 else self._commands

    @property
    def longest_delay(self) -> float:
        """Upper bound of the command delays [s]; zero without any."""
        most = [self._known.get(p.name, p.upper) for p in self._all.parameters]
        return float(self._delays(np.array([most])).max())
