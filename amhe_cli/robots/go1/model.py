"""A Go1, a box and a floor: the planner's model and the plant, both of one robot file and one world file.

`models/go1_push` holds `go1.xml` (the robot with all its collision shapes), `world.xml` (box, floor, light)
and `scene.xml`, which includes both and adds the few contact pairs of planner's and estimator's model. The
plant takes robot and world, and pairs *every* collision shape with floor and box. All contacts with floor and
box are explicit pairs, so that each friction is one number; see docs/systems.md, "Traps". Any other Go1's
MJCF may take the robot's place: its joints are found by where they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError
from amhe_cli.robots.go1.kinematics import (
    HIP_OFFSET,
    HIPS,
    HOME,
    HOME_HEIGHT,
    JOINTS,
    LINK,
    LOWER,
    SERVOS,
    SIDE,
    TORQUE_LIMIT,
    UPPER,
)
from amhe_cli.robots.go1.state import ModelLayout
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.model.files import compiled, read_spec, resize

SYSTEM = "go1_push"
#: Name of the pair whose sliding friction is the parameter `floor_friction`.
FLOOR_PAIR = "box_floor"
FOOT_FRICTION = 0.8
BOX_FRICTION = 0.5
#: Torsional and rolling friction of a pair; they act from condim 4 and 6.
_SPIN, _ROLL = 0.005, 0.0001
_PREFIX = "robot/"
#: Position control of the joints: torque = KP (target - q) - KD dq, in addition to the joints' own damping.
KP, KD = 60.0, 1.0
#: Parts of a file that do not belong to a robot's body, or to a scene of its own.
_LEFT_OUT = (
    "actuators", "sensors", "pairs", "equalities", "tendons", "keys", "lights", "cameras", "tuples",
    "numerics", "texts",
)  # fmt: skip

#: How far a joint of a Go1 may be from where ours is [m], and the cosine between their axes.
_NEAR, _PARALLEL = 0.02, 0.98


@dataclass(frozen=True, slots=True)
class Box:
    """The box that is pushed.

    Args:
        size: Edge lengths [m] along its x, y, z.
        mass: Mass [kg], spread evenly.
        floor_friction: Friction coefficient against the floor.
        position: Initial position of its centre [m]; by default it stands on the floor.
        yaw: Initial yaw [rad].
        centre: Where its centre of mass is, beside its middle [m].
    """

    size: tuple[float, float, float] = (0.3, 0.5, 0.3)
    mass: float = 4.0
    floor_friction: float = 0.4
    position: tuple[float, float] = (0.6, 0.0)
    yaw: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


def layout(model: mujoco.MjModel) -> ModelLayout:
    """Where robot and box are in a model that this module built."""
    q, v = model.jnt_qposadr, model.jnt_dofadr
    trunk, box = model.joint("trunk").id, model.joint("box").id
    rows = [model.joint(name).id for name in JOINTS]
    servos = np.array([model.actuator(name).id for name in SERVOS])
    return ModelLayout(
        slice(q[trunk], q[trunk] + 7), slice(v[trunk], v[trunk] + 6),
        slice(q[box], q[box] + 7), slice(v[box], v[box] + 6),
        q[rows], v[rows], servos,
    )  # fmt: skip


def planner_model(box: Box = Box(), timestep: float = 0.01) -> mujoco.MjModel:
    """The planner's model: the pruned `scene.xml`, with this box and time step [s].

    Pyramidal friction and joints without dry friction halve the cost of a step. The pyramid makes a box that
    slides at 45 degrees to the axes rub 0.7 times as much; on the robot's short horizon that matters little
    (docs/notes/control.md). Above 12 ms a step the feet hop: MuJoCo lets no contact be faster than two steps.
    """
    spec = read_spec(_folder() / "scene.xml")
    spec.option.timestep = timestep
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.impratio, spec.option.iterations = 1.0, 10  # cheap solver options
    # The forehead touches no box: it made pushes too fast (docs/notes/control.md). Its pair stays, since
    # parameters are written into this model at the places of the system's.
    spec.geom("head_5").pos[0] -= 0.1
    for name in JOINTS:
        spec.joint(name).frictionloss = 0.0
    _set_box(spec, box)
    spec.pair(FLOOR_PAIR).friction[:2] = box.floor_friction
    for name in SERVOS:
        spec.actuator(name).set_to_position(kp=KP, kv=KD)
    return compiled(spec)


def plant_model(box: Box = Box(), robot: Path | None = None, timestep: float = 0.002) -> mujoco.MjModel:
    """The plant: all collision shapes of the robot against floor, box and each other.

    Args:
        box: The box, with its true parameters.
        robot: MJCF of any Go1, in place of ours. Its own actuators, sensors, floor and lights are left out;
            its joints' damping, softness on the floor and self-collisions are kept.
        timestep: Time step [s].

    Raises:
        ConfigError: The file holds no Go1.
    """
    ours = _folder() / "go1.xml"
    spec = read_spec(_folder() / "world.xml")
    option = spec.option
    option.timestep = timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0  # a foot or a box that sticks does not creep
    _set_box(spec, box)
    _add_robot(spec, ours if robot is None else robot, self_collisions=robot is None)
    if spec.geom(_PREFIX + "bumper_high") is None:
        _add_bumper(spec, read_spec(ours))
    _add_servos(spec)
    _add_pairs(spec, box)
    return compiled(spec)


def home(model: mujoco.MjModel) -> FloatArray:
    """Start state qpos (nq,): trunk over the origin, heading +x, legs at home, the box where it was put."""
    at = layout(model)
    qpos = np.array(model.qpos0)
    qpos[at.trunk] = [0.0, 0.0, HOME_HEIGHT, 1.0, 0.0, 0.0, 0.0]
    qpos[at.joints] = HOME
    return qpos


def _folder() -> Path:
    return find_system(SYSTEM)


def _set_box(spec: mujoco.MjSpec, box: Box) -> None:
    body = spec.body("box")
    body.mass = box.mass
    resize(spec.geom("box"), box.size)  # and its inertia
    body.ipos = box.centre
    body.pos = [*box.position, 0.5 * box.size[2]]
    body.quat = [np.cos(0.5 * box.yaw), 0.0, 0.0, np.sin(0.5 * box.yaw)]


def _add_robot(spec: mujoco.MjSpec, file: Path, self_collisions: bool) -> None:
    """Attach the robot of a file, and give its trunk and joints our names."""
    robot, joints = _read_robot(file)
    _take_options(robot, spec)
    root = spec.worldbody.add_frame().attach_body(_root(robot, joints[0], file.name), _PREFIX, "")
    for exclude in spec.excludes:  # MuJoCo refers to bodies by name
        for end in ("bodyname1", "bodyname2"):
            if getattr(exclude, end) == root.name:
                setattr(exclude, end, "trunk")
    root.name = root.joints[0].name = "trunk"
    for name, own in zip(JOINTS, joints, strict=True):
        spec.joint(_PREFIX + own).name = name
    for index, geom in enumerate(_robot_geoms(spec)):
        if self_collisions:
            geom.contype = 1
        if not geom.name:
            geom.name = f"{_PREFIX}{index}"


def _take_options(spec: mujoco.MjSpec, ours: mujoco.MjSpec) -> None:
    """Take over our solver options, which apply in any case; MuJoCo would warn of those that differ."""
    for name in (name for name in dir(ours.option) if not name.startswith("_")):
        setattr(spec.option, name, getattr(ours.option, name))
    for name in ("memory", "nconmax", "njmax", "nstack"):
        setattr(spec, name, getattr(ours, name))


def _robot_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    """Geoms of the robot that may touch anything; those of `world.xml` touch by explicit pairs only."""
    return [geom for geom in spec.geoms if geom.contype or geom.conaffinity]


def _add_bumper(spec: mujoco.MjSpec, ours: mujoco.MjSpec) -> None:
    """Strap our bumper to another robot's head: the tasks are defined with it."""
    for bar in ours.geoms:
        if bar.name.startswith("bumper"):
            spec.body("trunk").add_geom(
                spec.default, name=_PREFIX + bar.name, type=bar.type, fromto=bar.fromto, size=bar.size,
                mass=0.0, contype=0, conaffinity=0, rgba=[0.13, 0.14, 0.16, 1.0],
            )  # fmt: skip


