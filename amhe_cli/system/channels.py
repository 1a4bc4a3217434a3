"""From the `signals:` of a system file to what is read, what is compared and what drives the model.

Two steps, because sensors are added between them: `plan` looks at the model as the user wrote it and
adds to its spec what the measured quantities need; `Plan.wired` finds the addresses in the final model.
Everything added is called `amhe/...`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.signals import QUANTITIES, Signal
from amhe_cli.system.schema import SignalEntry, SystemEntry
from amhe_cli.system.system import Channel, Input
from amhe_cli.system.targets import id_of
from amhe_cli.system.yaml_file import YamlFile

_POSE = ("position", "orientation", "linear_velocity", "angular_velocity")
_WRENCH = ("force", "torque")
_SITE_SENSORS = {
    "position": mujoco.mjtSensor.mjSENS_FRAMEPOS,
    "orientation": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    "linear_velocity": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    "angular_velocity": mujoco.mjtSensor.mjSENS_GYRO,  # in the site's own frame, as logs have it
    "linear_acceleration": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "force": mujoco.mjtSensor.mjSENS_FORCE,
    "torque": mujoco.mjtSensor.mjSENS_TORQUE,
}
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_JOINT_FORCE = mujoco.mjtState.mjSTATE_QFRC_APPLIED
_MOCAP = {"position": mujoco.mjtState.mjSTATE_MOCAP_POS, "orientation": mujoco.mjtState.mjSTATE_MOCAP_QUAT}
#: What a topic that is only read is asked for, by the end of its type's name.
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


@dataclass
class Plan:
    """Signals whose addresses in the final model are still to be found."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel
    signals: list[Signal] = field(default_factory=list)
    state: list[Channel] = field(default_factory=list)
    sensed: list[tuple[str, str, float, list[str]]] = field(default_factory=list)  # key, quantity, sd, sensors
    driven: list[tuple[str, mujoco.mjtState, list[int | str], bool]] = field(default_factory=list)
    joints_set: set[int] = field(default_factory=set)

    def wired(self, model: mujoco.MjModel) -> Wiring:
        """Addresses in the final model: the plan's spec, compiled."""
        channels = list(self.state)
        for key, quantity, noise, sensors in self.sensed:
            rows = [id_of(model, "sensor", name) for name in sensors]
            columns = [int(model.sensor_adr[r]) + i for r in rows for i in range(int(model.sensor_dim[r]))]
            channels.append(_channel(key, quantity, "sensordata", columns, noise))
        spec = 0
        for _, bit, _, _ in self.driven:
            spec |= int(bit)
        inputs = []
        for key, bit, parts, delayed in self.driven:
            first = mujoco.mj_stateSize(model, spec & (int(bit) - 1))  # parts stand in the order of their bits
            columns = [
                int(model.actuator_ctrladr[id_of(model, "actuator", part)]) if isinstance(part, str) else part
                for part in parts
            ]
            inputs.append(Input(key, tuple(first + column for column in columns), delayed))
        return Wiring(tuple(self.signals), tuple(channels), tuple(inputs), spec)

    def unset_joints(self) -> list[str]:
        """Joints whose state no signal gives."""
        return [
            self.model.joint(row).name or f"number {row}"
            for row in range(self.model.njnt)
            if row not in self.joints_set
        ]


def plan(file: YamlFile, entry: SystemEntry, spec: mujoco.MjSpec, model: mujoco.MjModel) -> Plan:
    """Read the signals, and add what they need to the spec; every mistake is noted in `file`."""
    made = Plan(spec, model)
    for name, signal in entry.signals.items():
        try:
            _PLANNERS[signal.kind](made, name, signal)
        except ConfigError as error:
            place = ("signals", name, signal.kind) if signal.kind else ("signals", name)
            file.problem(place, str(error))
    return made


def _free_joint(model: mujoco.MjModel, body: int) -> int | None:
    """The body's free joint."""
    first = int(model.body_jntadr[body])
    return first if first >= 0 and model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE else None


def _body(made: Plan, name: str, entry: SignalEntry) -> None:
    model, body_name = made.model, str(entry.body)
    body = id_of(model, "body", body_name)
    if model.body_mocapid[body] >= 0:
        raise ConfigError(f"body {body_name!r} is a mocap body, which a signal drives: write mocap: {body_name}")
    joint = _free_joint(model, body)
    if joint is None:
        _at_site(made, name, entry, _site_on(made, body_name), _POSE)
        return
    _known(entry, _POSE)
    signal = _signal(name, entry, _POSE)
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    for quantity, source, first, width in (
        ("position", "qpos", position, 3),
        ("orientation", "qpos", position + 3, 4),
        ("linear_velocity", "qvel", velocity, 3),
        ("angular_velocity", "qvel", velocity + 3, 3),
    ):
        columns = range(first, first + width)
        made.state.append(_channel(signal.key(quantity), quantity, source, columns, entry.noise.get(quantity)))
    made.joints_set.add(joint)
    made.signals.append(signal)


