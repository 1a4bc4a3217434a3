"""Rulers: numbers of the model that are taken as exact and can set the scale of the estimates.

Forces of a servo are known as well as its gain, and where it saturates, as well as its limit. Masses follow,
as they do from a force sensor, whose zero drifts. Where gains are unknown, they follow from the masses.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import mujoco
import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.parameters import Parameter, ParameterSpace
from amhe_cli.system.description.data import Channel
from amhe_cli.system.description.targets import gain_cells
from amhe_cli.system.model.files import compiled
from amhe_cli.system.parameters.calibration import SignalCalibration
from amhe_cli.system.parameters.cells import Cells, range_cells
from amhe_cli.system.parameters.edits import Mode
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.system import System

#: Elements of one ruler that its name lists.
_LISTED = 3


@dataclass(frozen=True, slots=True)
class Ruler:
    """One number, or several that are equal and stand on one data sheet.

    Args:
        name: What it is, such as 'the force limit of servo3 (0.5)'.
        acts: Share of the steps in which it acts; None for what always does.
        cells: The numbers.
        mode: Whether a change is multiplied onto them or added to them.
        sd: How far it may be off: a share where multiplied [-], else in the number's own unit.
        change: `sd` in words.
    """

    name: str
    acts: float | None
    cells: tuple[Cells, ...]
    mode: Mode
    sd: float
    change: str

    @property
    def parameter(self) -> Parameter:
        """The ruler as a parameter, which z = 1 changes by one sd."""
        if self.mode == "scale":
            # on the log scale 10 % less is further away than 10 % more
            return Parameter(self.name, "-", 1.0, 1e-3, 1e3, log=True, prior_sd=-float(np.log1p(-self.sd)))
        return Parameter(self.name, "-", 0.0, -np.inf, np.inf, log=False, prior_sd=self.sd)


def with_rulers(system: System, rulers: Sequence[Ruler]) -> System:
    """The system with rulers as further parameters."""
    model = _general(system, rulers)
    more: list[tuple[Parameter, tuple[Cells, ...], Mode]] = [
        (ruler.parameter, ruler.cells, ruler.mode) for ruler in rulers
    ]
    calibration = _with_biases(system)
    edits = system.edits.extended(model, more, calibration)
    space = ParameterSpace((*system.space.parameters, *(ruler.parameter for ruler in rulers)))
    return replace(system, model=model, space=space, edits=edits, calibration=calibration)


def _with_biases(system: System) -> SignalCalibration:
    """The system's calibration with a bias of each force and torque that is compared."""
    return system.calibration.biased({channel.key: len(channel.columns) for channel in _forces(system)})


def _forces(system: System) -> list[Channel]:
    """Forces and torques that are compared."""
    return [c for c in system.channels if c.compared and c.key.rsplit(".", 1)[1] in ("force", "torque")]


def _general(system: System, rulers: Sequence[Ruler]) -> mujoco.MjModel:
    """The model without values; bodies whose centre of mass a ruler moves without MuJoCo's short cuts."""
    rows = {cells.row for ruler in rulers for cells in ruler.cells if cells.field == "body_ipos"}
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


def rulers_of(
    system: System, acts: Acting, felt: Collection[str], largest: Mapping[str, float]
) -> list[Ruler]:
    """The rulers that act and that no parameter sets.

    Args:
        system: The system; its settings say how far each kind may be off, 0 that it is exact.
        acts: What acts in its rollouts.
        felt: Parameters that the logs depend on.
        largest: Key of a channel -> largest value that the logs have of it.
    """
    model, edits, settings = system.model, system.edits, system.settings.identify.rulers
    unknown = {(cells.field, cells.row) for cells in edits.cells}
    groups: dict[tuple[str, float], list[tuple[str, tuple[Cells, ...], BoolArray]]] = {}

    def add(
        kind: str, names: Sequence[str], rows: Sequence[int], cells: Sequence[list[Cells]], hit: BoolArray
    ) -> None:
        for name, row, own in zip(names, rows, cells, strict=True):
            if name and own and hit[:, row].any() and (own[0].field, own[0].row) not in unknown:
                value = float(f"{own[0].of(model)[0]:.6g}")
                groups.setdefault((kind, value), []).append((name, tuple(own), hit[:, row]))

    every = range(model.nactuator)
    # those that amhe added play measured forces
    actuators = [_own(model.actuator(row).name) for row in every]
    joints = [model.joint(row).name for row in range(model.njnt)]
    controls = [int(row) for row in model.actuator_ctrladr]
    add("gain", actuators, every, [gain_cells(model, row) for row in every], acts.driving)
    limits = [range_cells(model, "actuator_forcerange", row) for row in every]
    add("force limit", actuators, every, limits, acts.force)
    add(
        "control limit",
        actuators,
        controls,
        [range_cells(model, "actuator_ctrlrange", c) for c in controls],
        acts.ctrl,
    )
    limits = [range_cells(model, "jnt_actfrcrange", row) for row in range(model.njnt)]
    add("force limit", joints, range(model.njnt), limits, acts.joint_force)
    shares = {
        "gain": settings.gain,
        "force limit": settings.force_limit,
        "control limit": settings.ctrl_limit,
    }
    found = [_scaled(kind, value, members, shares[kind]) for (kind, value), members in groups.items()]
    found += _ranges(model, settings.joint_limit, acts.joint)
    found += _centres(model, edits, settings.center_of_mass, felt)
    found += _masses(model, settings.mass, unknown)
    found += _biases(system, settings.force_bias, largest)
    if edits.prompt:
        late = settings.command_delay
        found.append(
            Ruler("commands that act at once", None, edits.prompt, "add", late, f"{1000.0 * late:g} ms")
        )
    return found