def _add_servos(spec: mujoco.MjSpec) -> None:
    for i, (name, joint) in enumerate(zip(SERVOS, JOINTS, strict=True)):
        actuator = spec.add_actuator(name=name, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=KP, kv=KD)
        actuator.ctrllimited = actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.ctrlrange = [LOWER[i], UPPER[i]]
        actuator.forcerange = [-TORQUE_LIMIT[i], TORQUE_LIMIT[i]]


def _add_pairs(spec: mujoco.MjSpec, box: Box) -> None:
    _add_pair(spec, FLOOR_PAIR, spec.geom("box"), "floor", box.floor_friction)
    touching = _robot_geoms(spec)
    if not touching:
        raise ConfigError("the robot's model has no geom that collides: contype and conaffinity are all 0")
    for geom in touching:
        _stand_on(_add_pair(spec, f"{geom.name}_floor", geom, "floor", FOOT_FRICTION), geom)
    bumper = [geom for geom in spec.geoms if geom.name.startswith(f"{_PREFIX}bumper")]
    for geom in (*touching, *bumper):
        _add_pair(spec, f"{geom.name}_box", geom, "box", BOX_FRICTION)


def _add_pair(
    spec: mujoco.MjSpec, name: str, geom: mujoco.MjsGeom, other: str, friction: float
) -> mujoco.MjsPair:
    """A hard contact with this sliding friction: a robot's soft feet would sink into the box and stall."""
    return spec.add_pair(
        name=name, geomname1=geom.name, geomname2=other, condim=3,
        friction=[friction, friction, _SPIN, _ROLL, _ROLL],
    )  # fmt: skip


