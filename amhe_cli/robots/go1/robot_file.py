"""Any Go1's MJCF: its joints found by name, and given ours; only the robot itself is taken from the file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.kinematics import HIP_OFFSET, HIPS, HOME_LEG, JOINTS, LEGS, LINK, SIDE
from amhe_cli.system.model.files import compiled, read_spec

#: Words for the four legs and for the three joints of a leg, lower case and without separators.
_LEG_WORDS = {
    "FR": ("fr", "rf", "frontright", "rightfront"),
    "FL": ("fl", "lf", "frontleft", "leftfront"),
    "RR": ("rr", "rh", "br", "rearright", "hindright", "backright", "rightrear", "righthind"),
    "RL": ("rl", "lh", "hl", "bl", "rearleft", "hindleft", "backleft", "leftrear", "lefthind"),
}
_KIND_WORDS = {
    "hip": ("hip", "hipx", "hipaa", "haa", "abad", "abduction", "hipabduction", "hipabad", "hiproll", "0"),
    "thigh": ("thigh", "hipy", "hipfe", "hfe", "upper", "upperleg", "hipflexion", "hippitch", "1"),
    "calf": ("calf", "knee", "kfe", "shank", "lower", "lowerleg", "kneeflexion", "kneepitch", "2"),
}
_FILLERS = ("joint", "jnt", "motor", "link", "leg")
_MEANING = {
    "".join(words): f"{leg}_{kind}_joint"
    for leg, leg_words in _LEG_WORDS.items()
    for kind, kind_words in _KIND_WORDS.items()
    for pair in product(leg_words, kind_words)
    for words in permutations(pair)
}

#: Parts of a file that do not belong to a robot's body, or to a scene of its own.
_LEFT_OUT = (
    "actuators", "sensors", "pairs", "equalities", "tendons", "keys", "lights", "cameras", "tuples",
    "numerics", "texts",
)  # fmt: skip

#: How far a joint of a Go1 may be from where ours is [m], and the cosine between their axes.
_NEAR, _PARALLEL = 0.02, 0.98


@dataclass(frozen=True, slots=True)
class RobotFile:
    """A robot as its file has it.

    Args:
        spec: The file's spec, with its bodies.
        root: Name of the body that carries the four legs and moves freely.
        joints: Name of each of the twelve joints in the file, in our order.
    """

    spec: mujoco.MjSpec
    root: str
    joints: tuple[str, ...]


def read_robot(path: Path) -> RobotFile:
    """Find a Go1 in a model file.

    Raises:
        ConfigError: The file does not exist, MuJoCo cannot read it, or it holds no Go1; the text says what is
            wrong.
    """
    if not path.is_file():
        raise ConfigError(f"no robot model {str(path)!r}; give the MJCF of a Go1")
    spec = read_spec(path)
    joints = _joints(spec, path.name)
    root = _root(spec, joints, path.name)
    _collide_by_masks(spec)
    for kind in _LEFT_OUT:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    _check_geometry(compiled(spec.copy(), f"the robot of {path.name!r}"), root, joints, path.name)
    return RobotFile(spec, root, joints)


def _joints(spec: mujoco.MjSpec, file: str) -> tuple[str, ...]:
    found: dict[str, list[str]] = {name: [] for name in JOINTS}
    for joint in spec.joints:
        meaning = _MEANING.get(_bare(joint.name))
        if meaning is not None and joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            found[meaning].append(joint.name)
    for leg in LEGS:
        _hip_above_knee(found[f"{leg}_hip_joint"], found[f"{leg}_thigh_joint"])
    missing = [name for name in JOINTS if not found[name]]
    if missing:
        there = ", ".join(joint.name for joint in spec.joints if joint.name) or "none"
        raise ConfigError(
            f"{file}: no hinge joint {', '.join(missing)}, nor another name of it; joints: {there}"
        )
    for name in JOINTS:
        if len(found[name]) > 1:
            raise ConfigError(f"{file}: joints {' and '.join(found[name])} could both be {name}")
    return tuple(found[name][0] for name in JOINTS)


def _hip_above_knee(hips: list[str], thighs: list[str]) -> None:
    """Take a joint called abduction as our hip, and the hip after it as our thigh."""
    plain = [name for name in hips if _bare(name).endswith("hip")]
    if not thighs and len(hips) == 2 and len(plain) == 1:
        hips.remove(plain[0])
        thighs.append(plain[0])


def _bare(name: str) -> str:
    """A joint's name without namespaces, fillers and separators: 'go1/FL_hip_joint' is 'flhip'."""
    words = re.findall(r"[a-z]+|[0-9]+", name.split("/")[-1].lower().replace("go1", ""))
    return "".join(word for word in words if word not in _FILLERS)


def _root(spec: mujoco.MjSpec, joints: tuple[str, ...], file: str) -> str:
    """Name of the topmost body over the legs; it gets a name and a free joint if it has none."""
    roots = {_topmost(spec.joint(name).parent) for name in joints}
    if len(roots) != 1:
        raise ConfigError(
            f"{file}: the twelve joints belong to {len(roots)} separate bodies, not to one robot"
        )
    (name,) = roots
    root = spec.body(name)
    if not root.joints:
        root.add_freejoint()
    elif [joint.type for joint in root.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise ConfigError(f"{file}: body {name!r} must move by one free joint, or be without joints")
    return name


def _collide_by_masks(spec: mujoco.MjSpec) -> None:
    """Let geoms that a file lists in contact pairs touch other geoms too."""
    listed = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in spec.geoms:
        if geom.name in listed:
            geom.conaffinity = 1


def _topmost(body: mujoco.MjsBody) -> str:
    while body.parent.name != "world":
        body = body.parent
    if not body.name:
        body.name = "amhe_robot_root"
    return body.name


def _check_geometry(model: mujoco.MjModel, root: str, joints: tuple[str, ...], file: str) -> None:
    """Check that the joints at home are where a Go1's are, and turn as a Go1's do."""
    data = mujoco.MjData(model)
    for i, name in enumerate(joints):
        data.joint(name).qpos[0] = HOME_LEG[i % 3]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = data.body(root)
    to_root = body.xmat.reshape(3, 3).T
    for name, (anchor, axis) in zip(joints, _expected(), strict=True):
        joint = data.joint(name)
        away = np.linalg.norm(to_root @ (joint.xanchor - body.xpos) - anchor)
        if away > _NEAR:
            raise ConfigError(f"{file}: joint {name!r} is {100 * away:.0f} cm from where a Go1 has it")
        if to_root @ joint.xaxis @ axis < _PARALLEL:
            raise ConfigError(
                f"{file}: joint {name!r} does not turn about +{'xy'[int(axis[1])]} as a Go1's does"
            )


def _expected() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Anchor and axis of each joint of a Go1 at home, in the trunk's frame."""
    x, y = np.eye(3)[:2]
    knee = -LINK * np.array([np.sin(HOME_LEG[1]), 0.0, np.cos(HOME_LEG[1])])
    for hip, side in zip(HIPS, SIDE, strict=True):
        thigh = hip + HIP_OFFSET * side * y
        yield from ((hip, x), (thigh, y), (thigh + knee, y))
