"""From the `signals:` of a system file to the draft of how a log meets the model."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.signals import QUANTITIES
from amhe_cli.system.description import driven, measured
from amhe_cli.system.description.schema import Description, SignalEntry, SystemEntry
from amhe_cli.system.description.wiring import WiringDraft, chosen, signal_of

#: Quantity that is read from a topic that is only read, by the end of its type's name.
_CARRIED = {
    "JointState": ("position", "velocity", "effort"),
    "JointTrajectory": ("position",),
    "Odometry": measured.POSE,
    "PoseStamped": ("position", "orientation"),
    "PoseWithCovarianceStamped": ("position", "orientation"),
    "TransformStamped": ("position", "orientation"),
    "TFMessage": ("position", "orientation"),
    "TwistStamped": ("linear_velocity", "angular_velocity"),
    "Imu": ("orientation", "angular_velocity", "linear_acceleration"),
    "WrenchStamped": driven.WRENCH,
}


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


def joint_of(model: mujoco.MjModel, column: int) -> tuple[str, str]:
    """Name of the joint that a column of qpos belongs to, and the unit of its position."""
    row = int((model.jnt_qposadr == column).nonzero()[0][0])
    slides = model.jnt_type[row] == mujoco.mjtJoint.mjJNT_SLIDE
    return model.joint(row).name, "m" if slides else "rad"


def _read_only(draft: WiringDraft, name: str, entry: SignalEntry) -> None:
    usual = next((q for end, q in _CARRIED.items() if str(entry.type).endswith(f"/{end}")), ())
    quantities = tuple(entry.fields) or tuple(entry.columns) or chosen(entry, usual)
    if not quantities:
        raise ConfigError(
            "say what to read: type: PACKAGE/msg/NAME, or quantity: one of " + ", ".join(QUANTITIES)
        )
    switches = any(isinstance(one.active, dict) and name in one.active for one in draft.entries.values())
    draft.signals.append(signal_of(name, entry, quantities, is_input=switches))


def _check(entry: SignalEntry, entries: Mapping[str, SignalEntry]) -> None:
    """Refuse keys that mean nothing for this kind of signal."""
    if isinstance(entry.active, dict):
        (name, *more) = entry.active
        if more:
            raise ConfigError(f"active: one signal switches another, not {', '.join(entry.active)}")
        plain = [key for key, one in entries.items() if one.kind is None]
        if name not in plain:
            raise ConfigError(f"active: {one_of('signal that is only read', name, plain)}")
        if (entries[name].quantity or "value") != "value":
            raise ConfigError(f"active: the quantity of the signal {name!r} must be value")
    for begin, end in entry.active if isinstance(entry.active, list) else ():
        if end <= begin:
            raise ConfigError(f"active: a stretch from {begin:g} to {end:g} s ends before it begins")
    if entry.smooth is not None and entry.kind not in ("mocap", "force_on", "joint_force", None):
        raise ConfigError(
            "smooth is for what drives the model: mocap, force_on, joint_force, or their points"
        )
    if entry.at is not None and entry.force_on is None:
        raise ConfigError("at is for force_on")
    if isinstance(entry.frame, str) and entry.force_on is None:
        raise ConfigError(f"frame: {entry.frame} is for force_on; here it is [x, y, z, roll, pitch, yaw]")
    if entry.reaction and entry.force_on is None and not {"force", "torque"} & set(entry.noise):
        raise ConfigError("reaction is for forces and torques: those of force_on, a site or a sensor")


_PLANNERS = {
    "body": measured.body,
    "joints": measured.joints,
    "actuators": driven.actuators,
    "mocap": driven.mocap,
    "force_on": driven.force_on,
    "joint_force": driven.joint_force,
    "site": measured.site,
    "sensor": measured.sensor,
    None: _read_only,
}
