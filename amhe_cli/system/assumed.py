"""What a model takes for granted: each of its numbers that no parameter sets, and that can move a prediction.

Forces of a servo are known as well as its gain, and where it saturates, as well as its limit. Masses follow,
as they do from a force sensor, whose zero drifts. Where gains are unknown, they follow from the masses. So
each such number is an assumed value: a nuisance with what a data sheet is worth as its sd.
Equal numbers of one kind stand on one data sheet, and are one assumed value.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.errors import and_more
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.system.description.data import Channel
from amhe_cli.system.description.targets import gain_cells
from amhe_cli.system.model.elements import matching_rows
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.edits import CALIBRATION, Cells, Mode, range_cells
from amhe_cli.system.parameters.gear_friction import number_cells
from amhe_cli.system.parameters.model_edits import Held
from amhe_cli.system.system import System

#: Elements of one assumed value that its name lists.
_LISTED = 3
#: A number that is known to less than this share of it is off by so much, and not by a factor.
_HALF = 0.5
#: What follows the name of an element whose number is written several times, by axis.
_AXES = "xyz"
#: Fields of degrees of freedom: the kind's sd in the settings, and how the kind is called.
_BY_DOF = {
    "dof_damping": ("damping", "damping"),
    "dof_armature": ("armature", "armature"),
    "dof_frictionloss": ("friction_loss", "dry friction"),
}
#: Field and row of numbers that parameters set.
_Taken = Collection[tuple[str, int]]


@dataclass(frozen=True, slots=True)
class Assumed:
    """One number, or several that are equal and stand on one data sheet.

    Args:
        setting: The setting of its kind, such as 'force_limit'.
        name: What it is, such as 'the force limit of servo3'.
        value: Its value with a unit, such as '0.5'; '' where it says nothing.
        cells: Where the model has it.
        mode: Whether a change is multiplied onto them or added to them.
        sd: How far it may be off: a share where multiplied [-], else in the number's own unit.
        amount, unit: `sd` as people read it, such as 10 and '%'.
        acts: Share of the steps in which it acts; None for what always does.
        grows: It can only become more: less of it has no effect that a slope would show.
    """

    setting: str
    name: str
    value: str
    cells: tuple[Cells, ...]
    mode: Mode
    sd: float
    amount: float
    unit: str
    acts: float | None = None
    grows: bool = False

    @property
    def parameter(self) -> Parameter:
        """The assumed value as a parameter, which z = 1 changes by one sd."""
        if self.mode == "scale":
            # on the log scale 10 % less is further away than 10 % more
            return Parameter(self.name, "-", 1.0, 1e-3, 1e3, log=True, prior_sd=-float(np.log1p(-self.sd)))
        return Parameter(self.name, "-", 0.0, -np.inf, np.inf, log=False, prior_sd=self.sd)


def with_assumed(system: System, values: Sequence[Assumed]) -> System:
    """The system with assumed values as further parameters."""
    model = _general(system, values)
    more: list[tuple[Parameter, tuple[Cells, ...], Mode]] = [
        (value.parameter, value.cells, value.mode) for value in values
    ]
    calibration = _with_biases(system)
    edits = system.edits.extended(model, more, calibration)
    space = ParameterSpace((*system.space.parameters, *(value.parameter for value in values)))
    return replace(system, model=model, space=space, edits=edits, calibration=calibration)


def _with_biases(system: System) -> SignalCalibration:
    """The system's calibration with a bias of each force and torque that is compared."""
    return system.calibration.biased({channel.key: len(channel.columns) for channel in _forces(system)})


def _forces(system: System) -> list[Channel]:
    """Forces and torques that are compared."""
    return [c for c in system.channels if c.compared and c.key.rsplit(".", 1)[1] in ("force", "torque")]


def _general(system: System, values: Sequence[Assumed]) -> mujoco.MjModel:
    """The model without values; bodies whose centre of mass is moved without MuJoCo's short cuts."""
    rows = {cells.row for value in values for cells in value.cells if cells.field == "body_ipos"}
    names = {system.model.body(row).name for row in rows}
    if not names:
        return system.unedited
    spec = system.spec.copy()
    for body in spec.bodies:
        if body.name in names:
            body.simple = 0
    return compiled(spec)


class Acting(NamedTuple):
    """What acts in n states of rollouts.

    Args:
        force: Actuators whose force is at its limit, shape (n, nactuator).
        driving: Actuators whose force is not zero, shape (n, nactuator).
        ctrl: Controls beyond their range, shape (n, nctrl).
        joint_force: Joints whose actuator force is at its limit, shape (n, njnt).
        joint: Joints at an end of their range, shape (n, njnt).
    """

    force: BoolArray
    driving: BoolArray
    ctrl: BoolArray
    joint_force: BoolArray
    joint: BoolArray

    @staticmethod
    def nothing(model: mujoco.MjModel) -> Acting:
        """One state in which no actuator and no limit acts."""
        widths = model.nactuator, model.nactuator, model.nu, model.njnt, model.njnt
        return Acting(*(np.zeros((1, width), dtype=bool) for width in widths))


