"""What is drawn of a model: its visible geoms, and where its bodies are at given states."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.states import contact_forces
from amhe_cli.system.model.elements import couplings
from amhe_cli.system.system import System
from amhe_cli.view.shapes import Shape, boxed, shape_of

#: Groups of geoms that are shown, as in MuJoCo's own viewers; the others hold collision shapes.
_SHOWN = (0, 1, 2)
#: Colour of what has none.
_PLAIN = (0.45, 0.5, 0.58, 1.0)
#: Triangles of all meshes of a scene together.
_TRIANGLES = 24_000


@dataclass(frozen=True, slots=True, eq=False)
class Geom:
    """One geom.

    Args:
        body: Row of its body among the scene's bodies; -1: it never moves.
        shape: Its triangles, in the geom's own frame.
        pose: Position and quaternion in the frame of the body, or of the world; shape (7,).
        color: Red, green, blue, opacity; each from 0 to 1.
        floor: It is a plane.
    """

    body: int
    shape: Shape
    pose: FloatArray
    color: tuple[float, float, float, float]
    floor: bool


@dataclass(frozen=True, eq=False)
class Scene:
    """The visible geoms of a system's model.

    Args:
        bodies: Rows of the moving bodies in the model.
    """

    system: System
    bodies: tuple[int, ...]
    geoms: tuple[Geom, ...]

    @property
    def names(self) -> list[str]:
        """Names of the bodies."""
        return [self.system.model.body(row).name or f"body {row}" for row in self.bodies]

    def poses(self, qpos: FloatArray, inputs: FloatArray | None = None) -> FloatArray:
        """Positions [m] and quaternions of the b bodies, shape (n, b, 7).

        Args:
            qpos: States, shape (n, nq).
            inputs: Inputs there, shape (n, nu): they may move mocap bodies. None: no such body moves.
        """
        model, data, rows = self.system.model, self._data, np.array(self.bodies, dtype=int)
        found = np.empty((len(qpos), len(rows), 7))
        for i, row in enumerate(qpos):
            if inputs is not None:
                mujoco.mj_setState(model, data, np.ascontiguousarray(inputs[i]), self.system.input_spec)
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            found[i, :, :3], found[i, :, 3:] = data.xpos.take(rows, axis=0), data.xquat.take(rows, axis=0)
        return found

    def forces(
        self, model: mujoco.MjModel, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray
    ) -> FloatArray:
        """Forces between touching bodies in n states, shape (n, m, 6); NaN where fewer than m pairs touch.

        Args:
            model: The scene's model under some parameters.
            qpos, qvel, inputs: States, shape (n, nq) and (n, nv), and inputs there, shape (n, nu).
        """
        data, rows = mujoco.MjData(model), []
        for state, velocity, driven in zip(qpos, qvel, inputs, strict=True):
            mujoco.mj_setState(model, data, np.ascontiguousarray(driven), self.system.input_spec)
            data.qpos[:], data.qvel[:] = state, velocity
            mujoco.mj_forward(model, data)
            rows.append(contact_forces(model, data))
        found = np.full((len(rows), max(map(len, rows)), 6), np.nan)
        for row, forces in zip(found, rows, strict=True):
            row[: len(forces)] = forces
        return found

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self.system.model)

    @cached_property
    def unmeasured(self) -> list[int]:
        """Rows of the scene's bodies whose place no signal gives: they stay at home."""
        model, known = self.system.model, _measured(self.system)
        missing = set()
        for body in range(1, model.nbody):  # parents come first
            joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            own = any(int(model.jnt_qposadr[joint]) not in known for joint in joints)
            if own or int(model.body_parentid[body]) in missing:
                missing.add(body)
        return [i for i, body in enumerate(self.bodies) if body in missing]


