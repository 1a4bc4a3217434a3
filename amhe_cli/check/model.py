"""Numbers of a model that no robot has: masses, inertias, drives, limits, contacts. Nothing is simulated."""

from __future__ import annotations

import re
from collections.abc import Iterator

import mujoco
import numpy as np

from amhe_cli.check.findings import Finding, worst_first
from amhe_cli.core.arrays import FloatArray, IntArray

#: Densities [kg/m^3]: of a body's bounding box filled with lead, and of one that holds next to nothing.
_LEAD, _AIR = 11_340.0, 5.0
#: A link that moves weighs no less [kg]: a few screws.
_SCREWS = 3e-3
#: Share of the mass of what is welded together from which a body has numbers that matter.
WORTHWHILE = 0.05
#: A range [rad] that is as good as none, and not one in degrees.
_UNLIMITED = 1e3
#: How far a centre of mass may lie outside of the shape, as a share of its size.
_OUTSIDE = 0.15
#: Radius of gyration over half the diagonal of the shape: between a point and a ring around it.
_POINT, _RING = 0.1, 1.1
#: Factors by which left and right may differ in mass, and in anything else.
_TWIN_MASS, _TWIN = 1.02, 1.1
#: A servo's period should last this many time steps.
_STEPS = 6.0
#: A servo that gives all its force at a smaller error [rad] is stiffer than position servos are.
_SATURATES = 0.01
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
    return worst_first(finding for part in parts for finding in part)


def total_mass(model: mujoco.MjModel) -> float:
    """Mass of everything that is not the world [kg]."""
    return float(model.body_mass[1:].sum())


def _name(model: mujoco.MjModel, kind: str, row: int) -> str:
    return getattr(model, kind)(int(row)).name or f"{kind} {row}"


def _bodies(model: mujoco.MjModel) -> Iterator[Finding]:
    """Links that weigh next to nothing, and what moves against its shape, but for small parts of it."""
    welded = np.bincount(model.body_weldid, model.body_mass, model.nbody)
    for body in np.flatnonzero(model.body_mass > WORTHWHILE * welded[model.body_weldid]):
        weld = model.body_weldid[body]
        if not weld or model.body_mocapid[weld] >= 0:
            continue
        if body == weld and welded[weld] < min(_SCREWS, 0.999 * model.body_subtreemass[weld]):
            yield Finding(
                "light", _name(model, "body", body),
                f"it weighs {1e3 * welded[weld]:.2g} g, and links hang on it", _SCREWS / welded[weld],
                "weigh it, or take the mass of CAD",
            )  # fmt: skip
        box = _box(model, body)
        if box is not None:
            yield from _against_shape(model, body, box)


def _box(model: mujoco.MjModel, body: int) -> FloatArray | None:
    """Lowest and highest corner of a body's shapes in its frame, shape (2, 3); None where it has none.

    A link reaches from its joint to those of the links that hang on it, whatever is drawn of it.
    """
    corners = []
    for geom in np.flatnonzero(model.geom_bodyid == body):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        centre, half = np.split(model.geom_aabb[geom], 2)
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        corners.append((centre + signs * half) @ turn.reshape(3, 3).T + model.geom_pos[geom])
    if not corners:
        return None
    points = np.concatenate([*corners, np.zeros((1, 3)), model.body_pos[model.body_parentid == body]])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _against_shape(model: mujoco.MjModel, body: int, box: FloatArray) -> Iterator[Finding]:
    name, mass = _name(model, "body", body), float(model.body_mass[body])
    edges = np.maximum(box[1] - box[0], 1e-4)
    size, density = float(np.linalg.norm(edges)), mass / float(edges.prod())
    if density > _LEAD:
        yield Finding(
            "dense", name, f"{mass:.3g} kg in a box of {_metres(edges)}: denser than lead", density / _LEAD,
            "look for a mass in grams, or a wrong scale of the mesh",
        )  # fmt: skip
    if density < _AIR:
        yield Finding(
            "thin", name, f"{mass:.3g} kg in a box of {_metres(edges)}: lighter than foam", _AIR / density,
            "look for a mass in tons or a mesh in millimetres",
        )  # fmt: skip
    com = model.body_ipos[body]
    outside = float(np.linalg.norm(np.maximum(0.0, np.maximum(box[0] - com, com - box[1]))))
    if outside > _OUTSIDE * size:
        yield Finding(
            "centre", name, f"its centre of mass lies {1e3 * outside:.0f} mm outside its shape",
            outside / (_OUTSIDE * size), "look for a sign, or for millimetres taken for metres",
        )  # fmt: skip
    half = 0.5 * size + outside
    gyration = float(np.sqrt(model.body_inertia[body].max() / mass))
    if gyration > _RING * half:
        yield Finding(
            "inertia", name, f"its inertia is that of its mass at {1e3 * gyration:.0f} mm, outside its shape",
            (gyration / half) ** 2, "take it from CAD, about the centre of mass and in kg m^2",
        )  # fmt: skip
    if gyration < _POINT * half:
        yield Finding(
            "inertia", name, f"its inertia is that of its mass at {1e3 * gyration:.2g} mm: a point",
            (_POINT * half / max(gyration, 1e-9)) ** 2, "take it from CAD; g mm^2 are 1e-9 kg m^2",
        )  # fmt: skip


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