def acting(
    model: mujoco.MjModel, input_spec: int, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray
) -> Acting:
    """Which limits and actuators act.

    Args:
        input_spec: mjtState bits of the inputs.
        qpos, qvel: States, shape (n, nq) and (n, nv).
        inputs: Inputs in these states, shape (n, nu).
    """
    data, rows = mujoco.MjData(model), []
    single = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    limited, dofs, positions = model.jnt_limited & single, model.jnt_dofadr, model.jnt_qposadr
    for q, v, u in zip(qpos, qvel, inputs, strict=True):
        data.qpos[:], data.qvel[:] = q, v
        if input_spec:
            mujoco.mj_setState(model, data, u, input_spec)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_fwdActuation(model, data)
        rows.append(
            (
                model.actuator_forcelimited & _beyond(data.actuator_force, model.actuator_forcerange),
                data.actuator_force != 0.0,
                model.actuator_ctrllimited & _beyond(data.ctrl, model.actuator_ctrlrange),
                model.jnt_actfrclimited & _beyond(data.qfrc_actuator[dofs], model.jnt_actfrcrange),
                limited & _beyond(data.qpos[positions], model.jnt_range),
            )
        )
    return Acting(*(np.array(column, dtype=bool) for column in zip(*rows, strict=True)))


def joined(parts: Iterable[Acting]) -> Acting:
    """What acts in the states of several parts."""
    return Acting(*map(np.concatenate, zip(*parts, strict=True)))


def _beyond(values: FloatArray, limits: FloatArray) -> BoolArray:
    """Which values are at an end of their range, or past it."""
    near = 1e-9 * (limits[:, 1] - limits[:, 0])
    return (values <= limits[:, 0] + near) | (values >= limits[:, 1] - near)


def assumed_of(
    system: System, acts: Acting, felt: Collection[str], largest: Mapping[str, float]
) -> list[Assumed]:
    """The numbers that act and that no parameter sets.

    Args:
        system: The system; its settings say how far each kind may be off, 0 that it is exact.
        acts: What acts in its rollouts.
        felt: Parameters that the logs depend on.
        largest: Key of a channel -> largest value that the logs have of it.
    """
    model, edits, settings = system.model, system.edits, system.settings.identify.assumed
    taken, late = edits.taken, settings.command_delay
    found = [
        Assumed("held", f"{p.name}, measured before", f"{held.value:.3g}", cells, *_change(p, held, mode))
        for p, held, cells, mode in edits.considered()
    ]
    found += _grouped(model, (*_of_actuators(model, acts), *_of_joints(model, acts)), settings, taken)
    found += _gears(model, system.settings.identify.geared, settings, taken)
    found += _ranges(model, settings.joint_limit, acts.joint)
    written = [cells for parameter, each in edits.by_parameter() if parameter.name in felt for cells in each]
    weighed = {cells.row for cells in written if cells.field == "body_mass"}  # unknown and felt
    found += _bodies(model, settings, taken, weighed)
    found += _tilts(model, settings.gravity, taken)
    found += _biases(system, settings.force_bias, largest, taken)
    if edits.prompt:
        found.append(_off("command_delay", "commands that act at once", edits.prompt, late, (1000.0, "ms")))
    return found


def _share(setting: str, name: str, value: str, cells: Iterable[Cells], share: float) -> Assumed:
    """Numbers that may be off by a share of them."""
    return Assumed(setting, name, value, tuple(cells), "scale", share, 100.0 * share, "%")


def _off(
    setting: str, name: str, cells: Iterable[Cells], sd: float, shown: tuple[float, str], value: str = ""
) -> Assumed:
    """Numbers that may be off by so much; `shown` is what people read `sd` in: its factor, and the unit."""
    return Assumed(setting, name, value, tuple(cells), "add", sd, sd * shown[0], shown[1])


def _change(parameter: Parameter, held: Held, mode: Mode) -> tuple[Mode, float, float, str]:
    """How far off the numbers of a held parameter may be: by a share of them, or by so much."""
    share = held.sd / max(abs(held.value), 1e-12)
    if mode == "scale" or (mode == "value" and share < _HALF):
        share = min(share, _HALF)
        return "scale", share, 100.0 * share, "%"
    return "add", held.sd, held.sd, parameter.unit


