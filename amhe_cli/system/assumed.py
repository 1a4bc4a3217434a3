"""What a model takes for granted: each of its numbers that no parameter sets, and that can move a prediction.

Forces of a servo are known as well as its gain, and where it saturates, as well as its limit. Masses follow,
as they do from a force sensor, whose zero drifts. Where gains are unknown, they follow from the masses. So
each such number is an assumed value: a nuisance with what a data sheet is worth as its sd.
Equal numbers of one kind stand on one data sheet, and are one assumed value.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.system.description.data import Channel
from amhe_cli.system.description.targets import gain_cells
from amhe_cli.system.model.elements import matching_rows
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.edits import Cells, Mode, range_cells
from amhe_cli.system.parameters.gear_friction import number_cells
from amhe_cli.system.parameters.model_edits import Held, ModelEdits
from amhe_cli.system.system import System

#: Elements of one assumed value that its name lists.
_LISTED = 3
#: A number that is known to less than this share of it is off by so much, and not by a factor.
_HALF = 0.5
#: What follows the name of an element whose number is written several times, by axis.
_AXES = "xyz"
#: Fields whose row says enough, with the kind, its sd in the settings, and how the kind is called.
_BY_DOF = (
    ("dof_damping", "damping", "damping"),
    ("dof_armature", "armature", "armature"),
    ("dof_frictionloss", "friction_loss", "dry friction"),
)


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


@dataclass(frozen=True, slots=True, eq=False)
class Acting:
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
        model: The model.
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


def joined(parts: Sequence[Acting]) -> Acting:
    """What acts in the states of several parts."""
    names = (one.name for one in fields(Acting))
    return Acting(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _beyond(values: FloatArray, limits: FloatArray) -> BoolArray:
    """Which values are at an end of their range, or past it."""
    near = 1e-9 * (limits[:, 1] - limits[:, 0])
    return (values <= limits[:, 0] + near) | (values >= limits[:, 1] - near)


@dataclass(frozen=True, slots=True)
class _Member:
    """One number of a kind: whose it is, where it is, and of a limit in which states (n,) it acts."""

    of: str
    cells: tuple[Cells, ...]
    acts: BoolArray | None = None


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
    taken = edits.taken
    found = [
        Assumed("held", f"{p.name}, measured before", f"{held.value:.3g}", cells, *_change(p, held, mode))
        for p, held, cells, mode in edits.considered()
    ]
    for setting, kind, members in (*_drives(model, acts), *_joints(model, acts)):
        free = [member for member in members if not _set(member.cells, taken)]
        found += _grouped(model, setting, kind, getattr(settings, setting), free)
    found += _gears(model, system.settings.identify.geared, settings, taken)
    found += _ranges(model, settings.joint_limit, acts.joint)
    found += _centres(model, edits, settings.center_of_mass, felt)
    found += _masses(model, settings.mass, taken)
    found += _places(model, settings.geometry, taken)
    found += _tilts(model, settings.gravity, taken)
    found += _biases(system, settings.force_bias, largest, taken)
    if edits.prompt:
        late = settings.command_delay
        what = "commands that act at once"
        found.append(Assumed("command_delay", what, "", edits.prompt, "add", late, 1000.0 * late, "ms"))
    return found


def _change(parameter: Parameter, held: Held, mode: Mode) -> tuple[Mode, float, float, str]:
    """How far off the numbers of a held parameter may be: by a share of them, or by so much."""
    share = held.sd / max(abs(held.value), 1e-12)
    if mode == "scale" or (mode == "value" and share < _HALF):
        share = min(share, _HALF)
        return "scale", share, 100.0 * share, "%"
    return "add", held.sd, held.sd, parameter.unit


def _set(cells: Sequence[Cells], taken: Collection[tuple[str, int]]) -> bool:
    return any((one.field, one.row) in taken for one in cells)


#: Setting of a kind of numbers, what the kind is called, and the numbers.
_Kind = tuple[str, str, list[_Member]]


def _drives(model: mujoco.MjModel, acts: Acting) -> Iterator[_Kind]:
    """Gains and limits of actuators; of actuators that amhe added, which play measured forces, none."""
    rows = [row for row in range(model.nactuator) if _own(model.actuator(row).name)]

    def acting_on(hit: BoolArray, column: Callable[[int], int] = int) -> Iterator[tuple[int, str, BoolArray]]:
        return ((r, model.actuator(r).name, hit[:, column(r)]) for r in rows if hit[:, column(r)].any())

    def control(row: int) -> int:
        return int(model.actuator_ctrladr[row])

    driving, limited = list(acting_on(acts.driving)), acting_on(acts.force)
    yield "gain", "gain", [_Member(name, tuple(gain_cells(model, r))) for r, name, _ in driving]
    velocity = [_Member(name, tuple(_velocity_gain(model, r))) for r, name, _ in driving]
    yield "gain", "velocity gain", velocity
    ends = [_Member(n, tuple(range_cells(model, "actuator_forcerange", r)), hit) for r, n, hit in limited]
    yield "force_limit", "force limit", ends
    ends = [
        _Member(name, tuple(range_cells(model, "actuator_ctrlrange", control(row))), hit)
        for row, name, hit in acting_on(acts.ctrl, control)
    ]
    yield "ctrl_limit", "control limit", ends


def _velocity_gain(model: mujoco.MjModel, row: int) -> list[Cells]:
    """The velocity term of a position servo, where it has one of its own."""
    if int(model.actuator_biastype[row]) != mujoco.mjtBias.mjBIAS_AFFINE:
        return []
    cells = Cells("actuator_biasprm", row, (2,), -1.0)
    return [cells] if model.actuator_biasprm[row, 2] and cells not in gain_cells(model, row) else []


def _joints(model: mujoco.MjModel, acts: Acting) -> Iterator[_Kind]:
    """Damping, armature, dry friction, stiffness and force limits of joints, where the model has any."""
    joints = [(row, model.joint(row).name) for row in range(model.njnt) if model.joint(row).name]
    for field, setting, kind in _BY_DOF:
        values = getattr(model, field)
        each = [(name, [dof for dof in _dofs(model, row) if values[dof]]) for row, name in joints]
        yield setting, kind, [_Member(n, tuple(Cells(field, dof) for dof in dofs)) for n, dofs in each]
    springs = [_Member(n, (Cells("jnt_stiffness", r),)) for r, n in joints if np.any(model.jnt_stiffness[r])]
    yield "stiffness", "stiffness", springs
    ends = [
        _Member(name, tuple(range_cells(model, "jnt_actfrcrange", row)), acts.joint_force[:, row])
        for row, name in joints
        if acts.joint_force[:, row].any()
    ]
    yield "force_limit", "force limit", ends


def _dofs(model: mujoco.MjModel, row: int) -> range:
    begin = int(model.jnt_dofadr[row])
    later = [int(adr) for adr in model.jnt_dofadr if adr > begin]
    return range(begin, min(later, default=model.nv))


def _own(name: str, unnamed: str = "") -> str:
    return "" if name.startswith("amhe/") else name or unnamed


def _grouped(
    model: mujoco.MjModel, setting: str, kind: str, share: float, members: Sequence[_Member]
) -> Iterator[Assumed]:
    """Numbers of one kind; those that are equal are one."""
    groups: dict[float, list[_Member]] = {}
    for member in members:
        if member.cells:
            value = float(f"{member.cells[0].of(model)[0]:.6g}")
            groups.setdefault(value, []).append(member)
    for value, equal in groups.items():
        names = [member.of for member in equal]
        more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
        cells = tuple(cell for member in equal for cell in member.cells)
        acts = [member.acts for member in equal if member.acts is not None]
        share_of_steps = float(np.any(acts, axis=0).mean()) if acts else None
        yield Assumed(
            setting, f"the {kind} of {', '.join(names[:_LISTED])}{more}", f"{value:g}", cells, "scale", share,
            100.0 * share, "%", share_of_steps,
        )  # fmt: skip


def _ranges(model: mujoco.MjModel, share: float, hit: BoolArray) -> Iterator[Assumed]:
    for row in map(int, np.flatnonzero(hit.any(axis=0))):
        sd = share * float(np.ptp(model.jnt_range[row]))
        ends = (Cells("jnt_range", row, (1,)), Cells("jnt_range", row, (0,), -1.0))
        name = f"the range of joint {model.joint(row).name}"
        yield Assumed(
            "joint_limit", name, "", ends, "add", sd, 100.0 * share, "% of it", float(hit[:, row].mean())
        )


def _gears(
    model: mujoco.MjModel,
    geared: Sequence[str],
    settings: AssumedSettings,
    taken: Collection[tuple[str, int]],
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
        share, rest, stiffness = (
            settings.load_friction / np.sqrt(2.0),
            settings.stribeck * dry,
            settings.spring,
        )
        stiffness *= weight * lever
        for setting, word, what, sd, unit in (
            ("load_friction", "load_friction_motor", "whatever its motor does", share, "% of the torque"),
            ("load_friction", "load_friction_external", "whatever its load", share, "% of the load"),
            ("stribeck", "stribeck_friction", "also at rest", rest, "N m"),
        ):
            cells = tuple(number_cells(model, row, word))
            if sd and not _set(cells, taken):
                what = f"the constant friction of {name}, {what}"
                amount = 100.0 * sd if unit.startswith("%") else sd
                yield Assumed(setting, what, "", cells, "add", sd, amount, unit, grows=True)
        spring = (Cells("jnt_stiffness", row),)
        if stiffness and not _set(spring, taken) and not np.any(model.jnt_stiffness[row]):
            yield Assumed(
                "spring", f"no spring at {name}", "", spring, "add", stiffness, stiffness, "N m/rad"
            )


def _moving(model: mujoco.MjModel) -> list[int]:
    """Bodies that move and have a mass; not those that amhe added."""
    rows = (row for row in range(model.nbody) if model.body_weldid[row] and _own(model.body(row).name, "?"))
    return [row for row in rows if model.body_mass[row] > 0.0]


def _centres(
    model: mujoco.MjModel, edits: ModelEdits, length: float, felt: Collection[str]
) -> Iterator[Assumed]:
    """Centres of mass of bodies whose mass is unknown."""
    placed = {cells.row for cells in edits.cells if cells.field == "body_ipos"}
    weighed = {
        cells.row
        for parameter, written in edits.by_parameter()
        for cells in written
        if cells.field == "body_mass" and parameter.name in felt
    }
    for row in sorted(weighed - placed):
        for axis, name in enumerate(_AXES):
            what = f"the centre of mass of {model.body(row).name} along {name}"
            cells = (Cells("body_ipos", row, (axis,)),)
            yield Assumed("center_of_mass", what, "", cells, "add", length, 1000.0 * length, "mm")


def _masses(model: mujoco.MjModel, share: float, taken: Collection[tuple[str, int]]) -> Iterator[Assumed]:
    """One scale of all bodies that move and that no parameter weighs: their model has one author."""
    rows = [row for row in _moving(model) if ("body_mass", row) not in taken]
    inertias = [Cells("body_inertia", row, (0, 1, 2)) for row in rows if ("body_inertia", row) not in taken]
    if rows:
        total = float(model.body_mass[rows].sum())
        cells = (*(Cells("body_mass", row) for row in rows), *inertias)
        value = f"{total:.3g} kg"
        yield Assumed("mass", "the masses of the links", value, cells, "scale", share, 100.0 * share, "%")


def _places(model: mujoco.MjModel, share: float, taken: Collection[tuple[str, int]]) -> Iterator[Assumed]:
    """Where each link stands on the one before it: the length of that one."""
    for row in _moving(model):
        parent, place = int(model.body_parentid[row]), model.body_pos[row]
        if model.body_weldid[parent] and np.any(place) and ("body_pos", row) not in taken:
            name, base = _own(model.body(row).name, "a body"), _own(model.body(parent).name, "its parent")
            what = f"the place of {name} on {base}"
            cells = (Cells("body_pos", row, (0, 1, 2)),)
            value = f"{float(np.linalg.norm(place)):.3g} m"
            yield Assumed("geometry", what, value, cells, "scale", share, 100.0 * share, "%")


def _tilts(model: mujoco.MjModel, angle: float, taken: Collection[tuple[str, int]]) -> Iterator[Assumed]:
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
        what = f"the base's tilt about {name}"
        yield Assumed("gravity", what, "level", tuple(cells), "add", angle, angle, "rad")


def _biases(
    system: System, share: float, largest: Mapping[str, float], taken: Collection[tuple[str, int]]
) -> Iterator[Assumed]:
    """Zeros of the force and torque sensors that are compared."""
    calibration = _with_biases(system)
    for channel in _forces(system):
        sd, unit = share * largest[channel.key], "% of its largest value"
        for axis, row in zip(_AXES, calibration.readings[channel.key].bias, strict=False):
            if ("calibration", row) not in taken:
                what = f"the bias of {channel.key} along {axis}"
                yield Assumed(
                    "force_bias", what, "", (Cells("calibration", row),), "add", sd, 100.0 * share, unit
                )
