"""From the `parameters:` of a system file to a parameter space and its edits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.system.description.calibration_keys import CalibrationDraft
from amhe_cli.system.description.schema import Description, ParameterEntry, SystemEntry, TargetEntry
from amhe_cli.system.description.targets import SETTERS, cells_of, rows_of, selector_of, unit_of
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.edits import (
    CALIBRATION,
    DELAYS,
    Cells,
    Edit,
    PseudoInertiaEdit,
    ScalarEdit,
    range_cells,
)
from amhe_cli.system.parameters.gear_friction import BOTH, GEARS, OWN
from amhe_cli.system.parameters.inertia import PSEUDO_NAMES
from amhe_cli.system.parameters.model_edits import Held, ModelEdits
from amhe_cli.system.parameters.servos import OF_SERVO, SERVOS, SIGNALS

#: A target, and the numbers that it sets.
_Reached = tuple[TargetEntry, list[Cells]]

#: Prior sd of log(theta) where none is given: a factor of 1.65 either way at one sd.
LOG_PRIOR_SD = 0.5
#: Bounds where none are given: this factor below and above the nominal value.
LOG_RANGE = 10.0
#: Bounds of the ten numbers of a pseudo-inertia.
PSEUDO_BOUNDS = (-1.0, 1.0)
#: Prior sd of the ten numbers of a pseudo-inertia: one sd is about a quarter of the size.
PSEUDO_PRIOR_SD = 0.25
#: Targets that need the general form of a body's equations of motion (MuJoCo's simple="false").
_GENERAL = ("center_of_mass", "pseudo_inertia")
#: Mass and gain first, because the inertia and the limit that they carry along may be set afterwards.
_ORDER = {"mass": 0, "pseudo_inertia": 0, "gain": 0, "motor_constant": 0}


def generalise(spec: mujoco.MjSpec, entry: SystemEntry) -> None:
    """Give the model what targets need.

    Bodies whose centre of mass will move are compiled without MuJoCo's short cuts for simple bodies; joints
    whose gear friction is set get its numbers, and so do servos.
    """
    targets = [target for parameter in entry.parameters.values() for target in parameter.targets]
    moved = [target.body for target in targets if target.set in _GENERAL and target.body]
    geared = [target.joint for target in targets if target.set in (*OWN, *BOTH) and target.joint]
    geared += entry.settings.identify.geared
    for body in spec.bodies:
        if _meant(body.name, moved):
            body.simple = 0
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    GEARS.add(spec, [j.name for j in spec.joints if j.type in single and _meant(j.name, geared)])
    driven = [target.actuator for target in targets if target.set in OF_SERVO and target.actuator]
    for signal in entry.signals.values():
        if any(told in (signal.quantity, *signal.columns, *signal.fields) for told in SIGNALS):
            driven += list(signal.actuators or ())
    SERVOS.add(spec, [one.name for one in spec.actuators if _meant(one.name, driven)])


def _meant(name: str, patterns: list[str]) -> bool:
    return any(name == pattern or fnmatchcase(name, pattern) for pattern in patterns)


class _Unknowns:
    """What has been read of the parameters so far, of the arguments of `unknowns_of`; mistakes are noted."""

    def __init__(
        self,
        file: Description,
        model: mujoco.MjModel,
        draft: CalibrationDraft,
        commands: Mapping[str, Sequence[Cells]],
    ) -> None:
        self._file, self._model, self._draft, self._commands = file, model, draft, commands
        self.parameters: list[Parameter] = []
        self._edits: list[tuple[tuple[int, bool], Edit]] = []
        self._set_by: dict[tuple[str, int, int], str] = {}

    @property
    def edits(self) -> list[Edit]:
        """The edits, in the order in which they act."""
        return [edit for _, edit in sorted(self._edits, key=lambda ranked: ranked[0])]

    def add(self, name: str, entry: ParameterEntry) -> None:
        """Read one parameter."""
        if any(target.set == "pseudo_inertia" for target in entry.targets):
            self._add_pseudo(name, entry)
            return
        column, reached = len(self.parameters), list[_Reached]()
        for index, target in enumerate(entry.targets):
            try:
                cells = self._cells_of(target)
                reached.append((target, cells))
                self._claim(name, target, cells)
            except ConfigError as error:
                self._file.problem(("parameters", name, "targets", index), str(error))
                continue
            # what is scaled or added to is set first
            rank = _ORDER.get(target.set, 1), target.mode != "value"
            edit = ScalarEdit(column, tuple(cells), target.mode, _carried(target, cells, self._model))
            self._edits += [(rank, edit)] if cells else []
        if len(reached) < len(entry.targets):
            return
        try:
            parameter = _parameter(name, entry, reached, self._model)
            _check_limits(parameter, reached, self._model)
        except ConfigError as error:
            self._file.problem(("parameters", name), str(error))
            return
        target, _ = reached[0]
        if target.signal is not None and entry.unit is None and target.mode != "scale":
            parameter = replace(parameter, unit=self._draft.unit_of(target))
        for target, cells in reached:
            if target.set == "band":
                self._draft.lowest(cells, min(_smallest(parameter, target, cells, self._model)))
        self.parameters.append(parameter)

    def _cells_of(self, target: TargetEntry) -> list[Cells]:
        selector = selector_of(target)
        if selector == "signal":
            return self._draft.cells_of(target)
        if target.set != "command_delay":
            return cells_of(self._model, target)
        names = [name for name in self._commands if fnmatchcase(name, target.actuator or "*")]
        if target.actuator is not None and not names:
            raise ConfigError(one_of("actuator that a signal commands", target.actuator, self._commands))
        named = target.actuator is not None
        return [replace(cells, name=name * named) for name in names for cells in self._commands[name]]

    def _add_pseudo(self, name: str, entry: ParameterEntry) -> None:
        columns = range(len(self.parameters), len(self.parameters) + len(PSEUDO_NAMES))
        try:
            if len(entry.targets) > 1 or entry.scale == "log" or entry.nominal:
                raise ConfigError(
                    "a pseudo_inertia is the only target of its parameter, on the linear scale, relative to "
                    "the model's own inertia (nominal 0)"
                )
            target, model = entry.targets[0], self._model
            bodies = rows_of(model, target, selector_of(target) or "body")
            if len(bodies) > 1:
                raise ConfigError(f"{target.body!r} means {len(bodies)} bodies; a pseudo_inertia is of one")
            if model.body_weldid[bodies[0]] == 0:
                raise ConfigError(f"body {target.body!r} is fixed to the world: its inertia changes nothing")
            edit = PseudoInertiaEdit(model, bodies[0], columns)
            self._claim(name, target, list(edit.cells))
            lower, upper = entry.bounds or PSEUDO_BOUNDS
            if not lower < 0.0 < upper:
                raise ConfigError(
                    f"bounds [{lower:g}, {upper:g}] must hold 0, the model's own inertia, inside"
                )
        except ConfigError as error:
            self._file.problem(("parameters", name, "targets", 0), str(error))
            return
        sd = PSEUDO_PRIOR_SD if entry.prior_sd is None else entry.prior_sd
        self.parameters += [Parameter(f"{name}.{k}", "-", 0.0, lower, upper, False, sd) for k in PSEUDO_NAMES]
        self._edits.append(((0, False), edit))

    def _claim(self, name: str, target: TargetEntry, cells: list[Cells]) -> None:
        """Refuse a number that two parameters would set."""
        if target.mode != "value":
            return
        for part in cells:
            for column in part.columns or (0,):
                other = self._set_by.setdefault((part.field, part.row, column), name)
                if other != name:
                    raise ConfigError(
                        f"parameter {other!r} already sets this number; use mode: scale or add for one"
                    )


def unknowns_of(
    file: Description,
    entry: SystemEntry,
    model: mujoco.MjModel,
    draft: CalibrationDraft,
    commands: Mapping[str, Sequence[Cells]],
    width: int,
) -> tuple[ParameterSpace, ModelEdits, SignalCalibration]:
    """Parameters of the file and how they are written; every mistake is noted in `file`.

    Args:
        file, entry: The description.
        model: The final model.
        draft: The calibration's numbers.
        commands: Actuator that a signal commands -> the delays of its commands.
        width: Number of the engine's inputs, each with a delay.
    """
    draft.read(file)
    unknowns = _Unknowns(file, model, draft, commands)
    for name, parameter in entry.parameters.items():
        unknowns.add(name, parameter)
    space = ParameterSpace(tuple(unknowns.parameters))
    calibration, needed = draft.finished()
    fixed = {p.name: p.nominal for p in space.parameters if p.prior_sd == 0.0}
    if fixed and len(fixed) == len(space):
        file.problem(("parameters",), "every parameter has the prior_sd 0, which fixes it: leave one free")
    beside = {CALIBRATION: calibration.own, DELAYS: np.zeros(width)}
    late = [cells for several in commands.values() for cells in several]
    edits = [*unknowns.edits, *needed]
    written = ModelEdits(model, space, edits, beside, late, fixed, _held(file, entry))
    return written.space, written, calibration


def _held(file: Description, entry: SystemEntry) -> dict[str, Held]:
    """Parameters that nobody asks for, by name: `unknowns` names neither them nor their group."""
    asked = entry.unknowns
    if asked is None:
        return {}
    known = {name for name in (*entry.parameters, *(p.group for p in entry.parameters.values())) if name}
    for index, name in enumerate(asked):
        if name not in known:
            file.problem(("unknowns", index), one_of("parameter or group of them", name, sorted(known)))
    held = {}
    for name, parameter in entry.parameters.items():
        value = parameter.nominal if parameter.held is None else parameter.held
        if name in asked or parameter.group in asked:
            continue
        if value is None:
            file.problem(("parameters", name), "who can be held needs a value: give it a nominal")
        else:
            held[name] = Held(value, parameter.held_sd)
    return held


def _carried(
    target: TargetEntry, cells: list[Cells], model: mujoco.MjModel
) -> dict[Cells, tuple[Cells, ...]]:
    """Numbers that scale with those that a target sets."""
    if target.set == "mass" and target.carry_inertia:
        return {c: (Cells("body_inertia", c.row, (0, 1, 2)),) for c in cells}
    if target.carry_limit:  # a servo has its gain twice
        gains = {c.row: c for c in reversed(cells)}
        return {c: tuple(range_cells(model, "actuator_forcerange", row)) for row, c in gains.items()}
    return {}


def _parameter(name: str, entry: ParameterEntry, reached: list[_Reached], model: mujoco.MjModel) -> Parameter:
    """The parameter, what is not given taken from the model."""
    target, cells = reached[0]
    positive = all(_limit(t) >= 0.0 and t.mode != "add" and t.set in SETTERS for t, _ in reached)
    log = entry.scale == "log" or (entry.scale is None and positive)
    nominal = entry.nominal if entry.nominal is not None else _own_value(target, cells, model)
    if log and nominal <= 0.0:
        raise ConfigError(f"nominal is {nominal:g}; scale: log needs a value above 0, or give scale: linear")
    if entry.bounds is None and not log:
        raise ConfigError("give bounds: [lower, upper]; only scale: log has some by default")
    lower, upper = entry.bounds or (nominal / LOG_RANGE, nominal * LOG_RANGE)
    if not lower < nominal < upper:
        raise ConfigError(f"nominal {nominal:g} must lie strictly between its bounds [{lower:g}, {upper:g}]")
    if log and lower <= 0.0:
        raise ConfigError(f"bounds [{lower:g}, {upper:g}]: scale: log needs a lower bound above 0")
    usual = LOG_PRIOR_SD if log else (upper - lower) / 4.0
    sd = usual if entry.prior_sd is None else entry.prior_sd
    unit = entry.unit or unit_of(target, model)
    made = Parameter(name, unit, nominal, lower, upper, log, sd)
    return made if entry.drift is None else replace(made, drift=entry.drift)


def _own_value(target: TargetEntry, cells: list[Cells], model: mujoco.MjModel) -> float:
    """The model's own value of the target."""
    if target.mode != "value":
        return 1.0 if target.mode == "scale" else 0.0
    if not cells:
        raise ConfigError(f"give a nominal value: the model has no {target.set} of its own")
    values = np.concatenate([part.of(model) for part in cells])
    if np.ptp(values) > 1e-9 * np.abs(values).max():
        raise ConfigError(
            f"the model's own values differ, {values.min():g} to {values.max():g}: give a nominal, or "
            "mode: scale"
        )
    if values[0] == 0.0 and _limit(target) >= 0.0:
        raise ConfigError(f"the model's own {target.set} is 0: give a nominal value")
    return float(values[0])


def _limit(target: TargetEntry) -> float:
    return SETTERS[target.set].lower if target.set in SETTERS else 0.0


def _check_limits(parameter: Parameter, reached: list[_Reached], model: mujoco.MjModel) -> None:
    """Refuse bounds that would let a mass, an inertia, a friction, ... become impossible."""
    for target, cells in reached:
        limit = _limit(target)
        strict = target.set in SETTERS and SETTERS[target.set].positive
        for smallest in _smallest(parameter, target, cells, model):
            if smallest < limit or (strict and smallest == limit):
                wanted = f"{'above' if strict else 'at least'} {limit:g}"
                text = f"the lower bound {parameter.lower:g} makes {target.set} {smallest:g}"
                raise ConfigError(f"{text}; it must be {wanted}")


def _smallest(
    parameter: Parameter, target: TargetEntry, cells: list[Cells], model: mujoco.MjModel
) -> Iterator[float]:
    if target.mode == "value":
        yield parameter.lower
    elif np.isfinite(_limit(target)):
        for part in cells:
            for nominal in part.of(model):
                yield float(
                    nominal * parameter.lower if target.mode == "scale" else nominal + parameter.lower
                )
