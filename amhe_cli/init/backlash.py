"""Backlash (`amhe init --backlash`): a gap of unknown width between the drive and the link of joints."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

import mujoco

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.init.drives import KINDS, measured_joints
from amhe_cli.init.signals import Guess, joint_of
from amhe_cli.system.model.elements import names_of
from amhe_cli.system.model.gaps import add_gaps

#: Width of a hinge's gap before a log is read, and its bounds [rad].
_HINGE = (0.01, 0.0002, 0.1)
#: Width of a slide's gap before a log is read, and its bounds [m].
_SLIDE = (0.0005, 0.00001, 0.01)
#: Prior sd of the logarithm of a gap's width.
_SD = 1.0


def backlash_parameters(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    signals: Sequence[Guess],
    parameters: Sequence[Guess],
    wanted: Sequence[str],
) -> list[Guess]:
    """Give joints a gap, and move what `parameters` say of their drives to the drives' joints.

    Args:
        spec: The model's source, which is changed.
        model: The model as it was.
        signals: Signals of the log; only joints that it measures and actuators move can have a gap.
        parameters: Their targets are changed.
        wanted: Joints, by names or patterns.

    Returns:
        A parameter for the width of each gap.

    Raises:
        ConfigError: No such joint is measured and moved by an actuator.
    """
    moved = {joint_of(model, actuator) for actuator in names_of(model, "actuator")}
    joints = [joint for joint in measured_joints(model, signals) if joint in moved]
    for pattern in wanted:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ConfigError(f"`backlash`: {one_of('joint that is measured and driven', pattern, joints)}")
    chosen = [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in wanted)]
    sizes = {
        joint: _SLIDE if int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE else _HINGE
        for joint in chosen
    }
    drives = add_gaps(spec, {joint: width for joint, (width, _, _) in sizes.items()})
    kinds = {kind for kind, _, _ in KINDS}
    for guess in parameters:
        for target in guess.entry["targets"]:
            if target["set"] in kinds and target.get("joint") in drives:
                target["joint"] = drives[target["joint"]]
    return [
        Guess(
            f"{joint}_backlash",
            {
                "nominal": width,
                "bounds": [lower, upper],
                "scale": "log",
                "prior_sd": _SD,
                "targets": [{"joint": joint, "set": "backlash"}],
            },
            f"free motion between joint {joint} and its drive; a guess. The log is taken to measure the "
            f"link: if the encoder is on the motor, write joints: {{{drives[joint]}: {joint}}}",
        )
        for joint, (width, lower, upper) in sizes.items()
    ]