def _twins(model: mujoco.MjModel) -> Iterator[Finding]:
    def found(kind: str, names: list[str], numbers: dict[str, tuple[FloatArray, float]]) -> Iterator[Finding]:
        for left, right in _pairs(names):
            for what, (values, most) in numbers.items():
                one, other = np.abs(np.atleast_1d(values[left])), np.abs(np.atleast_1d(values[right]))
                floor = 1e-9 + 1e-3 * np.abs(values).max(initial=0.0)
                ratios = (np.maximum(one, other) + floor) / (np.minimum(one, other) + floor)
                if ratios.max() > most:
                    at = int(ratios.argmax())
                    yield Finding(
                        "twins", f"{names[left]}, {names[right]}",
                        f"{what} differs: {one[at]:.4g} and {other[at]:.4g}", float(ratios.max()),
                        "a robot is mostly built alike on both sides: which of the two is right?",
                    )  # fmt: skip

    bodies = [model.body(row).name for row in range(model.nbody)]
    inertia = np.sort(model.body_inertia, axis=1)
    yield from found(
        "body", bodies, {"mass": (model.body_mass, _TWIN_MASS), "inertia [kg m^2]": (inertia, _TWIN)}
    )
    if not model.nv:
        return
    joints, dofs = [model.joint(row).name for row in range(model.njnt)], model.jnt_dofadr
    numbers = {
        "damping": (np.reshape(model.dof_damping, (model.nv, -1))[dofs], _TWIN),
        "armature": (model.dof_armature[dofs], _TWIN),
        "dry friction": (model.dof_frictionloss[dofs], _TWIN),
    }
    yield from found("joint", joints, numbers)
    actuators = [model.actuator(row).name for row in range(model.nu)]
    gains = {
        "gain": (model.actuator_gainprm[:, 0], _TWIN),
        "force limit": (model.actuator_forcerange[:, 1], _TWIN),
    }
    yield from found("actuator", actuators, gains)


def _drives(model: mujoco.MjModel, joints: IntArray) -> Iterator[Finding]:
    """What joints and their actuators lack, and gains that the time step cannot carry."""
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    driven = np.unique(model.actuator_trnid[on_joint, 0]) if model.nu else joints
    for joint in np.intersect1d(joints, driven):
        name, dof = _name(model, "joint", joint), int(model.jnt_dofadr[joint])
        lacks = [
            word
            for word, value in (
                ("armature", model.dof_armature[dof]),
                ("damping", np.abs(np.ravel(model.dof_damping[dof])).max()),
                ("dry friction", model.dof_frictionloss[dof]),
            )
            if value == 0.0
        ]
        if lacks:
            yield Finding(
                "drive", name, f"it has no {' and no '.join(lacks)}", 1.0 + 0.5 * len(lacks),
                "no drive is without: `amhe init --drive` takes them from the library, `identify` from a log",
            )  # fmt: skip
    moved: dict[tuple[int, str], list[str]] = {}
    for row in range(model.nu):
        name = _name(model, "actuator", row)
        if not model.actuator_gear[row].any() or not np.any(model.actuator_gainprm[row]):
            yield Finding(
                "idle", name, "it moves nothing: gear or gain is 0", 10.0, "give it a gain, or delete it"
            )
        if not on_joint[row]:
            continue
        joint = int(model.actuator_trnid[row, 0])
        bias, gain = model.actuator_biasprm[row], float(model.actuator_gainprm[row, 0])
        kind = "position" if bias[1] else "velocity" if bias[2] else "effort"
        moved.setdefault((joint, kind), []).append(name)
        inertia = float(model.dof_M0[model.jnt_dofadr[joint]])
        if kind == "position" and gain > 0.0 and inertia > 0.0:
            steps = 2.0 * np.pi * np.sqrt(inertia / gain) / model.opt.timestep
            if steps < _STEPS:
                yield Finding(
                    "stiff", name,
                    f"gain {gain:.4g} swings {inertia:.2g} kg m^2 in {steps:.1f} time steps of "
                    f"{1e3 * model.opt.timestep:.3g} ms", _STEPS / steps,
                    "is the gain in counts (`amhe drives`), is the armature there? Else a shorter time step",
                )  # fmt: skip
    for (joint, kind), names in moved.items():
        if len(names) > 1:
            yield Finding(
                "twice", _name(model, "joint", joint), f"{' and '.join(names)} both drive its {kind}", 5.0,
                "delete one of them",
            )  # fmt: skip


