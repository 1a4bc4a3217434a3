"""Where a log meets the model: what is read, what is compared, what drives it.

This takes two steps, because sensors are added between them. `draft_wiring` makes a `WiringDraft`
from the model as the user wrote it, and adds to its spec what the measured quantities need.
`WiringDraft.wired` then finds the addresses in the final model. Everything added is called `amhe/...`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

from amhe_cli.core import rotations
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.signals import QUANTITIES, Signal
from amhe_cli.system.description.calibration_keys import CalibrationDraft
from amhe_cli.system.description.data import Channel, Input
from amhe_cli.system.description.schema import Description, SignalEntry, SystemEntry
from amhe_cli.system.model.elements import commanded, control_of, couplings, id_of, single_joints
from amhe_cli.system.model.gaps import gaps
from amhe_cli.system.parameters.edits import DELAYS, Cells
from amhe_cli.system.parameters.servos import SIGNALS, carrier

#: Kinds of signals that drive the model.
_DRIVING = ("actuators", "mocap", "force_on", "joint_force")
#: Quantities of a body.
_POSE = ("position", "orientation", "linear_velocity", "angular_velocity")
#: Quantity at a site -> MuJoCo sensor.
_SITE_SENSORS = {
    "position": mujoco.mjtSensor.mjSENS_FRAMEPOS,
    "orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    "linear_velocity": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    "angular_velocity": mujoco.mjtSensor.mjSENS_GYRO,  # in the site's own frame, as logs have it
    "linear_acceleration": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "force": mujoco.mjtSensor.mjSENS_FORCE,
    "torque": mujoco.mjtSensor.mjSENS_TORQUE,
}
#: Quantities of a force that acts at a site.
_WRENCH = ("force", "torque")
#: State bit of the controls.
_CTRL = mujoco.mjtState.mjSTATE_CTRL
#: Quantity of a mocap body -> its state bit.
_MOCAP = {"position": mujoco.mjtState.mjSTATE_MOCAP_POS, "orientation": mujoco.mjtState.mjSTATE_MOCAP_QUAT}
#: Quantity that is read from a topic that is only read, by the end of its type's name.
_CARRIED = {
    "JointState": ("position", "velocity", "effort"),
    "JointTrajectory": ("position",),
    "Odometry": _POSE,
    "PoseStamped": ("position", "orientation"),
    "PoseWithCovarianceStamped": ("position", "orientation"),
    "TransformStamped": ("position", "orientation"),
    "TFMessage": ("position", "orientation"),
    "TwistStamped": ("linear_velocity", "angular_velocity"),
    "Imu": ("orientation", "angular_velocity", "linear_acceleration"),
    "WrenchStamped": _WRENCH,
}


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
    units: tuple[str, ...] = ()


@dataclass
class WiringDraft:
    """Signals whose addresses in the final model are still to be found."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    entries: Mapping[str, SignalEntry]
    signals: list[Signal] = field(default_factory=list)
    state: list[Channel] = field(default_factory=list)
    sensed: list[tuple[str, str, float, tuple[str, ...], list[str]]] = field(
        default_factory=list
    )  # key, quantity, sd, units, sensors
    driven: list[Drive] = field(default_factory=list)
    joints_set: set[int] = field(default_factory=set)

    def wired(self, model: mujoco.MjModel) -> Wiring:
        """Addresses in the final model: the spec of the draft, compiled."""
        channels = list(self.state)
        for key, quantity, noise, units, sensors in self.sensed:
            rows = [id_of(model, "sensor", name) for name in sensors]
            columns = [int(model.sensor_adr[r]) + i for r in rows for i in range(int(model.sensor_dim[r]))]
            channels.append(Channel(key, _kind(quantity), "sensordata", tuple(columns), noise, units))
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
            inputs.append(Input(drive.key, at, drive.delayed, drive.frame, drive.arm, drive.units))
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
        commands = {
            split_key(drive.key): ([id_of(model, "actuator", str(part)) for part in drive.parts], drive.units)
            for drive in self.driven
            if drive.delayed
        }
        return CalibrationDraft(entries, channels, forces, commands, model)

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


def units_of(quantity: str, joints: Sequence[int] = ()) -> tuple[str, ...]:
    """Unit of a body's quantity, or of joints of these types: that of each where they differ."""
    straight, *turned = QUANTITIES[quantity].split(" or ")
    if quantity == "orientation":
        return ("rad",)
    units = [turned[0] if turned and kind == mujoco.mjtJoint.mjJNT_HINGE else straight for kind in joints]
    return tuple(units) if len(set(units)) > 1 else (*units, straight)[:1]


