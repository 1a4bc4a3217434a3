"""A first system where the joints' torques were measured and nothing says what was commanded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.errors import AmheError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.drives import KINDS, linear_entry, measured_joints, short
from amhe_cli.init.parameters import carries_links
from amhe_cli.init.signals import NOISE, Guess, Topic, free_bodies, torque_entry
from amhe_cli.logs import read_signals
from amhe_cli.system.model.couplings import floats

#: Dry friction, viscous friction at 1 rad/s, and a sensor's zero: sd, as a share of the torque's range.
_FRICTION, _ZERO = 0.05, 0.03
#: Sd of the numbers of a link's inertia: what a CAD file is worth.
_LINK = 0.2
#: Bounds of those of the last link, which may carry a tool that the model lacks; their sd is 1.
_FAR = 4.0
#: Seconds of a log that show the torques' ranges.
_SECONDS = 60.0


def effort_signal(
    model: mujoco.MjModel, topics: Sequence[Topic], guesses: Sequence[Guess], log: Path, msg_path: Path | None
) -> tuple[Guess, dict[str, float]] | None:
    """The measured torques as what is compared, and each joint's range; None where a motion says more.

    They say more where nothing commands the joints, all of whose torques are known: the base is fixed, and no
    body is free that might touch them.
    """
    states = [guess for guess in guesses if "joints" in guess.entry]
    if len(states) != 1 or any("actuators" in guess.entry for guess in guesses) or free_bodies(model):
        return None
    joints = measured_joints(model, guesses)
    entry = torque_entry(model, states[0], topics)
    if set(entry.get("joint_force", ())) != set(joints) or any(
        floats(model, model.joint(j).id) for j in joints
    ):
        return None
    topic = next(topic for topic in topics if topic.name == states[0].entry["topic"])
    named = entry["joint_force"]
    names = list(named.values()) if isinstance(named, Mapping) else list(named)
    columns = {"effort": tuple(entry["columns"]["effort"])} if "columns" in entry else {}
    signal = Signal(
        "torque", topic.table if columns else topic.name, ("effort",), names=() if columns else tuple(names),
        columns=columns,
    )  # fmt: skip
    try:
        efforts = read_signals(log, [signal], 0.01, LogSettings(), end=_SECONDS, msg_path=msg_path)
    except AmheError:
        return None
    ranges = np.ptp(efforts["torque.effort"].values, axis=0)
    if not ranges.all():
        return None  # a constant column measures nothing
    why = (
        "torques were measured, and nothing says what was commanded: match: effort compares them with those "
        "that the motion needs"
    )
    return Guess("torque", entry, why, {"effort": NOISE["effort"]}), dict(
        zip(named, map(float, ranges), strict=True)
    )


def effort_parameters(model: mujoco.MjModel, ranges: Mapping[str, float]) -> Iterator[Guess]:
    """Inertia of each link, and friction, armature and the torque sensor's zero of each joint.

    Args:
        model: The model.
        ranges: Range of the measured torque of each joint.
    """
    links = {int(model.joint(joint).bodyid[0]) for joint in ranges}
    for link in sorted(links):
        parts = np.flatnonzero(model.body_weldid == model.body_weldid[link])
        row = int(parts[np.argmax(model.body_mass[parts])])
        name = model.body(row).name
        if name and model.body_mass[row] > 0.0:
            known: dict[str, Any] = {"prior_sd": _LINK}
            if not carries_links(model, link):
                known = {"bounds": [-_FAR, _FAR], "prior_sd": 1.0}
            entry = known | {"targets": [{"body": name, "set": "pseudo_inertia"}]}
            yield Guess(f"{name}_inertia", entry, f"mass, centre and inertia of {name}: ten numbers")
    for joint, extent in ranges.items():
        for kind, field, meaning in KINDS:
            dof = int(model.joint(joint).dofadr[0])
            size = _FRICTION * extent
            if kind == "armature":  # that of the model is not felt by a sensor behind the gear
                size = 0.5 * float(getattr(model, field)[dof] or 0.1 * model.dof_M0[dof])
            entry = linear_entry(0.5 * size, (0.0, 20.0 * size), short(size), {"joint": joint, "set": kind})
            yield Guess(f"{joint}_{kind}", entry, f"{meaning}, of joint {joint}; linear, as it may be 0")
        target = {"signal": "torque", "set": "bias", "quantity": "effort", "joint": joint}
        entry = linear_entry(0.0, (-0.5 * extent, 0.5 * extent), short(_ZERO * extent), target)
        yield Guess(f"{joint}_torque_offset", entry, f"zero of the torque sensor of joint {joint}")
