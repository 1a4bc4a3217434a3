"""Numbers of a model that no robot has: masses, inertias, drives, limits, contacts. Nothing is simulated."""

from __future__ import annotations

import re
from collections.abc import Iterator

import mujoco
import numpy as np

from amhe_cli.check.findings import BEYOND, Doubt, Finding, worst_first
from amhe_cli.core.arrays import FloatArray, IntArray

#: Densities [kg/m^3]: of a body's bounding box filled with lead, and of one that holds next to nothing.
_LEAD, _AIR = 11_340.0, 5.0
#: A link that moves weighs no less [kg]: a few screws.
_SCREWS = 3e-3
#: Share of the mass of what is welded together from which a body has numbers that matter.
WORTHWHILE = 0.05
#: A range [rad] that is as good as none, and not one in degrees; and those of a hinge between a lock and one
#: of radians that were taken for degrees.
_UNLIMITED = 1e3
_LOCKED, _NARROW = 1e-3, float(np.radians(6.0))
#: How far a centre of mass may lie outside of the shape, as a share of its size.
_OUTSIDE = 0.15
#: Radius of gyration over half the diagonal of the shape: between a point and a ring around it.
_POINT, _RING = 0.1, 1.1
#: Radius of gyration about one axis over how far the shape is from it: drives stand out of what is drawn; and
#: the least reach that counts [m].
_BESIDE, _THIN = 1.5, 0.01
#: Factors by which left and right may differ in mass, and in anything else.
_TWIN_MASS, _TWIN = 1.02, 1.1
#: A servo's period should last this many time steps.
_STEPS = 6.0
#: A servo that gives all its force at a smaller error [rad] is stiffer than position servos are.
_SATURATES = 0.01
#: A limit of force that is so many times what a servo gives over all of its range is none, and targets that
#: cover less than this share of the range are of another unit.
_LOOSE, _COVERED = 5.0, 0.5
#: Penetration at the home pose [m] that is no contact but an overlap.
_OVERLAP = 1e-3
#: Poses that gravity's torque is the largest of, and the seed of their generator.
_POSES, _SEED = 200, 0
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_SIDES = {"left": "right", "l": "r", "fl": "fr", "rl": "rr", "hl": "hr", "lf": "rf", "lh": "rh"}


def check_model(model: mujoco.MjModel) -> tuple[Finding, ...]:
    """Findings about a model, the worst first."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    joints = np.flatnonzero(np.isin(model.jnt_type, _SINGLE))
    parts = (
        _bodies(model),
        _twins(model),
        _drives(model, joints),
        _limits(model, joints),
        _overlaps(model, data),
    )
    return worst_first(Finding.of(doubt) for part in parts for doubt in part if doubt[3] > 1.0)


def total_mass(model: mujoco.MjModel) -> float:
    """Mass of everything that is not the world [kg]."""
    return float(model.body_mass[1:].sum())


def _name(model: mujoco.MjModel, kind: str, row: int) -> str:
    return getattr(model, kind)(int(row)).name or f"{kind} {row}"


def touching(model: mujoco.MjModel, contact: mujoco.MjContact) -> str:
    """The names of the two bodies of a contact, in their order by name."""
    return ", ".join(sorted(_name(model, "body", model.geom_bodyid[geom]) for geom in contact.geom))


def _bodies(model: mujoco.MjModel) -> Iterator[Doubt]:
    """Links that weigh next to nothing, and what moves against its shape, but for small parts of it."""
    welded = np.bincount(model.body_weldid, model.body_mass, model.nbody)
    for body in np.flatnonzero(model.body_mass > WORTHWHILE * welded[model.body_weldid]).tolist():
        weld, name = model.body_weldid[body], _name(model, "body", body)
        if not weld or model.body_mocapid[weld] >= 0:
            continue
        if body == weld and welded[weld] < 0.999 * model.body_subtreemass[weld]:
            grams = 1e3 * welded[weld]
            yield (
                "light",
                name,
                f"it weighs {grams:.2g} g, and links hang on it",
                float(1e3 * _SCREWS / grams),
            )
        if (points := _corners(model, body)) is not None:
            yield from _against_shape(model, body, name, points)


def _corners(model: mujoco.MjModel, body: int) -> FloatArray | None:
    """Corners of the boxes around a body's shapes in its frame, shape (n, 3); None where it has none."""
    corners = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        centre, half = np.split(model.geom_aabb[geom], 2)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        corners.append((centre + signs * half) @ turn.reshape(3, 3).T + model.geom_pos[geom])
    return np.concatenate(corners) if corners else None


