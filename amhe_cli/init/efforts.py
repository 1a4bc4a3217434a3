"""A first system where the joints' torques were measured and nothing says what was commanded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.init.drives import KINDS, linear_entry, measured_joints, short
from amhe_cli.init.signals import NOISE, Guess, Topic, free_bodies, joint_of, measured_as, torque_entry
from amhe_cli.logs import read_signals
from amhe_cli.system.description.efforts import unpowered_text
from amhe_cli.system.model.elements import commanded, floats, heaviest_part, names_of

#: Dry friction, viscous friction at 1 rad/s, and a sensor's zero: sd, as a share of the torque's range.
_FRICTION, _ZERO = 0.05, 0.03
#: Sd of the numbers of a link's inertia: what a CAD file is worth.
_LINK = 0.2
#: Bounds, and sd of 1, of the last link that moves: it has all beyond it, and a tool that the model lacks.
_FAR = 4.0
#: Armature of a drive whose model has none: two sd, as a share of the largest inertia that the joint moves.
_GEARED = 0.3
#: Poses in which that is looked for.
_POSES = 30
#: Seconds of a log that show the torques' ranges.
_SECONDS = 60.0
#: A joint that moves less than this in them stands still [rad or m].
_STILL = 0.01


def effort_signal(
    model: mujoco.MjModel, topics: Sequence[Topic], guesses: Sequence[Guess], log: Path, msg_path: Path | None
) -> tuple[Guess, dict[str, float], list[str]] | None:
    """The measured torques as what is compared, each one's range, and notes; None where a motion says more.

    They say more where nothing commands the joints, all of whose torques are known: the base is fixed, and no
    body is free that might touch them. Joints that stand still are left out.
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
    names = named if isinstance(named, Mapping) else {joint: joint for joint in named}
    wanted: dict[str, tuple[str, ...]] = {}
    if "columns" in entry:
        column = dict(zip(topic.entries, topic.columns.get("position", ()), strict=False))
        logged = measured_as(states[0])
        wanted = {"effort": tuple(entry["columns"]["effort"])}
        wanted |= {"position": tuple(column[logged[joint]] for joint in names)} if column else {}
    signal = Signal(
        "torque", topic.table if wanted else topic.name, tuple(wanted) or ("position", "effort"),
        names=() if wanted else tuple(names.values()), columns=wanted,
    )  # fmt: skip
    try:
        read = read_signals(log, [signal], 0.01, LogSettings(), end=_SECONDS, msg_path=msg_path, warn=False)
    except AmheError:
        return None
    ranges = dict(zip(names, np.ptp(read["torque.effort"].values, axis=0).tolist(), strict=True))
    if not all(ranges.values()):
        return None  # a constant column measures nothing
    notes = _off(model, list(names))
    if "torque.position" in read.series:
        moved = np.ptp(read["torque.position"].values, axis=0) > _STILL
        still = [joint for joint, moves in zip(names, moved, strict=True) if not moves]
        if 0 < len(still) < len(names):
            entry, ranges = _without(entry, still), {j: r for j, r in ranges.items() if j not in still}
            notes.append(
                f"{', '.join(still)} stand{'s' * (len(still) == 1)} still: left out of joint_force, since "
                "nothing says which part of dry friction acts"
            )
    why = (
        "torques were measured, and nothing says what was commanded: match: effort compares them with those "
        "that the motion needs"
    )
    return Guess("torque", entry, why, {"effort": NOISE["effort"]}, "log"), ranges, notes


def _off(model: mujoco.MjModel, joints: Sequence[str]) -> list[str]:
    """A note of actuators that are switched off, because what they give was measured."""
    off = [actuator for actuator in names_of(model, "actuator") if joint_of(model, actuator) in joints]
    if not off:
        return []
    notes = [unpowered_text(off)]
    servos = [name for name in off if commanded(model, model.actuator(name).id) != "effort"]
    if servos:
        motors = " ".join(f'<motor name="{one}" joint="{joint_of(model, one)}"/>' for one in servos)
        notes.append(f"to drive the model by torques, write motors in place of its servos: {motors}")
    return notes


def _without(entry: Mapping[str, Any], joints: Sequence[str]) -> dict[str, Any]:
    """A signal of torques without some joints."""
    named = entry["joint_force"]
    kept = [joint for joint in named if joint not in joints]
    left = {**entry, "joint_force": {j: named[j] for j in kept} if isinstance(named, Mapping) else kept}
    if "columns" in entry:
        column = dict(zip(named, entry["columns"]["effort"], strict=True))
        left["columns"] = {"effort": [column[joint] for joint in kept]}
    return left


def _beyond(model: mujoco.MjModel, body: int, link: int) -> bool:
    """Whether a body hangs on a link, and is not it."""
    while body > link:
        body = int(model.body_parentid[body])
        if body == link:
            return True
    return False


def largest_inertias(model: mujoco.MjModel) -> FloatArray:
    """The inertia that each dof moves, where it is largest (nv,): an arm that points up turns little.

    No less than the usual one of its kind [kg m^2 or kg]: drives of a wrist are heavier than what they move.
    """
    data, found = mujoco.MjData(model), model.dof_M0.copy()
    low, high = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.pi, np.pi]).T
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    matrix, rng = np.empty((model.nv, model.nv)), np.random.default_rng(0)
    for _ in range(_POSES):
        data.qpos[model.jnt_qposadr[hinges]] = rng.uniform(low, high)[hinges]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fullM(model, data, matrix)
        found = np.maximum(found, matrix.diagonal())
    kinds = model.jnt_type[model.dof_jntid]
    usual = [np.median(found[kinds == kind]) for kind in kinds]
    return np.maximum(found, usual)


def effort_parameters(model: mujoco.MjModel, ranges: Mapping[str, float]) -> Iterator[Guess]:
    """Inertia of each link, and friction, armature and the torque sensor's zero of each joint.

    Args:
        ranges: Range of the measured torque of each joint.
    """
    links = {int(model.joint(joint).bodyid[0]) for joint in ranges}
    for link in sorted(links):
        row = heaviest_part(model, link)
        name = model.body(row).name
        if name and model.body_mass[row] > 0.0:
            known: dict[str, Any] = {"prior_sd": _LINK}
            if not any(_beyond(model, other, link) for other in links):
                known = {"bounds": [-_FAR, _FAR], "prior_sd": 1.0}
            entry = known | {"targets": [{"body": name, "set": "pseudo_inertia"}]}
            yield Guess(f"{name}_inertia", entry, f"mass, centre and inertia of {name}: ten numbers")
    largest = largest_inertias(model)
    for joint, extent in ranges.items():
        for kind, field, meaning in KINDS:
            dof = int(model.joint(joint).dofadr[0])
            size = _FRICTION * extent
            if kind == "armature":  # that of the model is not felt by a sensor behind the gear
                size = 0.5 * float(getattr(model, field)[dof] or _GEARED * largest[dof])
            entry = linear_entry(0.5 * size, (0.0, 20.0 * size), short(size), {"joint": joint, "set": kind})
            source = "model" if kind == "armature" else "guess"
            why = f"{meaning}, of joint {joint}; linear, as it may be 0"
            yield Guess(f"{joint}_{kind}", entry, why, source=source)
        target = {"signal": "torque", "set": "bias", "quantity": "effort", "joint": joint}
        entry = linear_entry(0.0, (-0.5 * extent, 0.5 * extent), short(_ZERO * extent), target)
        why = f"zero of the torque sensor of joint {joint}"
        yield Guess(f"{joint}_torque_offset", entry, why, source="guess")