def _limits(model: mujoco.MjModel, joints: IntArray) -> Iterator[Finding]:
    """Limits of force below the weight that they carry, and ranges of controls beyond those of joints."""
    heavy = _weight(model, joints)
    for row in range(model.nu):
        joint = int(model.actuator_trnid[row, 0])
        if model.actuator_trntype[row] != mujoco.mjtTrn.mjTRN_JOINT or joint not in joints:
            continue
        name, dof = _name(model, "actuator", row), int(model.jnt_dofadr[joint])
        gear = abs(float(model.actuator_gear[row, 0])) or 1.0
        limit = (
            float(model.actuator_forcerange[row, 1]) * gear if model.actuator_forcelimited[row] else np.inf
        )
        if model.jnt_actfrclimited[joint]:
            limit = min(limit, float(model.jnt_actfrcrange[joint, 1]))
        if 0.0 < limit < heavy[dof]:
            yield Finding(
                "weak", name, f"its {limit:.3g} N m hold less than the {heavy[dof]:.3g} N m of gravity",
                heavy[dof] / limit, "is the limit that of the motor, before the gear? Is a mass too large?",
            )  # fmt: skip
        error = limit * gear / max(-float(model.actuator_biasprm[row, 1]) * gear**2, 1e-9)
        if error < _SATURATES and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            yield Finding(
                "stiff", name, f"{np.degrees(error):.2g} degrees of error already take all of its force",
                _SATURATES / error, "is the gain measured? `amhe drives` knows some, `identify` finds it",
            )  # fmt: skip
        if model.actuator_biasprm[row, 1] and model.actuator_ctrllimited[row] and model.jnt_limited[joint]:
            reach, span = model.actuator_ctrlrange[row] / gear, np.ptp(model.jnt_range[joint])
            beyond = max(model.jnt_range[joint, 0] - reach[0], reach[1] - model.jnt_range[joint, 1])
            if beyond > 0.1 * max(span, 1e-6):
                yield Finding(
                    "range", name, f"its targets go {beyond:.2g} rad beyond the joint's range of {span:.3g}",
                    1.0 + beyond / max(span, 1e-6), "look for degrees, or for another zero",
                )  # fmt: skip
    for joint in joints:
        width = float(np.ptp(model.jnt_range[joint]))
        if model.jnt_limited[joint] and 8.0 * np.pi < width < _UNLIMITED:
            yield Finding(
                "range", _name(model, "joint", joint), f"its range is {width:.3g} rad", width / (8.0 * np.pi),
                "look for degrees taken for radians",
            )  # fmt: skip


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


def _overlaps(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Finding]:
    deepest: dict[tuple[str, str], float] = {}
    for contact in data.contact[: data.ncon]:
        pair = sorted(_name(model, "body", model.geom_bodyid[geom]) for geom in contact.geom)
        key = (pair[0], pair[1])
        deepest[key] = max(deepest.get(key, 0.0), -float(contact.dist))
    for (one, other), depth in deepest.items():
        if depth > _OVERLAP:
            yield Finding(
                "overlap", f"{one}, {other}", f"they overlap by {1e3 * depth:.1f} mm at the home pose",
                1.0 + depth / 0.01, "exclude the pair, or mend the shapes or the home pose",
            )  # fmt: skip
