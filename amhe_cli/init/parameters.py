"""Candidate parameters of a model: what is usually unknown about a robot and its surroundings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from amhe_cli.init.names import words
from amhe_cli.init.signals import Guess, free_bodies, joint_of
from amhe_cli.system.coupled import followers
from amhe_cli.system.driven import commanded
from amhe_cli.system.targets import names_of

#: More actuated joints than this share one parameter of each kind.
_OWN_PARAMETERS = 3
#: Prior sd (log scale) and range of a number that the model gives, and of one that it leaves at zero.
_KNOWN, _UNKNOWN = (0.5, 10.0), (1.0, 100.0)
#: More ends of chains than this are feet, not tools: their masses are known.
_TOOLS = 2
#: Prior sd (log scale) of the gains that a model file gives its actuators.
GAIN_SD = 0.1
#: Prior sd (log scale) of a servo's gains that nobody has measured: a factor of 4.5 either way at one sd.
_GUESSED_GAIN = 1.5
#: Delay from a command's stamp to its action [s]: real servos have 5 to 20 ms, and models leave it out.
_DELAY, _DELAY_SD, _LONGEST_DELAY = 0.01, 0.01, 0.1
#: Words in the name of a body that is carried, and the share of its link's mass that it must have.
_CARRIED, _WORTHWHILE = {"payload", "load", "tool"}, 0.05
#: Word in the name of a body that people put on a robot, and how well they know its place [m].
_PAYLOAD, _PLACE_SD = "payload", 0.01
#: Words that tell one of several parts alike.
_SIDES = {
    *("fl", "fr", "rl", "rr", "lf", "rf", "lr", "lh", "rh", "hl", "hr", "bl", "br", "l", "r"),
    *("left", "right", "front", "rear", "hind", "back"),
}
_KINDS = (
    ("damping", "dof_damping", "viscous: torque per speed"),
    ("friction_loss", "dof_frictionloss", "dry: torque against any motion"),
    ("armature", "dof_armature", "inertia of rotor and gears, seen at the joint"),
)


def guess_parameters(model: mujoco.MjModel, signals: Sequence[Guess], guessed_gains: bool) -> list[Guess]:
    """Parameters to start with.

    Args:
        model: The model.
        signals: Signals of the log; only joints that it moves and measures get parameters.
        guessed_gains: Whether `init` added the actuators, so that the servos' gains are unknown.
    """
    moved = [name for guess in signals for name in guess.entry.get("actuators", ())]
    measured = {name for guess in signals for name in guess.entry.get("joints", ())}
    measured -= followers(model).keys()  # what they do is decided by the joints that they follow
    joints = [j for j in dict.fromkeys(joint_of(model, name) for name in moved) if j and j in measured]
    joints = joints or sorted(measured)
    gains = [*_guessed_gains(model, moved)] if guessed_gains else []
    return [
        *_joint_parameters(model, joints),
        *_masses(model, joints, signals),
        *_frictions(model, signals),
        *(gains or _gain(model, moved)),
        *(_delay(model.opt.timestep) if moved else ()),
    ]


def _joint_parameters(model: mujoco.MjModel, joints: Sequence[str]) -> Iterator[Guess]:
    for own, group in _alike(model, joints).items():
        for kind, field, meaning in _KINDS:
            values = getattr(model, field)[[_dof(model, joint) for joint in group]]
            parts = _by_value(group, values)
            if len(parts) > _OWN_PARAMETERS:  # each joint has a value of its own: one factor on all
                parts = {0.0: parts.pop(0.0, []), np.nan: [n for part in parts.values() for n in part]}
            for value, names in parts.items():
                head = own if len(parts) == 1 else f"{names[0]}_" if names else ""
                if names:
                    scaled = len(parts) > 1 and value != 0.0
                    yield _joint_parameter(model, f"{head}{kind}", names, kind, meaning, value, scaled)


def _joint_parameter(
    model: mujoco.MjModel,
    name: str,
    joints: Sequence[str],
    kind: str,
    meaning: str,
    value: float,
    scaled: bool,
) -> Guess:
    """One parameter of joints with one value; a factor on it where other joints have others."""
    of = f"of joint {joints[0]}" if len(joints) == 1 else f"of {len(joints)} joints alike"
    if scaled:
        targets = [{"joint": joint, "set": kind, "mode": "scale"} for joint in joints]
        own = "the model's own values" if np.isnan(value) else f"the model's {value:g}"
        return Guess(
            f"{name}_scale", _entry(1.0, False, targets) | {"unit": "-"}, f"{meaning}, {of}; factor on {own}"
        )
    unknown = not value > 0.0
    # only the order of magnitude: damping that stops a motion in a second, friction worth 1 rad/s^2,
    # a tenth of the inertia in the rotor
    scale = 0.1 if kind == "armature" else 1.0
    inertia = float(np.median(model.dof_M0[[_dof(model, joint) for joint in joints]]))
    targets = [{"joint": joint, "set": kind} for joint in joints]
    note = "the model has none: a guess from the joint's inertia" if unknown else "from the model"
    entry = _entry(scale * inertia if unknown else value, unknown, targets)
    return Guess(name, entry, f"{meaning}, {of}; {note}")


def _dof(model: mujoco.MjModel, joint: str) -> int:
    return int(model.joint(joint).dofadr[0])


def _by_value(names: Sequence[str], values: Iterable[float]) -> dict[float, list[str]]:
    """The names that have each value, to six digits."""
    parts: dict[float, list[str]] = {}
    for name, value in zip(names, values, strict=True):
        parts.setdefault(float(f"{value:.6g}"), []).append(name)
    return parts


def _alike(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, list[str]]:
    """Joints with common parameters, by the beginning of these parameters' names.

    Hinges and slides have none in common, because their units differ.
    """
    if len(joints) <= _OWN_PARAMETERS:
        groups = {f"{joint}_": [joint] for joint in joints}
    else:
        groups = {"hinge_": list[str](), "slide_": list[str]()}
        for joint in joints:
            slides = int(model.joint(joint).type[0]) == mujoco.mjtJoint.mjJNT_SLIDE
            groups["slide_" if slides else "hinge_"].append(joint)
    groups = {name: group for name, group in groups.items() if group}
    return {"": list(joints)} if len(groups) == 1 else groups


def _masses(model: mujoco.MjModel, joints: Sequence[str], signals: Sequence[Guess]) -> Iterator[Guess]:
    """Masses of the free bodies that are measured, and of the last link of each actuated chain."""
    measured = {guess.entry.get("body") for guess in signals}
    free = [_weighty(model, body) for body in free_bodies(model) if body in measured]
    bodies = list(free)
    links = {int(model.joint(joint).bodyid[0]) for joint in joints}
    ends = sorted({_carried(model, link) for link in links if not _carries_links(model, link)})
    if len(ends) <= _TOOLS:
        bodies += [model.body(row).name for row in ends]
    for body in dict.fromkeys(name for name in bodies if name):
        mass = float(model.body(body).mass[0])
        if mass > 0.0:
            loose = "; free motion does not depend on it" if body in free else ""
            entry = _entry(mass, False, [{"body": body, "set": "mass"}], 0.3)
            why = f"of body {body}, its inertia scales with it{loose}; from the model"
            yield Guess(f"{body}_mass", entry, why)
            if loose and not _carries_links(model, model.body(body).id):
                targets = [{"body": body, "set": "inertia", "mode": "scale"}]
                why = f"factor on the inertia of body {body}, beside that of its mass; 1: as in the model"
                yield Guess(f"{body}_inertia_scale", _entry(1.0, False, targets, 0.3) | {"unit": "-"}, why)
            if _PAYLOAD in words(body):
                yield from _center_of_mass(model, body)


def _weighty(model: mujoco.MjModel, body: str) -> str:
    """A free body, or the heaviest part of it if it is an empty frame, as the root of a URDF often is."""
    row = model.body(body).id
    parts = np.flatnonzero(model.body_weldid == model.body_weldid[row])
    heaviest = int(parts[np.argmax(model.body_mass[parts])])
    empty = model.body_mass[row] < _WORTHWHILE * model.body_mass[heaviest]
    return model.body(heaviest).name if empty else body


def _center_of_mass(model: mujoco.MjModel, body: str) -> Iterator[Guess]:
    """Where a payload was put is known to a centimetre or so."""
    for axis, own in zip("xyz", model.body(body).ipos, strict=True):
        entry = {
            "nominal": _short(own),
            "bounds": [_short(own - 5.0 * _PLACE_SD), _short(own + 5.0 * _PLACE_SD)],
            "scale": "linear",
            "prior_sd": _PLACE_SD,
            "targets": [{"body": body, "set": "center_of_mass", "axis": axis}],
        }
        why = f"centre of mass of body {body} along its {axis} [m]; the place is a guess from the model"
        yield Guess(f"{body}_com_{axis}", entry, why)


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


def _carries_links(model: mujoco.MjModel, link: int) -> bool:
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
    surfaces: dict[str, tuple[int, float]] = {}  # body -> its largest priority and friction
    for geom in colliding:
        name = model.body(model.geom_bodyid[geom]).name
        own = int(model.geom_priority[geom]), float(model.geom_friction[geom, 0])
        surfaces[name] = max(surfaces.get(name, own), own)
    fixed = [name for name in surfaces if name and int(model.body_weldid[model.body(name).id]) == 0]
    if not fixed or len(fixed) == len(surfaces) or not all(surfaces):
        return
    floor = max(surfaces[name] for name in fixed)
    groups: dict[tuple[int, float], list[str]] = {}
    for name in surfaces:  # of two geoms the higher priority decides, then the larger friction
        groups.setdefault(floor if name in fixed else max(surfaces[name], floor), []).append(name)
    for (priority, nominal), names in groups.items():
        entry = _entry(nominal, False, [{"body": name, "set": "sliding_friction"} for name in names])
        if names[0] in fixed or floor not in groups:
            if len(names) > len(fixed):
                why = "friction of every contact: MuJoCo takes the larger one of both geoms, so both are set"
                yield Guess("friction", entry, why)
            continue
        if priority == floor[0]:
            entry["bounds"][0] = _short(max(entry["bounds"][0], floor[1]))
        of = f"body {names[0]}" if len(names) == 1 else f"{len(names)} bodies alike"
        why = f"friction of {of}: it decides at a contact, because it is larger or has priority"
        yield Guess(f"{_kin(names[0]) if len(names) > 1 else names[0]}_friction", entry, why)


def _pair_frictions(model: mujoco.MjModel) -> Iterator[Guess]:
    alike: dict[tuple[str, str], list[str]] = {}
    for name in names_of(model, "pair"):
        value = f"{model.pair_friction[model.pair(name).id, 0]:.6g}"
        alike.setdefault((_kin(name), value), []).append(name)
    for (kin, value), names in alike.items():
        targets = [{"pair": name, "set": "sliding_friction"} for name in names]
        many = len(names) > 1
        of = f"{len(names)} contact pairs alike" if many else "the contact pair"
        name = f"{kin if many else names[0]}_friction"
        yield Guess(name, _entry(float(value), False, targets), f"sliding friction of {of}")


def _kin(name: str) -> str:
    """A name without the words and numbers that tell one of several alike: FL_foot and RR_foot are foot."""
    bare = [word for word in words(name) if word not in _SIDES and not word.isdigit()]
    return "_".join(bare) or name


def _gain(model: mujoco.MjModel, actuators: Sequence[str]) -> list[Guess]:
    if not actuators:
        return []
    targets: list[dict[str, Any]] = [{"actuator": name, "set": "gain", "mode": "scale"} for name in actuators]
    limited = [target for target in targets if model.actuator(target["actuator"]).forcelimited[0]]
    for target in limited:
        target["carry_limit"] = True
    entry = _entry(1.0, False, targets, GAIN_SD) | {"unit": "-"}
    why = (
        "factor on all actuator gains: masses and torques are relative to it, and position control does not "
        "determine it; delete it if the gains were measured"
    )
    if limited:
        why += (
            "; carry_limit: limits of force follow it, as with a wrong torque constant; a parameter of its "
            "own with {set: force_limit} makes them unknown"
        )
    return [Guess("gain_scale", entry, why)]


def _guessed_gains(model: mujoco.MjModel, actuators: Sequence[str]) -> Iterator[Guess]:
    """Stiffness and damping of each servo; a motor's gain is 1 and no guess."""
    for name in actuators:
        row = model.actuator(name).id
        if commanded(model, row) == "effort":
            continue
        note = "a guess from the joint's inertia: put the drive's data sheet in its place"
        gains = (
            ("gain", float(model.actuator_gainprm[row, 0]), f"the servo's kp, {note}"),
            (
                "actuator_damping",
                float(-model.actuator_biasprm[row, 2]),
                f"the servo's kv, {note}; the log shows only the sum of it and the joint's damping",
            ),
        )
        gains = gains[:1] if commanded(model, row) == "velocity" else gains
        for kind, nominal, why in gains:
            entry = _entry(nominal, True, [{"actuator": name, "set": kind}], _GUESSED_GAIN)
            yield Guess(f"{name}_{'gain' if kind == 'gain' else 'kv'}", entry, why)


def _delay(step: float) -> Iterator[Guess]:
    """The delay of all commands; without it, wrong dampings and gains would explain the lag.

    It is proposed in the middle of a time step [s], because slopes by it have a kink at multiples of one.
    """
    entry = {
        "nominal": _short((np.floor(_DELAY / step + 1e-6) + 0.5) * step),
        "bounds": [0.0, _LONGEST_DELAY],
        "scale": "linear",
        "prior_sd": _DELAY_SD,
        "targets": [{"set": "command_delay"}],
    }
    why = "delay of every command [s]; a guess: real servos have 5 to 20 ms"
    yield Guess("command_delay", entry, why)


def _entry(
    nominal: float, unknown: bool, targets: list[dict[str, Any]], sd: float | None = None
) -> dict[str, Any]:
    own_sd, factor = _UNKNOWN if unknown else _KNOWN
    return {
        "nominal": _short(nominal),
        "bounds": [_short(nominal / factor), _short(nominal * factor)],
        "scale": "log",
        "prior_sd": sd or own_sd,
        "targets": targets,
    }


def _short(value: float) -> float:
    return float(f"{value:.3g}")