def _site(made: Plan, name: str, entry: SignalEntry) -> None:
    id_of(made.model, "site", str(entry.site))
    _at_site(made, name, entry, str(entry.site), tuple(_SITE_SENSORS))


def _at_site(made: Plan, name: str, entry: SignalEntry, site: str, known: tuple[str, ...]) -> None:
    """Compare quantities at a site with sensors that are added there."""
    _known(entry, known)
    compared = {quantity: sd for quantity, sd in entry.noise.items() if sd is not None}
    if not compared:
        raise ConfigError(f"give noise for what is to be compared: {', '.join(known)}")
    signal = _signal(name, entry, tuple(compared))
    for quantity, sd in compared.items():
        sensor = f"amhe/{name}/{quantity}"
        made.spec.add_sensor(
            name=sensor, type=_SITE_SENSORS[quantity], objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )
        made.sensed.append((signal.key(quantity), quantity, sd, [sensor]))
    made.signals.append(signal)


def _site_on(made: Plan, body: str) -> str:
    """A site in the frame of a body, added once."""
    name = f"amhe/at/{body}"
    if all(site.name != name for site in made.spec.sites):
        made.spec.body(body).add_site(name=name)
    return name


def _single_joints(model: mujoco.MjModel, names: Iterable[str]) -> list[int]:
    """Rows of hinge and slide joints."""
    rows = [id_of(model, "joint", name) for name in names]
    for row in rows:
        if model.jnt_type[row] in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            body = model.body(model.jnt_bodyid[row]).name
            raise ConfigError(
                f"joint {model.joint(row).name!r} has no single position; only hinge and slide joints do. "
                f"Measure its body instead: body: {body}"
            )
    return rows