def _against_shape(model: mujoco.MjModel, body: int, name: str, shape: FloatArray) -> Iterator[Doubt]:
    """A body's mass, centre of mass and inertia against its shape.

    A link reaches from its joint to those of the links that hang on it, whatever is drawn of it.
    """
    mass, com = float(model.body_mass[body]), model.body_ipos[body]
    points = np.concatenate([shape, np.zeros((1, 3)), model.body_pos[model.body_parentid == body]])
    low, high = points.min(axis=0), points.max(axis=0)
    drawn, edges = (np.maximum(np.ptp(some, axis=0), 1e-4) for some in (shape, points))
    size = float(np.linalg.norm(edges))
    dense, thin = mass / float(edges.prod()) / _LEAD, _AIR * float(drawn.prod()) / mass
    yield "dense", name, f"{mass:.3g} kg in a box of {_metres(edges)}: denser than lead", dense
    yield "thin", name, f"{mass:.3g} kg in a box of {_metres(drawn)}: lighter than foam", thin
    outside = float(np.linalg.norm(np.maximum(0.0, np.maximum(low - com, com - high))))
    away = f"its centre of mass lies {1e3 * outside:.0f} mm outside its shape"
    yield "centre", name, away, outside / (_OUTSIDE * size)
    half, gyration = 0.5 * size + outside, float(np.sqrt(model.body_inertia[body].max() / mass))
    as_of = f"its inertia is that of its mass at {1e3 * gyration:.4g} mm"
    # a factor on the inertia, but no finding until the radius is beyond what is allowed for
    yield "inertia", name, f"{as_of}, outside its shape", _if(gyration > _RING * half, (gyration / half) ** 2)
    yield "inertia", name, f"{as_of}: a point", (_POINT * half / max(gyration, 1e-9)) ** 2
    if ((com >= shape.min(axis=0)) & (com <= shape.max(axis=0))).all():  # else what is drawn is not the link
        yield from _axes(model, body, name, points)


def _axes(model: mujoco.MjModel, body: int, name: str, points: FloatArray) -> Iterator[Doubt]:
    """Inertia about an axis of the shape that all of its mass, as far off as the shape reaches, has not."""
    mass, away, turn = float(model.body_mass[body]), points - model.body_ipos[body], np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body_iquat[body])
    principal, own = turn.reshape(3, 3), np.linalg.eigh(np.cov(points.T))[1]
    gyration = np.sqrt((own.T @ principal) ** 2 @ model.body_inertia[body] / mass)
    reach = np.array([np.linalg.norm(np.cross(away, axis), axis=1).max() for axis in own.T])
    k = int(np.argmax(gyration / np.maximum(reach, _THIN)))
    says = (
        f"about an axis of its shape that reaches {1e3 * reach[k]:.3g} mm, its inertia is that of its mass at"
    )
    yield "axes", name, f"{says} {1e3 * gyration[k]:.3g} mm", gyration[k] / (_BESIDE * max(reach[k], _THIN))


def _if(found: bool, size: float) -> float:
    return size if found else 0.0


def _metres(edges: FloatArray) -> str:
    return " x ".join(f"{1e3 * edge:.0f}" for edge in edges) + " mm"


def _pairs(names: list[str]) -> Iterator[tuple[int, int]]:
    """Rows of a left element and of the right one that is named alike."""
    rows = {name.lower(): row for row, name in enumerate(names) if name}
    for name, row in rows.items():
        words = re.split(r"([^a-z]+|(?<=[a-z])(?=\d))", name)
        other = "".join(_SIDES.get(word, word) for word in words)
        if other != name and other in rows:
            yield row, rows[other]


