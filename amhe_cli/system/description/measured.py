"""Signals that are compared with the model, and that give the state a rollout starts from."""

from __future__ import annotations

import mujoco

from amhe_cli.core.errors import ConfigError
from amhe_cli.system.description.schema import SignalEntry
from amhe_cli.system.description.targets import id_of
from amhe_cli.system.description.wiring import (
    WiringDraft,
    check_noise,
    names_of_log,
    one_quantity,
    signal_of,
    single_joints,
    state_channel,
    unit_of,
)

POSE = ("position", "orientation", "linear_velocity", "angular_velocity")
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


def _free_joint(model: mujoco.MjModel, body: int) -> int | None:
    """The body's free joint."""
    first = int(model.body_jntadr[body])
    return first if first >= 0 and int(model.jnt_type[first]) == mujoco.mjtJoint.mjJNT_FREE else None


def body(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Pose and twist of a body: part of the state if its joint is free, else measured by sensors."""
    model, own = draft.model, str(entry.body)
    row = id_of(model, "body", own)
    if model.body_mocapid[row] >= 0:
        raise ConfigError(f"body {own!r} is a mocap body, which a signal drives: write mocap: {own}")
    joint = _free_joint(model, row)
    if joint is None:
        _at_site(draft, name, entry, draft.site_on(own), POSE)
        return
    check_noise(entry, POSE)
    signal = signal_of(name, entry, POSE)
    position, velocity = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    for quantity, source, first, width in (
        ("position", "qpos", position, 3),
        ("orientation", "qpos", position + 3, 4),
        ("linear_velocity", "qvel", velocity, 3),
        ("angular_velocity", "qvel", velocity + 3, 3),
    ):
        columns = range(first, first + width)
        draft.state.append(
            state_channel(signal.key(quantity), quantity, source, columns, entry, unit_of(quantity))
        )
    draft.joints_set.add(joint)
    draft.signals.append(signal)


def site(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """Motion or force at a site: an IMU, a tool, a force-torque sensor."""
    id_of(draft.model, "site", str(entry.site))
    _at_site(draft, name, entry, str(entry.site), tuple(_SITE_SENSORS))


def _at_site(draft: WiringDraft, name: str, entry: SignalEntry, site: str, known: tuple[str, ...]) -> None:
    """Compare quantities at a site with sensors that are added there."""
    check_noise(entry, known)
    compared = {quantity: sd for quantity, sd in entry.noise.items() if sd and entry.compares(quantity)}
    if not compared:
        raise ConfigError(f"give noise for what is to be compared: {', '.join(known)}")
    signal = signal_of(name, entry, tuple(compared))
    for quantity, sd in compared.items():
        sensor = f"amhe/{name}/{quantity}"
        draft.spec.add_sensor(
            name=sensor, type=_SITE_SENSORS[quantity], objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site
        )
        draft.sensed.append((signal.key(quantity), quantity, sd, unit_of(quantity), [sensor]))
    draft.signals.append(signal)


def joints(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    """State of hinge and slide joints, and the effort of their actuators."""
    check_noise(entry, ("position", "velocity", "effort"))
    own, logged = names_of_log(entry.joints)
    rows = single_joints(draft.model, own)
    kinds = [int(draft.model.jnt_type[row]) for row in rows]
    effort = entry.noise.get("effort")
    signal = signal_of(name, entry, ("position", "velocity", *(["effort"] if effort else [])), logged)
    for quantity, source, addresses in (
        ("position", "qpos", draft.model.jnt_qposadr),
        ("velocity", "qvel", draft.model.jnt_dofadr),
    ):
        columns = [int(addresses[row]) for row in rows]
        draft.state.append(
            state_channel(signal.key(quantity), quantity, source, columns, entry, unit_of(quantity, kinds))
        )
    if effort:
        sensors = [f"amhe/{name}/effort/{joint}" for joint in own]
        kind = mujoco.mjtSensor.mjSENS_JOINTACTFRC
        for sensor, joint in zip(sensors, own, strict=True):
            draft.spec.add_sensor(name=sensor, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint)
        draft.sensed.append((signal.key("effort"), "effort", effort, unit_of("effort", kinds), sensors))
    draft.joints_set.update(rows)
    draft.signals.append(signal)


def sensor(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
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
    draft.sensed.append((signal.key(quantity), quantity, sd, unit_of(quantity), sensors))
    draft.signals.append(signal)