def _set(cells: Iterable[Cells], taken: _Taken) -> bool:
    return any((one.field, one.row) in taken for one in cells)


class _Number(NamedTuple):
    """One number of a kind: the kind's setting and name, whose it is, where, and when it acts, shape (n,)."""

    setting: str
    kind: str
    of: str
    cells: list[Cells]
    acts: BoolArray | None = None


def _of_actuators(model: mujoco.MjModel, acts: Acting) -> Iterator[_Number]:
    """Gains and limits of actuators; of actuators that amhe added, which play measured forces, none."""
    for row in range(model.nactuator):
        if not (name := _own(model.actuator(row).name)):
            continue
        if acts.driving[:, row].any():
            yield _Number("gain", "gain", name, gain_cells(model, row))
            speed = Cells("actuator_biasprm", row, (2,), -1.0)  # of a position servo that has its own
            servo = int(model.actuator_biastype[row]) == mujoco.mjtBias.mjBIAS_AFFINE
            if servo and model.actuator_biasprm[row, 2] and speed not in gain_cells(model, row):
                yield _Number("gain", "velocity gain", name, [speed])
        ctrl = int(model.actuator_ctrladr[row])
        for setting, kind, field, at, hit in (
            ("force_limit", "force limit", "actuator_forcerange", row, acts.force[:, row]),
            ("ctrl_limit", "control limit", "actuator_ctrlrange", ctrl, acts.ctrl[:, ctrl]),
        ):
            if hit.any():
                yield _Number(setting, kind, name, range_cells(model, field, at), hit)


def _of_joints(model: mujoco.MjModel, acts: Acting) -> Iterator[_Number]:
    """Damping, armature, dry friction, stiffness and force limits of joints, where the model has any."""
    for row in range(model.njnt):
        if not (name := model.joint(row).name):
            continue
        for field, (setting, kind) in _BY_DOF.items():
            dofs = np.flatnonzero((model.dof_jntid == row) & (getattr(model, field) != 0.0))
            yield _Number(setting, kind, name, [Cells(field, int(dof)) for dof in dofs])
        if np.any(model.jnt_stiffness[row]):
            yield _Number("stiffness", "stiffness", name, [Cells("jnt_stiffness", row)])
        if (hit := acts.joint_force[:, row]).any():
            ends = range_cells(model, "jnt_actfrcrange", row)
            yield _Number("force_limit", "force limit", name, ends, hit)


def _own(name: str, unnamed: str = "") -> str:
    return "" if name.startswith("amhe/") else name or unnamed


def _grouped(
    model: mujoco.MjModel, numbers: Iterable[_Number], settings: AssumedSettings, taken: _Taken
) -> Iterator[Assumed]:
    """Numbers that no parameter sets; those of one kind that are equal are one."""
    groups: dict[tuple[str, str, float], list[_Number]] = {}
    for one in numbers:
        if one.cells and not _set(one.cells, taken):
            value = float(f"{one.cells[0].of(model)[0]:.6g}")
            groups.setdefault((one.setting, one.kind, value), []).append(one)
    for (setting, kind, value), equal in groups.items():
        name = f"the {kind} of {and_more([one.of for one in equal], _LISTED)}"
        cells = [cell for one in equal for cell in one.cells]
        hits = [one.acts for one in equal if one.acts is not None]
        found = _share(setting, name, f"{value:g}", cells, getattr(settings, setting))
        yield replace(found, acts=float(np.any(hits, axis=0).mean()) if hits else None)


def _ranges(model: mujoco.MjModel, share: float, hit: BoolArray) -> Iterator[Assumed]:
    for row in map(int, np.flatnonzero(hit.any(axis=0))):
        extent = float(np.ptp(model.jnt_range[row]))
        ends = (Cells("jnt_range", row, (1,)), Cells("jnt_range", row, (0,), -1.0))
        name = f"the range of joint {model.joint(row).name}"
        found = _off("joint_limit", name, ends, share * extent, (100.0 / max(extent, 1e-12), "% of it"))
        yield replace(found, acts=float(hit[:, row].mean()))