def _twins(model: mujoco.MjModel) -> Iterator[Doubt]:
    """Numbers in which left and right differ."""
    joints = model.jnt_dofadr if model.nv else np.zeros(0, dtype=int)
    numbers = (
        ("body", "mass", model.body_mass, _TWIN_MASS),
        ("body", "inertia [kg m^2]", np.sort(model.body_inertia, axis=1), _TWIN),
        ("joint", "damping", model.dof_damping[joints], _TWIN),
        ("joint", "armature", model.dof_armature[joints], _TWIN),
        ("joint", "dry friction", model.dof_frictionloss[joints], _TWIN),
        ("actuator", "gain", model.actuator_gainprm[:, 0], _TWIN),
        ("actuator", "force limit", model.actuator_forcerange[:, 1], _TWIN),
    )
    for kind, what, values, most in numbers:
        names = [getattr(model, kind)(row).name for row in range(len(values))]
        for left, right in _pairs(names):
            one, other = np.abs(np.atleast_1d(values[left])), np.abs(np.atleast_1d(values[right]))
            floor = 1e-9 + 1e-3 * np.abs(values).max(initial=0.0)
            ratios = (np.maximum(one, other) + floor) / (np.minimum(one, other) + floor)
            at = int(ratios.argmax())
            said = f"{what} differs: {one[at]:.4g} and {other[at]:.4g}"
            yield "twins", f"{names[left]}, {names[right]}", said, _if(ratios[at] > most, float(ratios[at]))


def _drives(model: mujoco.MjModel, joints: IntArray) -> Iterator[Doubt]:
    """What joints and their actuators lack, and gains that the time step cannot carry."""
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    driven = np.unique(model.actuator_trnid[on_joint, 0]) if model.nu else joints
    for joint in np.intersect1d(joints, driven):
        dof = int(model.jnt_dofadr[joint])
        values = {
            "armature": model.dof_armature[dof],
            "damping": np.abs(model.dof_damping[dof]).max(),
            "dry friction": model.dof_frictionloss[dof],
        }
        lacks = [word for word, value in values.items() if value == 0.0]
        said = f"no {' and no '.join(lacks)}"
        yield "drive", _name(model, "joint", joint), said, 1.0 + 0.5 * len(lacks)
    moved: dict[tuple[int, str], list[str]] = {}
    for row in range(model.nu):
        name = _name(model, "actuator", row)
        idle = not model.actuator_gear[row].any() or not np.any(model.actuator_gainprm[row])
        yield "idle", name, "it moves nothing: gear or gain is 0", 10.0 * idle
        if not on_joint[row]:
            continue
        joint = int(model.actuator_trnid[row, 0])
        bias, gain = model.actuator_biasprm[row], float(model.actuator_gainprm[row, 0])
        kind = "position" if bias[1] else "velocity" if bias[2] else "effort"
        moved.setdefault((joint, kind), []).append(name)
        inertia = float(model.dof_M0[model.jnt_dofadr[joint]])
        if kind == "position" and gain > 0.0 and inertia > 0.0:
            step = model.opt.timestep
            steps = 2.0 * np.pi * np.sqrt(inertia / gain) / step
            swings = f"gain {gain:.4g} swings {inertia:.2g} kg m^2 in {steps:.1f} time steps"
            yield "stiff", name, f"{swings} of {1e3 * step:.3g} ms", _STEPS / steps
    for (joint, kind), names in moved.items():
        both = f"{' and '.join(names)} both drive its {kind}"
        yield "twice", _name(model, "joint", joint), both, 5.0 * (len(names) > 1)