def scene_of(system: System, more: Sequence[Geom] = (), most: int = _TRIANGLES) -> Scene:
    """The scene of a system; shapes that no group shows stand in where nothing else would be seen.

    Args:
        more: Geoms that do not move, drawn beside the model's own.
        most: Triangles of all meshes together, at most about so many.
    """
    model = system.model
    moving = [body for body in range(1, model.nbody) if _moves(model, body)]
    shown = [g for g in range(model.ngeom) if model.geom_group[g] in _SHOWN]
    seen = {int(model.geom_bodyid[g]) for g in shown}
    shown += [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in set(moving) - seen]
    drawn = [body for body in moving if body in {int(model.geom_bodyid[g]) for g in shown}]
    each = most // max(1, sum(int(model.geom_dataid[g]) >= 0 for g in shown))
    geoms = [found for g in shown if (found := _geom(model, g, drawn, each)) is not None]
    if not drawn:
        drawn, geoms = moving, [*geoms, *_rods(model, moving)]
    return Scene(system, tuple(drawn), (*geoms, *more))


def _rods(model: mujoco.MjModel, bodies: Sequence[int]) -> Iterator[Geom]:
    """Rods to the centre of mass and to the next joints, for a model that has no shapes at all."""
    for row, body in enumerate(bodies):
        following = np.flatnonzero(model.body_parentid == body)
        for end in (model.body_ipos[body], *model.body_pos[following]):
            if (far := float(np.linalg.norm(end))) > 0.0:
                turn = np.empty(4)
                mujoco.mju_quatZ2Vec(turn, end)
                shape = boxed((0.05 * far, 0.05 * far, 0.5 * far))
                yield Geom(row, shape, np.concatenate((0.5 * end, turn)), _PLAIN, False)


def plate(place: FloatArray, half: tuple[float, float], yaw: float, color: Sequence[float]) -> Geom:
    """A thin plate on the floor at a place (2,) [m], so long and wide to each side, turned by a yaw [rad]."""
    pose = np.array([*place, 0.002, np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw)])
    r, g, b, a = color
    return Geom(-1, boxed((*half, 0.0005)), pose, (r, g, b, a), False)


def _geom(model: mujoco.MjModel, geom: int, bodies: list[int], most: int) -> Geom | None:
    color = _color(model, geom)
    shape = shape_of(model, geom, max(most, 60)) if color[3] > 0.0 else None
    if shape is None:
        return None
    body = int(model.geom_bodyid[geom])
    pose = np.concatenate((model.geom_pos[geom], model.geom_quat[geom]))
    row = bodies.index(body) if body in bodies else -1
    if row < 0 and body:
        pose = _in_world(model, geom)
    return Geom(row, shape, pose, color, int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_PLANE))


def _in_world(model: mujoco.MjModel, geom: int) -> FloatArray:
    data, turn = mujoco.MjData(model), np.empty(4)
    mujoco.mj_kinematics(model, data)
    mujoco.mju_mat2Quat(turn, data.geom_xmat[geom])
    return np.concatenate((data.geom_xpos[geom], turn))


def _color(model: mujoco.MjModel, geom: int) -> tuple[float, float, float, float]:
    """A geom's own colour, or its material's where it has MuJoCo's default."""
    material, own = int(model.geom_matid[geom]), model.geom_rgba[geom]
    plain = np.array_equal(own, np.array([0.5, 0.5, 0.5, 1.0], dtype=own.dtype))
    r, g, b, a = (float(v) for v in (model.mat_rgba[material] if material >= 0 and plain else own))
    return r, g, b, a


def _moves(model: mujoco.MjModel, body: int) -> bool:
    """Whether a joint, or a signal that drives a mocap body, moves a body."""
    while body:
        if model.body_jntnum[body] or model.body_mocapid[body] >= 0:
            return True
        body = int(model.body_parentid[body])
    return False


def _measured(system: System) -> Collection[int]:
    """Columns of qpos that a signal gives, also by a joint that another one follows."""
    model = system.model
    found = {c for channel in system.channels if channel.source == "qpos" for c in channel.columns}
    for one in couplings(model):
        if int(model.jnt_qposadr[one.leader]) in found:
            found.add(int(model.jnt_qposadr[one.follower]))
    return found
