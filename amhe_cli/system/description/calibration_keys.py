"""From the calibration keys of `signals:`, and the parameters that set them, to a `SignalCalibration`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.signals import QUANTITIES
from amhe_cli.system.description.data import Channel
from amhe_cli.system.description.schema import Description, SignalEntry, TargetEntry
from amhe_cli.system.description.targets import FRAME_AXES
from amhe_cli.system.model.elements import holds_position, id_of
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.calibration import Reading, SignalCalibration
from amhe_cli.system.parameters.edits import CALIBRATION, Cells, CommandEdit, Edit, ForceEdit, ZeroEdit
from amhe_cli.system.parameters.servos import SERVOS

#: Value of a number that is not given.
_NEUTRAL = {"scale": 1.0, "bias": 0.0, "frame": 0.0}
#: Quantities in the world; all others of a body or site are in its own axes.
_WORLD = ("position", "orientation", "linear_velocity")
#: A sensor of a band remembers this many of its time constants: the rest weighs 5 %.
_CONSTANTS = 3.0

#: Signal, word, quantity ('' for all of a signal's) and column (0 where there is one number for all).
_Key = tuple[str, str, str, int]


@dataclass
class CalibrationDraft:
    """The calibration's numbers, as entries give them or parameters set them.

    Args:
        entries: The signals.
        channels: The channels in the final model, by signal and quantity.
        forces: Actuators that a signal's force or torque drives, by signal and quantity.
        commands: Actuators that a signal commands, and the units, by signal and quantity.
        model: The final model.
    """

    entries: Mapping[str, SignalEntry]
    channels: Mapping[tuple[str, str], Channel]
    forces: Mapping[tuple[str, str], Sequence[int]]
    commands: Mapping[tuple[str, str], tuple[Sequence[int], Sequence[str]]]
    model: mujoco.MjModel
    _rows: dict[_Key, int] = field(default_factory=dict)
    _own: list[float] = field(default_factory=list)
    _lowest: dict[int, float] = field(default_factory=dict)

    def read(self, file: Description) -> None:
        """Take in what the entries give; every mistake is noted in `file`."""
        for name, entry in self.entries.items():
            for word in ("scale", "bias", "frame", "band"):
                try:
                    self._read(name, entry, word)
                except ConfigError as error:
                    file.problem(("signals", name, word), str(error))

    def cells_of(self, target: TargetEntry) -> list[Cells]:
        """The numbers that a parameter's target sets.

        Raises:
            ConfigError: The signal has no such number.
        """
        name, word = str(target.signal), target.set
        if name not in self.entries:
            raise ConfigError(one_of("signal", name, self.entries))
        if word == "frame":
            if target.axis not in FRAME_AXES:
                raise ConfigError(f"target 'frame' needs axis: one of {', '.join(FRAME_AXES)}")
            return [self._number(name, "frame", "", FRAME_AXES.index(target.axis))]
        if word == "band":
            return [self._number(name, "band", "", 0)]
        quantity = self._quantity(name, word, target.quantity)
        columns = self._columns(name, quantity)
        part = target.joint or target.actuator or target.axis
        if part is not None and part not in columns:
            raise ConfigError(one_of("joint, actuator or axis of this signal", part, columns))
        chosen = columns if part is None else [part]
        return [self._number(name, word, quantity, columns.index(column)) for column in chosen]

    def unit_of(self, target: TargetEntry) -> str:
        """Unit of what a target sets."""
        if target.set == "bias":
            key = str(target.signal), self._quantity(str(target.signal), "bias", target.quantity)
            if key not in self.channels and key not in self.commands:
                return QUANTITIES[key[1]]
            units = self.channels[key].units if key in self.channels else self.commands[key][1]
            part = target.joint or target.actuator or target.axis
            if part and len(units) > 1:
                return units[self._columns(*key).index(part)]
            return units[0] if units else "-"
        if target.set == "frame":
            return "m" if target.axis in ("x", "y", "z") else "rad"
        return "Hz" if target.set == "band" else "-"

    def lowest(self, cells: Sequence[Cells], value: float) -> None:
        """Note the smallest value of numbers that a parameter sets: a band's memory follows from it."""
        for cell in cells:
            self._lowest[cell.row] = value

    def finished(self) -> tuple[SignalCalibration, list[Edit]]:
        """The calibration, and the edits of the model that it needs."""
        readings = {c.key: self._reading(n, q, c) for (n, q), c in self.channels.items()}
        used = {key: reading for key, reading in readings.items() if reading != Reading()}
        zeros = {
            id_of(self.model, "joint", self._columns(name, quantity)[column]): row
            for (name, word, quantity, column), row in self._rows.items()
            if word == "bias" and self._is_encoder(name, quantity)
        }
        beside = {joint: other for gap in gaps(self.model) for joint, other in gap.ends}
        zeros |= {beside[joint]: row for joint, row in zeros.items() if joint in beside}
        driven = {
            actuator: (
                self._row((name, "scale", quantity, column)),
                self._row((name, "bias", quantity, column)),
            )
            for (name, quantity), actuators in self.forces.items()
            if any(key[0] == name and key[2] == quantity for key in self._rows)
            for column, actuator in enumerate(actuators)
        }
        commanded = {
            self.commands[name, quantity][0][column]: row
            for (name, word, quantity, column), row in self._rows.items()
            if word == "bias" and (name, quantity) in self.commands
        }
        joints = {joint: (int(self.model.jnt_qposadr[joint]), row) for joint, row in zeros.items()}
        changes: list[Edit] = [ZeroEdit(joints)] if zeros else []
        changes += [ForceEdit(driven)] if driven else []
        changes += [CommandEdit(commanded)] if commanded else []
        return SignalCalibration(np.array(self._own), used), changes

    def _read(self, name: str, entry: SignalEntry, word: str) -> None:
        given = getattr(entry, word)
        if (word == "frame" and isinstance(given, str)) or given is None or given == {}:
            return
        if word == "frame":
            if entry.mocap is None and entry.force_on is None:
                for axis, value in enumerate(given):
                    self._number(name, "frame", "", axis, value)
        elif word == "band":
            self._number(name, "band", "", 0, given)
        elif word == "scale":
            linear = [q for q in self._calibrated(name, word) if q != "orientation"] or [word]
            each = given if isinstance(given, Mapping) else dict.fromkeys(linear, given)
            for quantity, value in each.items():
                checked = self._quantity(name, word, quantity)
                for column in range(len(self._columns(name, checked))):
                    self._number(name, "scale", checked, column, value)
        else:
            for quantity, values in given.items():
                columns = self._columns(name, self._quantity(name, word, quantity))
                each = values if isinstance(values, list) else [values] * len(columns)
                if len(each) != len(columns):
                    raise ConfigError(f"bias of {quantity} has {len(each)} numbers; it needs {len(columns)}")
                for column, value in enumerate(each):
                    self._number(name, "bias", quantity, column, value)

    def _number(self, name: str, word: str, quantity: str, column: int, value: float | None = None) -> Cells:
        """One number; when it is met first, it gets its row, and the value given or one without effect."""
        if word == "frame":
            self._check_frame(name)
        if word == "band":
            compared = [c for (n, _), c in self.channels.items() if n == name and c.compared]
            if all(channel.kind == "rotation" for channel in compared):
                raise ConfigError("band is for numbers that are compared with the model")
            if value is None and (name, word, quantity, column) not in self._rows:
                raise ConfigError("give the signal a band of its own, such as band: 100, to start from")
        if (name, quantity) in self.commands:
            _check_servo(self.model, self.commands[name, quantity][0][column])
        row = self._row((name, word, quantity, column), value)
        label = ".".join(part for part in (name, quantity) if part)
        which = f"[{column}]" if word == "frame" else ""
        if word in ("bias", "scale"):
            which = f" of {self._columns(name, quantity)[column]}"
        return Cells(CALIBRATION, row, name=f"{word}{which} in {label}", own=self._own[row])

    def _row(self, key: _Key, value: float | None = None) -> int:
        if key not in self._rows:
            self._rows[key] = len(self._own)
            self._own.append(_NEUTRAL.get(key[1], 0.0) if value is None else value)
        return self._rows[key]

    def _calibrated(self, name: str, word: str) -> list[str]:
        """Quantities of a signal that can be calibrated."""
        commands = self.commands if word == "bias" else ()
        return [q for n, q in (*self.channels, *self.forces, *commands) if n == name]

    def _quantity(self, name: str, word: str, given: str | None) -> str:
        """The quantity that is meant: the one given, or the only one."""
        quantities = [q for q in self._calibrated(name, word) if q != "orientation"]
        if not quantities:
            raise ConfigError(f"{word} is for what is compared with the model, and for force_on")
        if given is None and len(quantities) > 1:
            raise ConfigError(f"say which quantity: one of {', '.join(quantities)}")
        if given is not None and given not in quantities:
            raise ConfigError(one_of(f"quantity with a {word}", given, quantities))
        return given or quantities[0]

    def _columns(self, name: str, quantity: str) -> list[str]:
        """Names of a quantity's columns: joints, or axes."""
        entry = self.entries[name]
        if names := entry.joints or entry.joint_force or entry.actuators:
            return list(names)
        if (name, quantity) in self.forces:
            return ["x", "y", "z"]
        width = len(self.channels[name, quantity].columns)
        return ["x", "y", "z"] if width == 3 else [str(column) for column in range(width)]

    def _is_encoder(self, name: str, quantity: str) -> bool:
        return quantity == "position" and self.entries[name].joints is not None

    def _check_frame(self, name: str) -> None:
        entry = self.entries[name]
        if entry.body is None and entry.site is None:
            raise ConfigError("a parameter can set the frame of a body or site, which is compared")
        quantities = set(self._calibrated(name, "frame")) - ({"angular_velocity"} if entry.body else set())
        if quantities & set(_WORLD) and quantities - set(_WORLD):
            raise ConfigError(
                "this signal has quantities in the world and in the site's own axes: split it in two, each "
                "with a frame of its own"
            )

    def _reading(self, name: str, quantity: str, channel: Channel) -> Reading:
        rows = self._rows
        entry = self.entries[name]
        linear = channel.kind == "linear"
        own_axes = entry.body is not None and quantity == "angular_velocity"
        framed = (name, "frame", "", 0) in rows and not own_axes
        band = rows.get((name, "band", "", 0)) if linear else None
        biased = not self._is_encoder(name, quantity)

        def each(word: str) -> tuple[int, ...]:
            """Rows of a number of each column, if any column has one."""
            keys = [(name, word, quantity, i) for i in range(len(channel.columns))]
            return tuple(self._row(key) for key in keys) if any(key in rows for key in keys) else ()

        memory = 0.0 if band is None else _CONSTANTS / (2.0 * np.pi * self._lowest.get(band, self._own[band]))
        turned = entry.reaction and quantity in ("force", "torque")
        return Reading(
            scale=each("scale"),
            bias=each("bias") if biased else (),
            frame=tuple(self._row((name, "frame", "", axis)) for axis in range(6)) if framed else (),
            origin=framed and quantity == "position",
            band=band,
            memory=memory,
            sign=-1.0 if turned else 1.0,
        )


def _check_servo(model: mujoco.MjModel, row: int) -> None:
    """Refuse a zero of its command to an actuator that has none of its own."""
    name = model.actuator(row).name
    if not holds_position(model, row):
        raise ConfigError(f"actuator {name!r} is no position servo: only these have a zero of their command")
    if row in SERVOS.rows(model):
        raise ConfigError(f"the firmware of {name!r} counts from its encoder's zero: set that of its joint")