def _limits(model: mujoco.MjModel, joints: IntArray) -> Iterator[Doubt]:
    """Limits of force below the weight that they carry, and ranges of controls beyond those of joints."""
    heavy = _weight(model, joints)
    for row in range(model.nu):
        joint = int(model.actuator_trnid[row, 0])
        if model.actuator_trntype[row] != mujoco.mjtTrn.mjTRN_JOINT or joint not in joints:
            continue
        name, weight = _name(model, "actuator", row), heavy[model.jnt_dofadr[joint]]
        gear = abs(float(model.actuator_gear[row, 0])) or 1.0
        stiffness = -float(model.actuator_biasprm[row, 1])
        limit = (
            float(model.actuator_forcerange[row, 1]) * gear if model.actuator_forcelimited[row] else np.inf
        )
        if model.jnt_actfrclimited[joint]:
            limit = min(limit, float(model.jnt_actfrcrange[joint, 1]))
        if limit > 0.0:
            carries = f"its {limit:.3g} N m hold less than the {weight:.3g} N m of gravity"
            yield "weak", name, carries, float(weight / limit)
            dry = float(model.dof_frictionloss[model.jnt_dofadr[joint]])
            yield (
                "weak",
                name,
                f"its {limit:.3g} N m do not overcome {dry:.3g} N m of dry friction",
                dry / limit,
            )
        error = max(limit, 0.0) / gear / max(stiffness, 1e-9)
        hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        takes = f"{np.degrees(error):.2g} degrees of error already take all of the force"
        yield "stiff", name, takes, hinge * _SATURATES / max(error, 1e-12)
        if stiffness and model.actuator_ctrllimited[row] and model.jnt_limited[joint]:
            span, per = max(np.ptp(model.jnt_range[joint]), 1e-6), model.actuator_gainprm[row, 0] / stiffness
            reach = np.sort(model.actuator_ctrlrange[row] * per / gear)
            beyond = max(model.jnt_range[joint, 0] - reach[0], reach[1] - model.jnt_range[joint, 1])
            goes = f"its targets go {beyond:.2g} rad beyond the joint's range of {span:.3g}"
            yield "range", name, goes, _if(beyond > BEYOND * span, float(1.0 + beyond / span))
            covered = float(np.ptp(reach)) / span
            little = f"its targets cover {covered:.2g} of the joint's range"
            yield "range", name, little, _COVERED / max(covered, 1e-6)
        most = stiffness * gear**2 * float(np.ptp(model.jnt_range[joint]))
        if hinge and model.jnt_limited[joint] and np.isfinite(limit) and most > 0.0:
            never = f"its {limit:.3g} N m never act: over all of its range it gives {most:.3g}"
            yield "loose", name, never, limit / (_LOOSE * most)
    for joint in joints[model.jnt_limited[joints] > 0]:
        width = float(np.ptp(model.jnt_range[joint]))
        size = _if(width < _UNLIMITED, width / (8.0 * np.pi))
        name, hinge = _name(model, "joint", joint), model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
        yield "range", name, f"its range is {width:.3g} rad", size
        narrow = _if(hinge and width > _LOCKED, _NARROW / max(width, _LOCKED))
        yield "range", name, f"its range is {np.degrees(width):.2g} degrees", narrow


def _weight(model: mujoco.MjModel, joints: IntArray) -> FloatArray:
    """The largest torque of gravity at each degree of freedom over poses within the ranges, shape (nv,)."""
    rng, data, most = np.random.default_rng(_SEED), mujoco.MjData(model), np.zeros(model.nv)
    places, limited = model.jnt_qposadr[joints], model.jnt_limited[joints, None]
    low, high = np.where(limited, model.jnt_range[joints], (-np.pi, np.pi)).T
    if any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        return most  # what a floating base carries depends on what it stands on
    for _ in range(_POSES):
        data.qpos[places] = rng.uniform(low, high)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        most = np.maximum(most, np.abs(data.qfrc_bias - data.qfrc_passive))
    return most


def _overlaps(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Doubt]:
    deepest: dict[str, float] = {}
    for contact in data.contact[: data.ncon]:
        pair = touching(model, contact)
        deepest[pair] = max(deepest.get(pair, 0.0), -float(contact.dist))
    for pair, depth in deepest.items():
        size = _if(depth > _OVERLAP, 1.0 + depth / 0.01)
        yield "overlap", pair, f"they overlap by {1e3 * depth:.1f} mm at the home pose", size
