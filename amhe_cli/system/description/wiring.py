"""Where a log meets the model: what is read, what is compared, what drives it.

This takes two steps, because sensors are added between them. `channels.draft_wiring` makes a `WiringDraft`
from the model as the user wrote it, and adds to its spec what the measured quantities need.
`WiringDraft.wired` then finds the addresses in the final model. Everything added is called `amhe/...`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.signals import QUANTITIES, Signal
from amhe_cli.system.description.calibration_keys import CalibrationDraft
from amhe_cli.system.description.data import Channel, Input
from amhe_cli.system.description.schema import SignalEntry
from amhe_cli.system.model.couplings import couplings
from amhe_cli.system.model.elements import control_of, id_of
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.edits import DELAYS, Cells


@dataclass(frozen=True, slots=True)
class Wiring:
    """How a log meets the model; see the same fields of `System`."""

    signals: tuple[Signal, ...]
    channels: tuple[Channel, ...]
    inputs: tuple[Input, ...]
    input_spec: int


@dataclass(frozen=True, slots=True)
class Drive:
    """A series that drives the model: which parts of which input, by number or by an actuator's name."""

    key: str
    bit: mujoco.mjtState
    parts: Sequence[int | str]
    delayed: bool = False
    frame: tuple[float, ...] = ()
    arm: tuple[str, str | None] | None = None


@dataclass
class WiringDraft:
    """Signals whose addresses in the final model are still to be found."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    entries: Mapping[str, SignalEntry]
    signals: list[Signal] = field(default_factory=list)
    state: list[Channel] = field(default_factory=list)
    sensed: list[tuple[str, str, float, str, list[str]]] = field(
        default_factory=list
    )  # key, quantity, sd, unit, sensors
    driven: list[Drive] = field(default_factory=list)
    joints_set: set[int] = field(default_factory=set)

    def wired(self, model: mujoco.MjModel) -> Wiring:
        """Addresses in the final model: the spec of the draft, compiled."""
        channels = list(self.state)
        for key, quantity, noise, unit, sensors in self.sensed:
            rows = [id_of(model, "sensor", name) for name in sensors]
            columns = [int(model.sensor_adr[r]) + i for r in rows for i in range(int(model.sensor_dim[r]))]
            channels.append(Channel(key, _kind(quantity), "sensordata", tuple(columns), noise, unit))
        spec = 0
        for drive in self.driven:
            spec |= int(drive.bit)
        inputs = []
        for drive in self.driven:
            # parts of the state stand in the order of their bits
            first = mujoco.mj_stateSize(model, spec & (int(drive.bit) - 1))
            columns = [
                control_of(model, id_of(model, "actuator", part), split_key(drive.key)[1])
                if isinstance(part, str)
                else part
                for part in drive.parts
            ]
            at = tuple(first + column for column in columns)
            inputs.append(Input(drive.key, at, drive.delayed, drive.frame, drive.arm))
        return Wiring(tuple(self.signals), tuple(channels), tuple(inputs), spec)

    def calibrated(
        self, entries: Mapping[str, SignalEntry], wiring: Wiring, model: mujoco.MjModel
    ) -> CalibrationDraft:
        """What can be calibrated: channels, and forces that drive the model."""
        channels = {split_key(channel.key): channel for channel in wiring.channels}
        forces = {
            split_key(drive.key): [id_of(model, "actuator", str(part)) for part in drive.parts]
            for drive in self.driven
            if not drive.delayed and drive.bit == mujoco.mjtState.mjSTATE_CTRL and drive.arm is None
        }
        forces = {key: rows for key, rows in forces.items() if key not in channels}  # these are compared
        return CalibrationDraft(entries, channels, forces, model)

    def commanded(self, wiring: Wiring) -> dict[str, list[Cells]]:
        """Actuator that a signal commands -> the delays of its commands; it may have several controls."""
        commands: dict[str, list[Cells]] = {}
        for drive, driving in zip(self.driven, wiring.inputs, strict=True):
            for part, at in zip(drive.parts, driving.columns, strict=True) if drive.delayed else ():
                commands.setdefault(str(part), []).append(Cells(DELAYS, at))
        return commands

    def unset_joints(self) -> list[str]:
        """Joints whose state no signal gives, neither directly nor by a joint beside them."""
        led = {c.follower for c in couplings(self.model) if c.leader in self.joints_set}
        led |= {joint for gap in gaps(self.model) for joint, other in gap.ends if other in self.joints_set}
        return [
            self.model.joint(row).name or f"number {row}"
            for row in range(self.model.njnt)
            if row not in self.joints_set | led
        ]

    def site_on(self, body: str, frame: Sequence[float] | str | None = None) -> str:
        """Name of a site in the frame of a body, or turned by a frame's roll, pitch and yaw; added once."""
        turn = np.zeros(3) if frame is None or isinstance(frame, str) else np.array(frame[3:])
        name = f"amhe/at/{body}" + (f"/{turn}" if turn.any() else "")
        if all(site.name != name for site in self.spec.sites):
            self.spec.body(body).add_site(name=name, quat=rotations.of_rpy(turn))
        return name


