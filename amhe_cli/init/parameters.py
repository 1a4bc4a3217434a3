"""Candidate parameters of a model: what is usually unknown about a robot and its surroundings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from amhe_cli.core.arrays import IntArray
from amhe_cli.init.drives import (
    delay,
    entry_of,
    gain_scale,
    joint_parameters,
    kin,
    linear_entry,
    measured_joints,
    moved_by,
    servo_numbers,
    short,
)
from amhe_cli.init.names import words
from amhe_cli.init.signals import Guess, free_bodies, joint_of
from amhe_cli.system.model.elements import heaviest_part, names_of

#: More joints than this share the parameters of equal drives.
_OWN = 3
#: More ends of chains than this are feet, not tools: their masses are known.
_TOOLS = 2
#: Words in the name of a body that is carried.
_CARRIED = {"payload", "load", "tool"}
#: Share of the mass of its link that a body must have to count as carried.
_WORTHWHILE = 0.05
#: Word in the name of a body that people put on a robot.
_PAYLOAD = "payload"
#: How well people know the place of such a body [m].
_PLACE_SD = 0.01


def guess_parameters(
    spec: mujoco.MjSpec, model: mujoco.MjModel, signals: Sequence[Guess], guessed_gains: bool
) -> list[Guess]:
    """Parameters to start with.

    Args:
        spec: The model's source.
        signals: Signals of the log; only joints that it moves and measures get parameters.
        guessed_gains: Whether `init` added the actuators, so that the servos' gains are unknown.
    """
    moved, measured = moved_by(signals), measured_joints(model, signals)
    joints = [j for j in dict.fromkeys(joint_of(model, name) for name in moved) if j and j in measured]
    joints = joints or sorted(measured)
    numbers = "gain", "actuator_damping"
    gains = [*servo_numbers(model, moved, True, numbers)] if guessed_gains else []
    return [
        *joint_parameters(spec, model, joints, len(joints) > _OWN),
        *_masses(model, joints, signals),
        *_frictions(model, signals),
        *(gains or gain_scale(model, moved)),
        *(delay(model.opt.timestep) if moved else ()),
    ]


def guessed_masses(model: mujoco.MjModel, signals: Sequence[Guess]) -> list[Guess]:
    """The masses that a log of some joints may determine, beside what else is unknown."""
    return list(_masses(model, measured_joints(model, signals), signals))


def _masses(model: mujoco.MjModel, joints: Sequence[str], signals: Sequence[Guess]) -> Iterator[Guess]:
    """Masses of the free bodies that are measured, and of the last link of each actuated chain."""
    measured = {guess.entry.get("body") for guess in signals}
    free = [_weighty(model, body) for body in free_bodies(model) if body in measured]
    bodies = list(free)
    links = {int(model.joint(joint).bodyid[0]) for joint in joints}
    ends = sorted({_carried(model, link) for link in links if not carries_links(model, link)})
    if len(ends) <= _TOOLS:
        bodies += [model.body(row).name for row in ends]
    for body in dict.fromkeys(name for name in bodies if name):
        mass = float(model.body(body).mass[0])
        if mass > 0.0:
            loose = "; free motion does not depend on it" if body in free else ""
            entry = entry_of(mass, False, [{"body": body, "set": "mass"}], 0.3)
            why = f"of body {body}, its inertia scales with it{loose}"
            yield Guess(f"{body}_mass", entry, why)
            if loose and not carries_links(model, model.body(body).id):
                targets = [{"body": body, "set": "inertia", "mode": "scale"}]
                why = f"factor on the inertia of body {body}, beside that of its mass; 1: as in the model"
                yield Guess(f"{body}_inertia_scale", entry_of(1.0, False, targets, 0.3) | {"unit": "-"}, why)
            if _PAYLOAD in words(body):
                for axis, place in zip("xyz", model.body(body).ipos, strict=True):
                    near = (place - 5.0 * _PLACE_SD, place + 5.0 * _PLACE_SD)
                    target = {"body": body, "set": "center_of_mass", "axis": axis}
                    why = f"centre of mass of body {body} along its {axis} [m], to about a centimetre"
                    entry = linear_entry(place, near, _PLACE_SD, target)
                    yield Guess(f"{body}_com_{axis}", entry, why, source="guess")


def _weighty(model: mujoco.MjModel, body: str) -> str:
    """A free body, or the heaviest part of it if it is an empty frame, as the root of a URDF often is."""
    row = model.body(body).id
    heaviest = heaviest_part(model, row)
    empty = model.body_mass[row] < _WORTHWHILE * model.body_mass[heaviest]
    return model.body(heaviest).name if empty else body


def _carried(model: mujoco.MjModel, link: int) -> int:
    """The body that a link carries: one welded to it with such a name, else the farthest, else the link.

    Frames and other parts with almost no mass are left out.
    """
    parts = [int(row) for row in np.flatnonzero(model.body_weldid == model.body_weldid[link])]
    floor = _WORTHWHILE * float(model.body_mass[parts].max())
    parts = [row for row in parts if model.body(row).name and model.body_mass[row] > floor]
    called = [row for row in parts if _CARRIED & set(words(model.body(row).name))]
    leaves = [row for row in parts if row not in {int(model.body_parentid[other]) for other in parts}]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    away = np.linalg.norm(data.xipos - data.xpos[link], axis=1)
    return max(called or leaves or [link], key=lambda row: away[row].item())


def carries_links(model: mujoco.MjModel, link: int) -> bool:
    """Whether another joint is attached to this link."""
    weld = model.body_weldid
    parent_weld = weld[model.body_parentid]
    return bool(np.any((parent_weld == weld[link]) & (weld != weld[link])))


def _frictions(model: mujoco.MjModel, signals: Sequence[Guess]) -> Iterator[Guess]:
    """One friction for contact pairs alike; without pairs one for each kind of surface."""
    if not free_bodies(model):
        return
    if model.npair:
        yield from _pair_frictions(model)
        return
    colliding = np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0)
    owners = model.geom_bodyid[colliding]
    places = {model.body(row).name: _standing(model, colliding[owners == row]) for row in np.unique(owners)}
    surfaces = {name: rank for name, (_, rank) in places.items()}  # body -> its priority and friction
    fixed = [name for name in surfaces if name and int(model.body_weldid[model.body(name).id]) == 0]
    if not fixed or len(fixed) == len(surfaces) or not all(surfaces):
        return
    floor = max(surfaces[name] for name in fixed)
    groups: dict[tuple[int, float], list[str]] = {}
    for name in surfaces:  # of two geoms the higher priority decides, then the larger friction
        groups.setdefault(floor if name in fixed else max(surfaces[name], floor), []).append(name)
    for (priority, nominal), names in groups.items():
        geoms = {name: places[name][0] for name in names}  # "": all of a body
        at = [{"geom": geom} if geom else {"body": name} for name, geom in geoms.items()]
        entry = entry_of(nominal, False, [one | {"set": "sliding_friction"} for one in at])
        if names[0] in fixed or floor not in groups:
            if len(names) > len(fixed):
                why = "friction of every contact: MuJoCo takes the larger one of both geoms, so both are set"
                yield Guess("friction", entry, why)
            continue
        if priority == floor[0]:
            entry["bounds"][0] = short(max(entry["bounds"][0], floor[1]))
        of = f"body {names[0]}" if len(names) == 1 else f"{len(names)} bodies alike"
        why = f"friction of {of}: it decides at a contact, because it is larger or has priority"
        yield Guess(f"{kin(names[0]) if len(names) > 1 else names[0]}_friction", entry, why)


def _standing(model: mujoco.MjModel, geoms: IntArray) -> tuple[str, tuple[int, float]]:
    """Priority and friction of a body's geoms; where these differ, of the lowest one, and its name."""
    ranks = {int(row): (int(model.geom_priority[row]), float(model.geom_friction[row, 0])) for row in geoms}
    if len(set(ranks.values())) == 1 or not all(model.geom(row).name for row in ranks):
        return "", max(ranks.values())
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    turned = data.geom_xmat[geoms].reshape(-1, 3, 3)[:, 2]
    middle, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    bottoms = data.geom_xpos[geoms, 2] + (turned * middle - np.abs(turned) * half).sum(axis=1)
    lowest = int(geoms[np.argmin(bottoms)])
    return model.geom(lowest).name, ranks[lowest]


def _pair_frictions(model: mujoco.MjModel) -> Iterator[Guess]:
    alike: dict[tuple[str, str], list[str]] = {}
    for name in names_of(model, "pair"):
        value = f"{model.pair_friction[model.pair(name).id, 0]:.6g}"
        alike.setdefault((kin(name), value), []).append(name)
    for (kind, value), names in alike.items():
        targets = [{"pair": name, "set": "sliding_friction"} for name in names]
        many = len(names) > 1
        of = f"{len(names)} contact pairs alike" if many else "the contact pair"
        name = f"{kind if many else names[0]}_friction"
        yield Guess(name, entry_of(float(value), False, targets), f"sliding friction of {of}")