def _joints(made: Plan, name: str, entry: SignalEntry) -> None:
    _known(entry, ("position", "velocity", "effort"))
    own, logged = _names(entry.joints)
    rows = _single_joints(made.model, own)
    effort = entry.noise.get("effort")
    signal = _signal(name, entry, ("position", "velocity", *(["effort"] if effort else [])), logged)
    for quantity, source, addresses in (
        ("position", "qpos", made.model.jnt_qposadr),
        ("velocity", "qvel", made.model.jnt_dofadr),
    ):
        columns = [int(addresses[row]) for row in rows]
        made.state.append(_channel(signal.key(quantity), quantity, source, columns, entry.noise.get(quantity)))
    if effort:
        sensors = [f"amhe/{name}/effort/{joint}" for joint in own]
        kind = mujoco.mjtSensor.mjSENS_JOINTACTFRC
        for sensor, joint in zip(sensors, own, strict=True):
            made.spec.add_sensor(name=sensor, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
        made.sensed.append((signal.key("effort"), "effort", effort, sensors))
    made.joints_set.update(rows)
    made.signals.append(signal)


def _sensor(made: Plan, name: str, entry: SignalEntry) -> None:
    quantity = _one_quantity(entry, "value")
    _known(entry, (quantity,))
    sd = entry.noise.get(quantity)
    if sd is None:
        raise ConfigError(f"give noise: {{{quantity}: SD}}, the standard deviation of the measurement")
    sensors = [entry.sensor] if isinstance(entry.sensor, str) else list(entry.sensor or ())
    for sensor in sensors:
        id_of(made.model, "sensor", sensor)
    signal = _signal(name, entry, (quantity,))
    made.sensed.append((signal.key(quantity), quantity, sd, sensors))
    made.signals.append(signal)


def _actuators(made: Plan, name: str, entry: SignalEntry) -> None:
    own, logged = _names(entry.actuators)
    rows = [id_of(made.model, "actuator", actuator) for actuator in own]
    for row in rows:
        if made.model.actuator_ctrlnum[row] != 1:
            raise ConfigError(f"actuator {made.model.actuator(row).name!r} takes several controls, not one")
    usual = "value" if str(entry.type).endswith("MultiArray") else _commanded(made.model, rows[0])
    quantity = _one_quantity(entry, usual)
    signal = _signal(name, entry, (quantity,), logged, is_input=True)
    made.driven.append((signal.key(quantity), _CTRL, list(own), True))
    made.signals.append(signal)


def _commanded(model: mujoco.MjModel, row: int) -> str:
    """What an actuator's control is: a servo's target or a motor's effort."""
    bias = model.actuator_biasprm[row]
    if model.actuator_biastype[row] == mujoco.mjtBias.mjBIAS_AFFINE:
        return "position" if bias[1] else "velocity"
    return "effort"


def _joint_force(made: Plan, name: str, entry: SignalEntry) -> None:
    own, logged = _names(entry.joint_force)
    rows = _single_joints(made.model, own)
    quantity = _one_quantity(entry, "value" if str(entry.type).endswith("MultiArray") else "effort")
    signal = _signal(name, entry, (quantity,), logged, is_input=True)
    columns: list[int | str] = [int(made.model.jnt_dofadr[row]) for row in rows]
    made.driven.append((signal.key(quantity), _JOINT_FORCE, columns, False))
    made.signals.append(signal)


def _mocap(made: Plan, name: str, entry: SignalEntry) -> None:
    row = int(made.model.body_mocapid[id_of(made.model, "body", str(entry.mocap))])
    if row < 0:
        raise ConfigError(f'body {entry.mocap!r} is no mocap body; give it mocap="true" in the model')
    signal = _signal(name, entry, _chosen(entry, tuple(_MOCAP)))
    for quantity in signal.quantities:
        width = 3 if quantity == "position" else 4
        columns: list[int | str] = list(range(width * row, width * (row + 1)))
        made.driven.append((signal.key(quantity), _MOCAP[quantity], columns, False))
    made.signals.append(signal)


def _force_on(made: Plan, name: str, entry: SignalEntry) -> None:
    """Six actuators that act at a site: in its own frame, or in the world's if they refer to that."""
    body = str(entry.force_on)
    id_of(made.model, "body", body)
    if entry.at is not None:
        id_of(made.model, "site", entry.at)
    site = entry.at or _site_on(made, body)
    reference = {"refsite": _site_on(made, "world")} if entry.frame == "world" else {}
    signal = _signal(name, entry, _chosen(entry, _WRENCH))
    for quantity in signal.quantities:
        actuators = [f"amhe/{name}/{quantity}/{axis}" for axis in "xyz"]
        for axis, actuator in enumerate(actuators):
            gear = np.zeros(6)
            gear[axis + 3 * _WRENCH.index(quantity)] = -1.0 if entry.reaction else 1.0
            made.spec.add_actuator(
                name=actuator, trntype=mujoco.mjtTrn.mjTRN_SITE, target=site, gear=gear, **reference
            )
        made.driven.append((signal.key(quantity), _CTRL, list(actuators), False))
    made.signals.append(signal)


def _read_only(made: Plan, name: str, entry: SignalEntry) -> None:
    usual = next((q for end, q in _CARRIED.items() if str(entry.type).endswith(f"/{end}")), ())
    quantities = tuple(entry.fields) or _chosen(entry, usual)
    if not quantities:
        raise ConfigError("say what to read: type: PACKAGE/msg/NAME, or quantity: one of " + ", ".join(QUANTITIES))
    made.signals.append(_signal(name, entry, quantities))


_PLANNERS = {
    "body": _body,
    "joints": _joints,
    "actuators": _actuators,
    "mocap": _mocap,
    "force_on": _force_on,
    "joint_force": _joint_force,
    "site": _site,
    "sensor": _sensor,
    None: _read_only,
}


def _signal(
    name: str, entry: SignalEntry, quantities: tuple[str, ...], names: Sequence[str] = (), is_input: bool = False
) -> Signal:
    fields = {q: (p,) if isinstance(p, str) else tuple(p) for q, p in entry.fields.items()}
    return Signal(
        name,
        entry.topic,
        quantities,
        type=entry.type,
        names=tuple(names),
        child_frame=entry.child_frame,
        fields=fields,
        is_input=is_input,
        offset=entry.offset,
    )


def _channel(key: str, quantity: str, source: str, columns: Iterable[int], noise: float | None) -> Channel:
    kind = "rotation" if quantity == "orientation" else "linear"
    unit = "rad" if kind == "rotation" else QUANTITIES[quantity]
    return Channel(key, kind, source, tuple(columns), noise, unit)  # pyright: ignore[reportArgumentType]


def _names(names: list[str] | Mapping[str, str] | None) -> tuple[list[str], list[str]]:
    """The model's names and the log's."""
    if isinstance(names, Mapping):
        return list(names), list(names.values())
    return list(names or ()), list(names or ())


def _known(entry: SignalEntry, quantities: tuple[str, ...]) -> None:
    """Refuse noise of a quantity that this kind of signal does not have."""
    for quantity in entry.noise:
        if quantity not in quantities:
            raise ConfigError(one_of("quantity to compare", quantity, quantities))


def _chosen(entry: SignalEntry, usual: tuple[str, ...]) -> tuple[str, ...]:
    """`quantity:` if given, else the usual ones."""
    if entry.noise:
        raise ConfigError("noise is for what is compared with the model; this signal is not")
    given = tuple([entry.quantity] if isinstance(entry.quantity, str) else entry.quantity or ())
    for quantity in given:
        if usual and quantity not in usual:
            raise ConfigError(one_of("quantity of this signal", quantity, usual))
    return given or usual


def _one_quantity(entry: SignalEntry, usual: str) -> str:
    """The one quantity of a signal of plain numbers."""
    if entry.noise and entry.sensor is None:
        raise ConfigError("noise is for what is compared with the model; a command is not")
    given = [entry.quantity] if isinstance(entry.quantity, str) else list(entry.quantity or ())
    given = given or list(entry.fields) or [usual]
    if len(given) > 1:
        raise ConfigError(f"one quantity drives this, not {', '.join(given)}")
    return given[0]