def _gears(
    model: mujoco.MjModel, geared: Sequence[str], settings: AssumedSettings, taken: _Taken
) -> Iterator[Assumed]:
    """What friction of geared joints may have besides a constant, and the springs that cables make."""
    rows = {row for pattern in geared for row in matching_rows(model, "joint", pattern)}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for row in sorted(rows):
        name, dof, body = model.joint(row).name, int(model.jnt_dofadr[row]), int(model.jnt_bodyid[row])
        dry, arm = float(model.dof_frictionloss[dof]), data.subtree_com[body] - data.xanchor[row]
        weight = float(model.body_subtreemass[body] * np.linalg.norm(model.opt.gravity))
        lever = float(np.linalg.norm(arm - (arm @ data.xaxis[row]) * data.xaxis[row]))
        share = settings.load_friction / np.sqrt(2.0)
        for setting, word, what, sd, shown in (
            ("load_friction", "load_friction_motor", "whatever its motor does", share, "% of the torque"),
            ("load_friction", "load_friction_external", "whatever its load", share, "% of the load"),
            ("stribeck", "stribeck_friction", "also at rest", settings.stribeck * dry, "N m"),
        ):
            cells, what = number_cells(model, row, word), f"the constant friction of {name}, {what}"
            if sd and not _set(cells, taken):
                factor = 100.0 if shown.startswith("%") else 1.0
                yield replace(_off(setting, what, cells, sd, (factor, shown)), grows=True)
        spring, stiffness = Cells("jnt_stiffness", row), settings.spring * weight * lever
        if stiffness and not _set([spring], taken) and not np.any(model.jnt_stiffness[row]):
            yield _off("spring", f"no spring at {name}", [spring], stiffness, (1.0, "N m/rad"))


def _moving(model: mujoco.MjModel) -> list[int]:
    """Bodies that move and have a mass; not those that amhe added."""
    rows = (row for row in range(model.nbody) if model.body_weldid[row] and _own(model.body(row).name, "?"))
    return [row for row in rows if model.body_mass[row] > 0.0]


def _bodies(
    model: mujoco.MjModel, settings: AssumedSettings, taken: _Taken, weighed: Collection[int]
) -> Iterator[Assumed]:
    """Centres of mass of bodies whose mass is unknown, one scale of all others, and the links' lengths."""
    for row in sorted(weighed):
        for axis, name in enumerate(_AXES if ("body_ipos", row) not in taken else ""):
            what, cells = (
                f"the centre of mass of {model.body(row).name} along {name}",
                Cells("body_ipos", row, (axis,)),
            )
            yield _off("center_of_mass", what, [cells], settings.center_of_mass, (1000.0, "mm"))
    # bodies that no parameter weighs: their model has one author
    if rows := [row for row in _moving(model) if ("body_mass", row) not in taken]:
        cells = [Cells("body_mass", row) for row in rows]
        cells += [Cells("body_inertia", row, (0, 1, 2)) for row in rows if ("body_inertia", row) not in taken]
        total = f"{float(model.body_mass[rows].sum()):.3g} kg"
        yield _share("mass", "the masses of the links", total, cells, settings.mass)
    for row in _moving(model):  # where each link stands on the one before it is the length of that one
        parent, place = int(model.body_parentid[row]), model.body_pos[row]
        if model.body_weldid[parent] and np.any(place) and ("body_pos", row) not in taken:
            name, base = _own(model.body(row).name, "a body"), _own(model.body(parent).name, "its parent")
            length, cells = f"{float(np.linalg.norm(place)):.3g} m", [Cells("body_pos", row, (0, 1, 2))]
            yield _share("geometry", f"the place of {name} on {base}", length, cells, settings.geometry)


def _tilts(model: mujoco.MjModel, angle: float, taken: _Taken) -> Iterator[Assumed]:
    """How level a fixed base stands, about two axes; one number where several trees stand on one floor."""
    free = {int(model.jnt_bodyid[j]) for j in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)}
    moving = {int(model.body_rootid[row]) for row in _moving(model)}
    roots = sorted(moving - {int(model.body_rootid[row]) for row in free})
    if not roots or not np.any(model.opt.gravity) or any(("body_quat", row) in taken for row in roots):
        return
    for axis, name in enumerate("xy"):
        turn, cells = np.eye(3)[axis], []
        for row in roots:
            w, v = float(model.body_quat[row, 0]), np.array(model.body_quat[row, 1:])
            change = 0.5 * np.array([-turn @ v, *(w * turn + np.cross(turn, v))])
            cells += [Cells("body_quat", row, (k,), float(c)) for k, c in enumerate(change) if c]
        yield _off("gravity", f"the base's tilt about {name}", cells, angle, (1.0, "rad"), "level")


def _biases(system: System, share: float, largest: Mapping[str, float], taken: _Taken) -> Iterator[Assumed]:
    """Zeros of the force and torque sensors that are compared."""
    readings = _with_biases(system).readings
    for channel in _forces(system):
        size = largest[channel.key]
        for axis, row in zip(_AXES, readings[channel.key].bias, strict=False):
            if (CALIBRATION, row) not in taken:
                what, shown = (
                    f"the bias of {channel.key} along {axis}",
                    (100.0 / (size or 1.0), "% of its largest value"),
                )
                yield _off("force_bias", what, [Cells(CALIBRATION, row)], share * size, shown)