def _stand_on(pair: mujoco.MjsPair, geom: mujoco.MjsGeom) -> None:
    """The robot stands on the floor with its own softness, dimension and spin friction."""
    pair.solref, pair.solimp = geom.solref, geom.solimp
    if geom.condim > 3:
        pair.condim = geom.condim
        pair.friction[2:] = [geom.friction[1], geom.friction[2], geom.friction[2]]


@dataclass(frozen=True, slots=True)
class Change:
    """A change of the plant that happens once.

    Args:
        mass: New mass of the box [kg]; None: unchanged.
        floor_friction: New friction of box against floor; None: unchanged.
        at_time: Time of the change [s]; None: only the place counts.
        beyond_x: The change happens when the box's centre passes this x [m]; None: only the time counts.
    """

    mass: float | None = None
    floor_friction: float | None = None
    at_time: float | None = None
    beyond_x: float | None = None

    def due(self, time: float, box_x: float) -> bool:
        """Whether the change is due, at this time [s] and place of the box [m]."""
        late = self.at_time is not None and time >= self.at_time
        far = self.beyond_x is not None and box_x >= self.beyond_x
        return late or far

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the new numbers into the plant's model."""
        if self.mass is not None:
            box = model.body("box")
            box.inertia[:] *= self.mass / box.mass[0]
            box.mass[0] = self.mass
            # Without this the contact solver keeps scaling by the old mass. It writes into its data.
            mujoco.mj_setConst(model, mujoco.MjData(model))
        if self.floor_friction is not None:
            model.pair(FLOOR_PAIR).friction[:2] = self.floor_friction  # both directions of the floor's plane


def _read_robot(path: Path) -> tuple[mujoco.MjSpec, tuple[str, ...]]:
    """The robot of a model file, and the names of its twelve joints there, in our order.

    A Go1's joints are found by where they are and how they turn; their names do not matter.

    Raises:
        ConfigError: The file does not exist, MuJoCo cannot read it, or it holds no Go1; the text says what is
            wrong.
    """
    if not path.is_file():
        raise ConfigError(f"no robot model {str(path)!r}; give the MJCF of a Go1")
    spec = read_spec(path)
    listed = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in spec.geoms:
        if geom.name in listed:  # they touch by the file's contact pairs, which are left out
            geom.conaffinity = 1
    for kind in _LEFT_OUT:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    for number, joint in enumerate(spec.joints):
        joint.name = joint.name or f"joint {number}"
    return spec, _joints(compiled(spec.copy(), f"the robot of {path.name!r}"), path.name)


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


def _root(spec: mujoco.MjSpec, joint: str, file: str) -> mujoco.MjsBody:
    """The topmost body over the legs; it gets a name and a free joint if it has none."""
    root = spec.joint(joint).parent
    while root.parent.name != "world":
        root = root.parent
    root.name = root.name or "amhe_robot_root"
    if not root.joints:
        root.add_freejoint()
    elif [joint.type for joint in root.joints] != [mujoco.mjtJoint.mjJNT_FREE]:
        raise ConfigError(f"{file}: body {root.name!r} must move by one free joint, or be without joints")
    return root


def _expected() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Anchor and axis of each joint of a Go1 with straight legs, in the trunk's frame."""
    x, y, z = np.eye(3)
    for hip, side in zip(HIPS, SIDE, strict=True):
        thigh = hip + HIP_OFFSET * side * y
        yield from ((hip, x), (thigh, y), (thigh - LINK * z, y))
