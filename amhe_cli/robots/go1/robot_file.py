"""Any Go1's MJCF: its joints found by their places; only the robot itself is taken from the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.kinematics import HIP_OFFSET, HIPS, JOINTS, LINK, SIDE
from amhe_cli.system.model.files import compiled, read_spec

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
    """Find a Go1 in a model file, by where its joints are and how they turn; their names do not matter.

    Raises:
        ConfigError: The file does not exist, MuJoCo cannot read it, or it holds no Go1; the text says what is
            wrong.
    """
    if not path.is_file():
        raise ConfigError(f"no robot model {str(path)!r}; give the MJCF of a Go1")
    spec = read_spec(path)
    _collide_by_masks(spec)
    for kind in _LEFT_OUT:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for number, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint {number}"
    joints = _joints(compiled(spec.copy(), f"the robot of {path.name!r}"), path.name)
    return RobotFile(spec, _root(spec, joints[0], path.name), joints)


def _joints(model: mujoco.MjModel, file: str) -> tuple[str, ...]:
    """Names of the joints that are where a Go1 has them while all joint angles are zero."""
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    roots, counts = np.unique(model.body_rootid[model.jnt_bodyid[hinges]], return_counts=True)
    if not (counts >= len(JOINTS)).any():
        raise ConfigError(f"{file}: no body carries the twelve hinge joints of a Go1")
    root = int(roots[counts.argmax()])
    hinges = hinges[model.body_rootid[model.jnt_bodyid[hinges]] == root]
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[hinges]] = 0.0
    mujoco.mj_kinematics(model, data)
    turn = data.xmat[root].reshape(3, 3)
    places, axes = (data.xanchor[hinges] - data.xpos[root]) @ turn, data.xaxis[hinges] @ turn
    found = []
    for name, (anchor, axis) in zip(JOINTS, _expected(), strict=True):
        away = np.linalg.norm(places - anchor, axis=1)
        near = [model.joint(int(hinges[i])).name for i in np.flatnonzero(away < _NEAR)]
        nearest = int(away.argmin())
        if not near:
            other = model.joint(int(hinges[nearest])).name
            raise ConfigError(
                f"{file}: no joint where a Go1 has {name}: the nearest, {other!r}, is "
                f"{100 * away[nearest]:.0f} cm from there"
            )
        if len(near) > 1:
            raise ConfigError(f"{file}: joints {' and '.join(near)} could both be {name}")
        if axes[nearest] @ axis < _PARALLEL:
            raise ConfigError(
                f"{file}: joint {near[0]!r} does not turn about +{'xy'[int(axis[1])]} as a Go1's {name} does"
            )
        found.append(near[0])
    return tuple(found)


def _root(spec: mujoco.MjSpec, joint: str, file: str) -> str:
    """Name of the topmost body over the legs; it gets a name and a free joint if it has none."""
    root = spec.joint(joint).parent
    while root.parent.name != "world":
        root = root.parent
    root.name = root.name or "amhe_robot_root"
    if not root.joints:
        root.add_freejoint()
    elif [joint.type for joint in root.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise ConfigError(f"{file}: body {root.name!r} must move by one free joint, or be without joints")
    return root.name


def _collide_by_masks(spec: mujoco.MjSpec) -> None:
    """Let geoms that a file lists in contact pairs touch other geoms too."""
    listed = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in spec.geoms:
        if geom.name in listed:
            geom.conaffinity = 1


def _expected() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Anchor and axis of each joint of a Go1 with straight legs, in the trunk's frame."""
    x, y, z = np.eye(3)
    for hip, side in zip(HIPS, SIDE, strict=True):
        thigh = hip + HIP_OFFSET * side * y
        yield from ((hip, x), (thigh, y), (thigh - LINK * z, y))