def split_key(key: str) -> tuple[str, str]:
    """Signal and quantity of a series' key."""
    signal, quantity = key.rsplit(".", 1)
    return signal, quantity


def signal_of(
    name: str,
    entry: SignalEntry,
    quantities: tuple[str, ...],
    names: Sequence[str] = (),
    is_input: bool = False,
) -> Signal:
    """What to read from the log for an entry of the file."""
    fields = {q: (p,) if isinstance(p, str) else tuple(p) for q, p in entry.fields.items()}
    columns = {q: tuple(map(str, c if isinstance(c, list) else [c])) for q, c in entry.columns.items()}
    return Signal(
        name,
        entry.topic,
        quantities,
        type=entry.type,
        names=tuple(names),
        child_frame=entry.child_frame,
        fields=fields,
        columns=columns,
        is_input=is_input,
        hold=entry.hold,
        offset=entry.offset,
        factors=entry.factors,
        wraps=entry.wraps,
        reversed=tuple(
            map(list(entry.joints or entry.actuators or entry.joint_force or ()).index, entry.reversed)
        ),
        smooth=entry.smooth or 0.0,
        active=tuple(entry.active) if isinstance(entry.active, list) else (),
        switch=next(iter((f"{key}.value", value) for key, value in entry.active.items()))
        if isinstance(entry.active, dict)
        else None,
    )


def unit_of(quantity: str, joints: Collection[int] = ()) -> str:
    """Unit of a body's quantity, or of joints of these types; joints of both kinds share none."""
    straight, *turned = QUANTITIES[quantity].split(" or ")
    if quantity == "orientation":
        return "rad"
    kinds = {int(kind) for kind in joints}
    if turned and len(kinds) > 1:
        return QUANTITIES[quantity]
    return turned[0] if turned and kinds == {int(mujoco.mjtJoint.mjJNT_HINGE)} else straight


def state_channel(
    key: str,
    quantity: str,
    source: str,
    columns: Iterable[int],
    entry: SignalEntry,
    unit: str,
) -> Channel:
    """Channel of a quantity that sets the state of a rollout, and is compared if the entry says so."""
    noise, compared = entry.noise.get(quantity), entry.compares(quantity)
    slope = entry.slope.get(quantity, 0.0)
    return Channel(key, _kind(quantity), source, tuple(columns), noise, unit, compared, slope)  # pyright: ignore[reportArgumentType]


def _kind(quantity: str) -> Literal["linear", "rotation"]:
    """Orientations are compared as rotations."""
    return "rotation" if quantity == "orientation" else "linear"


def names_of_log(names: list[str] | Mapping[str, str] | None) -> tuple[list[str], list[str]]:
    """Names of the elements in the model, and in the log."""
    if isinstance(names, Mapping):
        return list(names), list(names.values())
    return list(names or ()), list(names or ())


def check_noise(entry: SignalEntry, quantities: tuple[str, ...]) -> None:
    """Refuse noise of a quantity that this kind of signal does not have."""
    for quantity in entry.noise:
        if quantity not in quantities:
            raise ConfigError(one_of("quantity to compare", quantity, quantities))


def chosen(entry: SignalEntry, usual: tuple[str, ...]) -> tuple[str, ...]:
    """`quantity:` if given, else the usual ones."""
    if entry.noise:
        raise ConfigError("noise is for what is compared with the model; this signal is not")
    given = tuple([entry.quantity] if isinstance(entry.quantity, str) else entry.quantity or ())
    for quantity in given:
        if usual and quantity not in usual:
            raise ConfigError(one_of("quantity of this signal", quantity, usual))
    return given or usual


def one_quantity(entry: SignalEntry, usual: str) -> str:
    """The one quantity of a signal of plain numbers."""
    if entry.noise and entry.sensor is None and entry.joint_force is None:
        raise ConfigError("noise is for what is compared with the model; a command is not")
    given = [entry.quantity] if isinstance(entry.quantity, str) else list(entry.quantity or ())
    given = given or list(entry.fields) or list(entry.columns) or [usual]
    if len(given) > 1:
        raise ConfigError(f"one quantity drives this, not {', '.join(given)}")
    return given[0]
