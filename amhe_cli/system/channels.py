"""From the `signals:` of a system file to the draft of how a log meets the model."""

from __future__ import annotations

import mujoco

from amhe_cli.core.errors import ConfigError
from amhe_cli.core.signals import QUANTITIES
from amhe_cli.system import driven, measured
from amhe_cli.system.schema import Description, SignalEntry, SystemEntry
from amhe_cli.system.wiring import WiringDraft, chosen, signal_of

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
    draft = WiringDraft(spec, model)
    for name, signal in entry.signals.items():
        try:
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
    draft.signals.append(signal_of(name, entry, quantities))


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