def _own(name: str, unnamed: str = "") -> str:
    return "" if name.startswith("amhe/") else name or unnamed


def _scaled(
    kind: str, value: float, members: Sequence[tuple[str, tuple[Cells, ...], BoolArray]], share: float
) -> Ruler:
    names = [name for name, _, _ in members]
    listed = ", ".join(names[:_LISTED]) + (
        f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    )
    hit = np.any([where for _, _, where in members], axis=0)
    cells = tuple(cell for _, own, _ in members for cell in own)
    acts = None if kind == "gain" else float(hit.mean())
    return Ruler(f"the {kind} of {listed} ({value:g})", acts, cells, "scale", share, f"{share:.0%}")


def _ranges(model: mujoco.MjModel, share: float, hit: BoolArray) -> Iterator[Ruler]:
    for row in map(int, np.flatnonzero(hit.any(axis=0))):
        sd = share * float(np.ptp(model.jnt_range[row]))
        ends = (Cells("jnt_range", row, (1,)), Cells("jnt_range", row, (0,), -1.0))
        acts = float(hit[:, row].mean())
        yield Ruler(
            f"the range of joint {model.joint(row).name}", acts, ends, "add", sd, f"{share:.0%} of it"
        )


def _centres(
    model: mujoco.MjModel, edits: ModelEdits, length: float, felt: Collection[str]
) -> Iterator[Ruler]:
    """Centres of mass of bodies whose mass is unknown."""
    placed = {cells.row for cells in edits.cells if cells.field == "body_ipos"}
    weighed = {
        cells.row
        for parameter, written in edits.by_parameter()
        for cells in written
        if cells.field == "body_mass" and parameter.name in felt
    }
    for row in sorted(weighed - placed):
        for axis, name in enumerate("xyz"):
            what = f"the centre of mass of {model.body(row).name} along {name}"
            yield Ruler(
                what, None, (Cells("body_ipos", row, (axis,)),), "add", length, f"{1000.0 * length:g} mm"
            )


def _masses(model: mujoco.MjModel, share: float, unknown: Collection[tuple[str, int]]) -> Iterator[Ruler]:
    """One scale of all bodies that move and that no parameter weighs: their model has one author."""
    moving = (row for row in range(model.nbody) if model.body_weldid[row] and _own(model.body(row).name, "?"))
    rows = [row for row in moving if model.body_mass[row] > 0.0 and ("body_mass", row) not in unknown]
    inertias = [Cells("body_inertia", row, (0, 1, 2)) for row in rows if ("body_inertia", row) not in unknown]
    if rows:
        total = float(model.body_mass[rows].sum())
        cells = (*(Cells("body_mass", row) for row in rows), *inertias)
        yield Ruler(f"the masses of the links ({total:.3g} kg)", None, cells, "scale", share, f"{share:.0%}")


def _biases(system: System, share: float, largest: Mapping[str, float]) -> Iterator[Ruler]:
    """Zeros of the force and torque sensors that are compared."""
    calibration = _with_biases(system)
    for channel in _forces(system):
        sd, change = share * largest[channel.key], f"{share:.0%} of its largest value"
        for axis, row in zip("xyz", calibration.readings[channel.key].bias, strict=False):
            if row not in calibration.set_rows:
                what = f"the bias of {channel.key} along {axis}"
                yield Ruler(what, None, (Cells("calibration", row),), "add", sd, change)
