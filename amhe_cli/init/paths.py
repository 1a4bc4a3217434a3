"""Where joints lie in messages of a type that is not built in, judged by the names of its fields."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

#: Quantity -> names of a field that holds it, the best first.
_FIELDS = {
    "position": ("q", "pos", "position", "angle", "qpos", "joint_position", "joint_pos"),
    "velocity": ("dq", "qd", "vel", "velocity", "speed", "qvel", "joint_velocity", "joint_vel"),
}
#: Used where the paths are not known.
_USUAL = {"position": "motorState[{}].q", "velocity": "motorState[{}].dq"}
#: Motors of Unitree's quadrupeds, in the order of their messages.
_QUADRUPED = [f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf")]


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