def state_channel(
    key: str, quantity: str, source: str, columns: Iterable[int], entry: SignalEntry, units: tuple[str, ...]
) -> Channel:
    """Channel of a quantity that sets the state of a rollout, and is compared if the entry says so."""
    noise, compared = entry.noise.get(quantity), entry.compares(quantity)
    slope = entry.slope.get(quantity, 0.0)
    return Channel(key, _kind(quantity), source, tuple(columns), noise, units, compared, slope)  # pyright: ignore[reportArgumentType]


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


def draft_wiring(
    file: Description, entry: SystemEntry, spec: mujoco.MjSpec, model: mujoco.MjModel
) -> WiringDraft:
    """Read the signals, and add what they need to the spec; every mistake is noted in `file`."""
    draft = WiringDraft(spec, model, entry.signals)
    for name, signal in entry.signals.items():
        try:
            _check(signal, entry.signals)
            _PLANNERS[signal.kind](draft, name, signal)
        except ConfigError as error:
            place = ("signals", name, signal.kind) if signal.kind else ("signals", name)
            file.problem(place, str(error))
    return draft


def _read_only(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    usual = next((q for end, q in _CARRIED.items() if str(entry.type).endswith(f"/{end}")), ())
    quantities = tuple(entry.fields) or tuple(entry.columns) or chosen(entry, usual)
    if not quantities:
        raise ConfigError(
            "say what to read: type: PACKAGE/msg/NAME, or quantity: one of " + ", ".join(QUANTITIES)
        )
    switches = any(
        isinstance(other.active, dict) and name in other.active for other in draft.entries.values()
    )
    draft.signals.append(signal_of(name, entry, quantities, is_input=switches))


def _check(entry: SignalEntry, entries: Mapping[str, SignalEntry]) -> None:
    """Refuse keys that mean nothing for this kind of signal."""
    if isinstance(entry.active, dict):
        (name, *more) = entry.active
        if more:
            raise ConfigError(f"active: one signal switches another, not {', '.join(entry.active)}")
        plain = [key for key, other in entries.items() if other.kind is None]
        if name not in plain:
            raise ConfigError(f"active: {one_of('signal that is only read', name, plain)}")
        if (entries[name].quantity or "value") != "value":
            raise ConfigError(f"active: the quantity of the signal {name!r} must be value")
    for begin, end in entry.active if isinstance(entry.active, list) else ():
        if end <= begin:
            raise ConfigError(f"active: a stretch from {begin:g} to {end:g} s ends before it begins")
    if entry.smooth is not None and entry.kind not in (*_DRIVING, None):
        raise ConfigError(f"smooth is for what drives the model: {', '.join(_DRIVING)}, or their points")
    if entry.at is not None and entry.force_on is None:
        raise ConfigError("at is for force_on")
    if isinstance(entry.frame, str) and entry.force_on is None:
        raise ConfigError(f"frame: {entry.frame} is for force_on; here it is [x, y, z, roll, pitch, yaw]")
    if entry.reaction and entry.force_on is None and not {"force", "torque"} & set(entry.noise):
        raise ConfigError("reaction is for forces and torques: those of force_on, a site or a sensor")


def _measured_body(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Pose and twist of a body: part of the state if its joint is free, else measured by sensors."""
    model, body = draft.model, str(entry.body)
    row = id_of(model, "body", body)
    if model.body_mocapid[row] >= 0:
        raise ConfigError(f"body {body!r} is a mocap body, which a signal drives: write mocap: {body}")
    joint = int(model.body_jntadr[row])
    if joint < 0 or int(model.jnt_type[joint]) != mujoco.mjtJoint.mjJNT_FREE:
        _at_site(draft, name, entry, draft.site_on(body), _POSE)
        return
    check_noise(entry, _POSE)
    signal = signal_of(name, entry, _POSE)
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    for quantity, source, first, width in (
        ("position", "qpos", position, 3),
        ("orientation", "qpos", position + 3, 4),
        ("linear_velocity", "qvel", velocity, 3),
        ("angular_velocity", "qvel", velocity + 3, 3),
    ):
        columns = range(first, first + width)
        draft.state.append(
            state_channel(signal.key(quantity), quantity, source, columns, entry, units_of(quantity))
        )
    draft.joints_set.add(joint)
    draft.signals.append(signal)


def _at_site(
    draft: WiringDraft,
    name: str,
    entry: SignalEntry,
    site: str = "",
    quantities: tuple[str, ...] = tuple(_SITE_SENSORS),
) -> None:
    """Compare motion or force at a site, that of the entry or another, with sensors that are added there."""
    if not site:
        id_of(draft.model, "site", site := str(entry.site))
    check_noise(entry, quantities)
    compared = {quantity: sd for quantity, sd in entry.noise.items() if sd and entry.compares(quantity)}
    if not compared:
        raise ConfigError(f"give noise for what is to be compared: {', '.join(quantities)}")
    signal = signal_of(name, entry, tuple(compared))
    for quantity, sd in compared.items():
        sensor = f"amhe/{name}/{quantity}"
        draft.spec.add_sensor(
            name=sensor, type=_SITE_SENSORS[quantity], objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )
        draft.sensed.append((signal.key(quantity), quantity, sd, units_of(quantity), [sensor]))
    draft.signals.append(signal)


def _measured_joints(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """State of hinge and slide joints, and the effort of their actuators."""
    check_noise(entry, ("position", "velocity", "effort"))
    names, logged = names_of_log(entry.joints)
    rows = single_joints(draft.model, names)
    kinds = [int(draft.model.jnt_type[row]) for row in rows]
    effort = entry.noise.get("effort")
    signal = signal_of(name, entry, ("position", "velocity", *(["effort"] if effort else [])), logged)
    for quantity, source, addresses in (
        ("position", "qpos", draft.model.jnt_qposadr),
        ("velocity", "qvel", draft.model.jnt_dofadr),
    ):
        columns = [int(addresses[row]) for row in rows]
        draft.state.append(
            state_channel(signal.key(quantity), quantity, source, columns, entry, units_of(quantity, kinds))
        )
    if effort:
        sensors = [f"amhe/{name}/effort/{joint}" for joint in names]
        kind = mujoco.mjtSensor.mjSENS_JOINTACTFRC
        for sensor, joint in zip(sensors, names, strict=True):
            draft.spec.add_sensor(name=sensor, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
        draft.sensed.append((signal.key("effort"), "effort", effort, units_of("effort", kinds), sensors))
    draft.joints_set.update(rows)
    draft.signals.append(signal)


def _measured_sensor(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Sensors that the model has itself."""
    quantity = one_quantity(entry, "value")
    check_noise(entry, (quantity,))
    sd = entry.noise.get(quantity)
    if sd is None:
        raise ConfigError(f"give noise: {{{quantity}: SD}}, the standard deviation of the measurement")
    sensors = [entry.sensor] if isinstance(entry.sensor, str) else list(entry.sensor or ())
    for sensor in sensors:
        id_of(draft.model, "sensor", sensor)
    signal = signal_of(name, entry, (quantity,))
    draft.sensed.append((signal.key(quantity), quantity, sd, units_of(quantity), sensors))
    draft.signals.append(signal)


def _driven_actuators(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Commands: controls of actuators, held until the next message; or the voltage of servos, or enabling."""
    names, logged = names_of_log(entry.actuators)
    rows = [id_of(draft.model, "actuator", actuator) for actuator in names]
    usual = "value" if str(entry.type).endswith("MultiArray") else commanded(draft.model, rows[0])
    quantity = one_quantity(entry, usual)
    signal = signal_of(name, entry, (quantity,), logged, is_input=True)
    for row in rows:
        if quantity in SIGNALS:  # the servo's law reads the control of an actuator that does nothing
            draft.spec.add_actuator(
                name=carrier(quantity, draft.model.actuator(row).name),
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=draft.model.joint(draft.model.actuator_trnid[row, 0]).name,
                gainprm=np.zeros(10),
            )
        else:
            control_of(draft.model, row, quantity)  # refused where there is none
    told = quantity in SIGNALS
    parts: list[int | str] = [carrier(quantity, one) if told else one for one in names]
    transmission = zip(draft.model.actuator_trntype[rows], draft.model.actuator_trnid[rows, 0], strict=True)
    kinds = [draft.model.jnt_type[at] for kind, at in transmission if kind == mujoco.mjtTrn.mjTRN_JOINT]
    known = quantity in QUANTITIES and len(kinds) == len(rows)
    units = units_of(quantity, kinds) if known else ()
    draft.driven.append(Drive(signal.key(quantity), _CTRL, parts, delayed=not told, units=units))
    draft.signals.append(signal)


def _driven_joint_force(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Motors that give known forces or torques at joints."""
    names, logged = names_of_log(entry.joint_force)
    rows = single_joints(draft.model, names)
    quantity = one_quantity(entry, "value" if str(entry.type).endswith("MultiArray") else "effort")
    check_noise(entry, (quantity,))  # of what is compared where efforts are matched
    signal = signal_of(name, entry, (quantity,), logged, is_input=True)
    motors = [f"amhe/{name}/{draft.model.joint(row).name}" for row in rows]
    for row, motor in zip(rows, motors, strict=True):
        draft.spec.add_actuator(
            name=motor,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=draft.model.joint(row).name,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,  # a bias of the log's numbers acts through it
        )
    draft.driven.append(Drive(signal.key(quantity), _CTRL, motors))
    draft.signals.append(signal)


def _driven_mocap(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Pose of a body that is moved from outside."""
    row = int(draft.model.body_mocapid[id_of(draft.model, "body", str(entry.mocap))])
    if row < 0:
        raise ConfigError(f'body {entry.mocap!r} is no mocap body; give it mocap="true" in the model')
    signal = signal_of(name, entry, chosen(entry, tuple(_MOCAP)))
    for quantity in signal.quantities:
        width = 3 if quantity == "position" else 4
        columns: list[int | str] = list(range(width * row, width * (row + 1)))
        frame = tuple(entry.frame) if isinstance(entry.frame, list) else ()
        units = ("m",) if quantity == "position" else ()
        draft.driven.append(Drive(signal.key(quantity), _MOCAP[quantity], columns, frame=frame, units=units))
    draft.signals.append(signal)


def _driven_force_on(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Six actuators that act at a site: in its own frame, or in the world's if they refer to that."""
    body = str(entry.force_on)
    id_of(draft.model, "body", body)
    moving = entry.at in draft.entries
    if entry.at is not None and not moving:
        id_of(draft.model, "site", entry.at)
    site = draft.site_on(body) if entry.at is None or moving else entry.at
    reference = {} if entry.frame == "body" else {"refsite": draft.site_on("world", entry.frame)}
    signal = signal_of(name, entry, chosen(entry, _WRENCH))
    drives: list[tuple[str, str, tuple[str, str | None] | None]] = [(q, q, None) for q in signal.quantities]
    if moving:
        drives.append(("force", "torque", _arm(draft, entry)))
    for quantity, acts_as, arm in drives:
        label = quantity if acts_as == quantity else "moment"
        actuators = [f"amhe/{name}/{label}/{axis}" for axis in "xyz"]
        for axis, actuator in enumerate(actuators):
            gear = np.zeros(6)
            gear[axis + 3 * _WRENCH.index(acts_as)] = -1.0 if entry.reaction else 1.0
            draft.spec.add_actuator(
                name=actuator,
                trntype=mujoco.mjtTrn.mjTRN_SITE,
                target=site,
                gear=gear,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,  # a bias of the log's numbers acts through it
                **reference,
            )
        draft.driven.append(Drive(signal.key(quantity), _CTRL, list(actuators), arm=arm))
    draft.signals.append(signal)


def _arm(draft: WiringDraft, entry: SignalEntry) -> tuple[str, str | None]:
    """Series of the point where a force acts, and of the origin of the body that it acts on.

    The origin is where the log has the body, not where a rollout does: their difference is the residual.
    """
    point = str(entry.at)
    if draft.entries[point].kind is not None or draft.entries[point].quantity != "position":
        raise ConfigError(f"at: the signal {point!r} must be only read, with quantity: position")
    if "force" not in chosen(entry, _WRENCH) or entry.scale is not None or entry.bias:
        raise ConfigError("at: a moving point needs the force, without scale and bias")
    if entry.frame == "body":
        return f"{point}.position", None
    if entry.frame not in (None, "world"):
        raise ConfigError("at: a moving point is in the world or in the body's frame")
    poses = [key for key, other in draft.entries.items() if other.body == entry.force_on]
    if not poses:
        raise ConfigError(f"at: a moving point needs a signal of the body too: body: {entry.force_on}")
    return f"{point}.position", f"{poses[0]}.position"


#: Kind of a signal -> what adds it to the draft.
_PLANNERS = {
    "body": _measured_body,
    "joints": _measured_joints,
    "actuators": _driven_actuators,
    "mocap": _driven_mocap,
    "force_on": _driven_force_on,
    "joint_force": _driven_joint_force,
    "site": _at_site,
    "sensor": _measured_sensor,
    None: _read_only,
}
