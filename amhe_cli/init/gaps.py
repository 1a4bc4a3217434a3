"""Gaps of unknown width (`init --backlash`), or springs (`--elastic`), between drives and links."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.init.drives import KINDS, entry_of, measured_joints
from amhe_cli.init.signals import Guess, joint_of
from amhe_cli.system.model.elements import names_of
from amhe_cli.system.model.gaps import add_gaps

#: Width of a hinge's gap before a log is read, and its bounds [rad].
_HINGE = (0.01, 0.0002, 0.1)
#: Width of a slide's gap before a log is read, and its bounds [m].
_SLIDE = (0.0005, 0.00001, 0.01)
#: Frequency of a link on its locked drive [Hz]: arms with harmonic drives have 5 to 20.
_HERTZ = 10.0
#: Prior sd of the logarithm of a gap's width, and of a stiffness.
_SD = 1.0


def gap_parameters(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    signals: Sequence[Guess],
    parameters: Sequence[Guess],
    wanted: Sequence[str],
    elastic: bool = False,
) -> list[Guess]:
    """Give joints a gap or an elastic drive, and move what `parameters` say of their drives to these.

    Args:
        spec: The model's source, which is changed.
        model: The model as it was.
        signals: Signals of the log; only joints that it measures and actuators move can have one.
        parameters: Their targets are changed.
        wanted: Joints, by names or patterns.
        elastic: Springs, not gaps.

    Returns:
        A parameter for the width of each gap, or the stiffness of each drive.

    Raises:
        ConfigError: No such joint is measured and moved by an actuator.
    """
    word = "elastic" if elastic else "backlash"
    moved = {joint_of(model, actuator) for actuator in names_of(model, "actuator")}
    joints = [joint for joint in measured_joints(model, signals) if joint in moved]
    for pattern in wanted:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ConfigError(f"`{word}`: {one_of('joint that is measured and driven', pattern, joints)}")
    chosen = [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in wanted)]
    entries = {joint: _elastic(model, joint) if elastic else _gap(model, joint) for joint in chosen}
    drives = add_gaps(spec, {joint: entry["nominal"] for joint, entry in entries.items()}, elastic)
    kinds = {kind for kind, _, _ in KINDS}
    for guess in parameters:
        for target in guess.entry["targets"]:
            if target["set"] in kinds and target.get("joint") in drives:
                target["joint"] = drives[target["joint"]]
    what = "stiffness between" if elastic else "free motion between"
    return [
        Guess(
            f"{joint}_{'drive_stiffness' if elastic else 'backlash'}",
            entry,
            f"{what} joint {joint} and its drive. The log is taken to measure the link: if the "
            f"encoder is on the motor, write joints: {{{drives[joint]}: {joint}}}",
            source="guess",
        )
        for joint, entry in entries.items()
    ]


def _gap(model: mujoco.MjModel, joint: str) -> dict[str, Any]:
    slides = int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
    width, lower, upper = _SLIDE if slides else _HINGE
    entry = entry_of(width, True, [{"joint": joint, "set": "backlash"}], _SD)
    return entry | {"bounds": [lower, upper]}


def _elastic(model: mujoco.MjModel, joint: str) -> dict[str, Any]:
    inertia = float(model.dof_M0[model.joint(joint).dofadr[0]])
    stiffness = (2.0 * np.pi * _HERTZ) ** 2 * inertia
    return entry_of(stiffness, True, [{"joint": joint, "set": "drive_stiffness"}], _SD)
