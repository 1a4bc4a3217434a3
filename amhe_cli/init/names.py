"""Matching the names in a log to the names in a model: of joints and topics, and of fields in a message."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence

#: Words for a kind of thing, which do not say which one it is.
KINDS = {
    "joint",
    "jnt",
    "link",
    "body",
    "motor",
    "actuator",
    "act",
    "servo",
    "frame",
    "site",
    "free",
    "freejoint",
}
#: Words in the name of a topic or column that holds commands.
COMMANDS = {
    *("cmd", "cmds", "command", "commands", "commanded", "goal", "goals", "desired", "target", "targets"),
    *("setpoint", "setpoints", "reference", "ref", "control", "controls", "ctrl", "action", "actions"),
}
#: Quantity -> names of a field that holds it, the best first.
_FIELDS = {
    "position": ("q", "pos", "position", "angle", "qpos", "joint_position", "joint_pos"),
    "velocity": ("dq", "qd", "vel", "velocity", "speed", "qvel", "joint_velocity", "joint_vel"),
}
#: Used where the paths are not known.
_USUAL = {"position": "motorState[{}].q", "velocity": "motorState[{}].dq"}
#: Motors of Unitree's quadrupeds, in the order of their messages.
_QUADRUPED = [f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")]


def words(name: str) -> list[str]:
    """Lower-case words of a name: '/leftArm/shoulder_pan-joint' has left, arm, shoulder, pan, joint."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    return [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word]


def core(name: str) -> str:
    """A name without its namespace and without the words for its kind."""
    parts = words(name.rsplit("/", 1)[-1])
    return "_".join(word for word in parts if word not in KINDS) or "_".join(parts)


def is_command(topic: str, kind: str) -> bool:
    """Whether a topic carries commands, judged by its name and type."""
    return kind.endswith("JointTrajectory") or bool(COMMANDS & set(words(topic)))


def matched(own: Mapping[str, Sequence[str]], logged: Iterable[str]) -> dict[str, str]:
    """Model name -> log name.

    Equal names first, then equal cores, then one core that ends with the other; never one log name
    twice, never a choice between two.

    Args:
        own: Model name -> names that the log may use for it (its own, its joint's, ...).
        logged: Names in the log.
    """
    free = list(dict.fromkeys(logged))
    pairs: dict[str, str] = {}
    for alike in _ALIKE:
        for name, aliases in own.items():
            if name in pairs:
                continue
            candidates = [other for other in free if any(alike(alias, other) for alias in aliases)]
            if len(candidates) == 1:
                pairs[name] = candidates[0]
                free.remove(candidates[0])
    return {name: pairs[name] for name in own if name in pairs}


def names_the_same(body: str, topic_words: Sequence[str]) -> bool:
    """Whether all words of a body's name, without those for its kind, are in the name of a topic or frame."""
    wanted = words(core(body))
    return bool(wanted) and set(wanted) <= set(topic_words)


#: When two names mean one thing, the surest first: equal, of one core, one core at the end of the other.
_ALIKE: tuple[Callable[[str, str], bool], ...] = (
    lambda a, b: a == b,
    lambda a, b: core(a) == core(b),
    lambda a, b: core(a).endswith(f"_{core(b)}") or core(b).endswith(f"_{core(a)}"),
)


def joint_paths(paths: Mapping[str, int | None], count: int) -> dict[str, str]:
    """Position and velocity -> path with `{}` for the number of the joint, such as 'motor_state[{}].q'.

    Args:
        paths: Paths of a message's numbers -> their count where the path is of an array.
        count: Number of joints.
    """
    if not paths:
        return dict(_USUAL)
    templates = {re.sub(r"\[\d+\]", "[{}]", path, count=1) for path in paths}
    templates |= {path + "[{}]" for path, size in paths.items() if size is not None}
    enough = [template for template in sorted(templates) if "{}" in template and _has(paths, template, count)]
    chosen: dict[str, str] = {}
    for quantity, names in _FIELDS.items():
        ranked = sorted(
            (names.index(field), template) for template in enough if (field := _field(template)) in names
        )
        if ranked:
            chosen[quantity] = ranked[0][1]
    return chosen


def in_motor_order(joints: Sequence[str], type_name: str) -> list[str]:
    """Joints in the order of a robot's motors, where its messages are known; else unchanged."""
    places = [[i for i, motor in enumerate(_QUADRUPED) if joint.startswith(motor)] for joint in joints]
    if "unitree" not in type_name or len(joints) != len(_QUADRUPED) or [len(p) for p in places] != [1] * 12:
        return list(joints)
    return [joint for _, joint in sorted(zip(places, joints, strict=True))]


def _has(paths: Mapping[str, int | None], template: str, count: int) -> bool:
    """Whether a message has the numbers 0 to count - 1 of a template."""
    array = paths.get(template.removesuffix("[{}]"))
    if template.endswith("[{}]") and array is not None:
        return array >= count
    return all(template.format(i) in paths for i in range(count))


def _field(template: str) -> str:
    return template.removesuffix("[{}]").split(".")[-1].lower()
