"""A belief as a Python file for trainings: 90 % intervals of the model's own numbers, and its actuators.

The intervals are those under draws of the belief, whatever its parameters set: a value, a factor, a whole
inertia. `trainings.py` names the terms of each tool, and the text about them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import indent

import mujoco
import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.belief import Belief, with_prior
from amhe_cli.core.statistics import correlation
from amhe_cli.system.model.elements import holds_position
from amhe_cli.system.parameters.gear_friction import GearFriction
from amhe_cli.system.parameters.servos import BIAS, OF_SERVO, SERVOS
from amhe_cli.system.system import System

#: Draws of the belief that intervals are taken from, and the seed of their generator.
DRAWS, SEED = 10_000, 0
#: Correlations from this size on are named in the file.
STRONG = 0.5
#: Poses that a joint's usual load is taken from.
_POSES = 200

_ENDS = (5.0, 95.0)
_SINGLE = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_TERM = """EventTermCfg(
    func={function},
    mode="startup",
    params={{
        "asset_cfg": SceneEntityCfg({entity}, {selector}),
{values}    }},
)"""
_ACTUATORS = '''

def identified_actuators(timestep: float = {timestep}):
    """Actuators with the identified numbers.

    {use}
    They are the model's position servos; other actuators of it need a configuration of their own. A delay is
    drawn between its ends, in whole physics steps of `timestep` [s].
    """
    from {module} import {name}

    def steps(seconds):
        return round(seconds / timestep)

    return {opening}
{entries}
    {closing}
'''


@dataclass(frozen=True, slots=True)
class Event:
    """One entry of a training's randomisation.

    Args:
        what: What is randomised, for the entry's name: 'damping'.
        function: The function that it calls.
        kind: What it is about: 'joint', 'body', 'actuator', 'geom' or 'pair'.
        names: The names of those.
        values: The function's other arguments.
        other: Another name of the only one of those.
    """

    what: str
    function: str
    kind: str
    names: Sequence[str]
    values: Mapping[str, object]
    other: str | None = None

    @property
    def name(self) -> str:
        """A name that Python takes: 'hip_damping', 'hip_and_3_more_damping'."""
        first = self.names[0] if len(self.names) == 1 else f"{self.names[0]}_and_{len(self.names) - 1}_more"
        return re.sub(r"\W+", "_", f"{first}_{self.what}")


@dataclass(eq=False)
class Drawn:
    """Numbers of a model under draws of a belief.

    Args:
        model: Its model under the belief's estimate.
        theta: The draws within the bounds, shape (n, d).
        arrays: Field of the model -> draws (n, ...).
        used: Fields and rows that events were made of.
    """

    system: System
    model: mujoco.MjModel
    theta: FloatArray
    arrays: Mapping[str, FloatArray]
    used: set[tuple[str, int]] = field(default_factory=set)

    def range(
        self, name: str, rows: Sequence[int], column: int | None = None, sign: float = 1.0
    ) -> tuple[float, float]:
        """90 % interval of a number that some rows share; one that no parameter sets is the model's own."""
        self.used |= {(name, row) for row in rows}
        source = self.arrays.get(name, np.asarray(getattr(self.model, name))[None])
        values = source[:, rows[0]] if column is None else source[:, rows[0], column]
        return ends(sign * values)

    def rows(self, *names: str) -> list[int]:
        """Rows of some fields that parameters move; a fixed parameter moves none."""
        rows = {(c.field, c.row) for c in self.system.edits.cells if c.field in names}
        return sorted({row for name, row in rows if np.ptp(self.arrays[name][:, row], axis=0).any()})

    def columns(self, name: str, row: int) -> list[int]:
        """Columns of a row that parameters set."""
        cells = (c for c in self.system.edits.cells if (c.field, c.row) == (name, row))
        return sorted({column for c in cells for column in c.columns})

    def tied(self, name: str, rows: Sequence[int], column: int | None = None) -> Iterator[list[int]]:
        """The rows, those together that are the same number in every draw."""
        groups: dict[bytes, list[int]] = {}
        for row in rows:
            values = self.arrays[name][:, row]
            groups.setdefault((values if column is None else values[:, column]).tobytes(), []).append(row)
        yield from groups.values()

    def joint(self, name: str, row: int) -> str:
        """Name of the joint that a row of a field `dof_...` or `jnt_...` belongs to."""
        return self.model.joint(int(self.model.dof_jntid[row]) if name.startswith("dof_") else row).name

    def gains(self) -> Iterator[tuple[int, tuple[float, float], tuple[float, float]]]:
        """Row of each position servo that parameters set, with the intervals of its two gains."""
        for row in self.rows("actuator_gainprm", "actuator_biasprm"):
            if holds_position(self.model, row):
                kd = self.range("actuator_biasprm", [row], 2, -1.0)
                yield row, self.range("actuator_gainprm", [row], 0), kd


@dataclass(frozen=True, slots=True)
class Tool:
    """How a tool that trains takes a belief.

    Args:
        events: The events of a model's numbers under draws.
        head: Its name and version, a line of code that takes the file's events, and a sentence that says how
            files of this kind were checked.
        entity: Code of the robot's name.
        names: The collection that it takes names as: tuple or list.
        entry: Form of an entry, with its name and its text for the braces; its spaces stand before each line.
        text: The rest of the file, with `$entries` in the entries' place.
        actuator: Module and class of its actuators, what stands around them, and how they are used.
        arguments: Arguments of that class -> what of `_servos` they are, or their value.
    """

    events: Callable[[Drawn], Iterable[Event]]
    head: Sequence[str]
    entity: str
    names: Callable[[list[str]], Sequence[str]]
    entry: str
    text: str
    actuator: tuple[str, str, str, str]
    arguments: Mapping[str, object]


def randomisation(system: System, belief: Belief, tool: Tool) -> str:
    """Python file of a belief's intervals as events of a tool, and of its actuators."""
    space = with_prior(system.space, belief)
    low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("lower", "upper"))
    theta = np.clip(belief.sample(DRAWS, SEED), low, high)
    model, arrays = system.edits.apply(system.model, space.nominal), system.edits.written(theta)
    _as_constants(model, arrays)
    draws = Drawn(system, model, theta, arrays)
    entries = []
    for event in tool.events(draws):
        names = [re.escape(name) for name in event.names]
        names[0] += f"|{re.escape(event.other)}" if event.other else ""
        selector = f"{event.kind}_names={_code(tool.names(names))}"
        values = "".join(f'        "{key}": {_code(value)},\n' for key, value in event.values.items())
        term = _TERM.format(function=event.function, entity=tool.entity, selector=selector, values=values)
        spaces = tool.entry[: len(tool.entry) - len(tool.entry.lstrip())]
        entries.append(indent(tool.entry.lstrip().format(event.name, term), spaces))
    actuators = _actuators(draws, tool)
    late = system.edits.late if actuators else frozenset()
    head = _head(draws, belief, [*_left_out(draws, belief, late), *_lost(model)], *tool.head)
    return head + tool.text.replace("$entries", "\n".join(entries)) + actuators


def ends(values: FloatArray) -> tuple[float, float]:
    """5 % and 95 % quantile of draws, with five digits."""
    low, high = np.percentile(values, _ENDS)
    return float(f"{low:.5g}"), float(f"{high:.5g}")


def _code(value: object) -> str:
    """A value as Python text, with the quotes of the rest of the file."""
    return repr(value).replace("'", '"')


def _head(draws: Drawn, belief: Belief, out: Sequence[str], tool: str, use: str, checked: str) -> str:
    """Docstring of the file, and comments on what is not in it."""
    left = "".join(f"# {line}\n" for line in out)
    missing = f"#\n# Identified, but not in these terms:\n{left}" if left else ""
    return f'''"""What amhe {__version__} identified of {draws.system.name}, as randomisation for {tool}.

    {use}

{checked}
Each range is the 90 % interval of one number of the model, drawn uniformly; the model to train with is the
identified one beside this file.
Ranges lose correlations: {_correlations(belief)}
Where that matters, use draws of the whole belief: `amhe export --to samples` keeps them.
"""
{missing}'''


def _correlations(belief: Belief) -> str:
    matrix = np.abs(np.triu(correlation(belief.covariance), 1))
    if matrix.size < 2 or matrix.max() < STRONG:
        return f"here none is larger than {STRONG:g}."
    row, column = np.unravel_index(matrix.argmax(), matrix.shape)
    return f"that of {belief.names[row]} and {belief.names[column]} is {matrix.max():.2f} here."


def _left_out(draws: Drawn, belief: Belief, late: Collection[str]) -> Iterator[str]:
    """A line for each parameter that moves a number which no event covers, or none of the model's.

    Actuators cover those that are `late`, which delay commands.
    """
    constants = set(_counted(draws))
    for column, name in enumerate(belief.names):
        theta = np.tile(belief.estimate, (2, 1))
        theta[1, column] = belief.given({}).sample(1, SEED)[0, column]
        written = draws.system.edits.written(theta).items()
        moved = {(key, int(row)) for key, (one, two) in written for row in np.nonzero(one != two)[0]}
        if not (moved or name in late) or not moved - constants <= draws.used:
            low, high = ends(draws.theta[:, column])
            what = "" if draws.system.sets[name] == name else f": {draws.system.sets[name]}"
            yield f"{name}, {low:g} to {high:g}{what}"


def _servos(draws: Drawn) -> Iterator[dict[str, object]]:
    """The model's position servos on hinges and slides, under the estimate, at their joints [SI].

    `shortest` and `longest` are the ends of its delay.
    """
    model, delays = draws.model, draws.system.edits.delays(draws.theta)
    for row in map(int, np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)):
        joint, gear = int(model.actuator_trnid[row, 0]), float(model.actuator_gear[row, 0])
        if not holds_position(model, row) or model.jnt_type[joint] not in _SINGLE:
            continue
        dof, limit = int(model.jnt_dofadr[joint]), model.actuator_forcerange[row, 1] * abs(gear)
        shortest, longest = ends(delays[:, min(row, delays.shape[1] - 1)])
        yield {
            "joint": model.joint(joint).name,
            "stiffness": float(model.actuator_gainprm[row, 0] * gear**2),
            "damping": float(-model.actuator_biasprm[row, 2] * gear**2),
            "effort": float(limit) if model.actuator_forcelimited[row] else None,
            "armature": float(model.dof_armature[dof]),
            "friction": float(model.dof_frictionloss[dof]),
            "viscous": float(np.ravel(model.dof_damping[dof])[0]),
            "shortest": shortest,
            "longest": longest,
        }


def _actuators(draws: Drawn, tool: Tool) -> str:
    """A function that returns the servos as the tool's configurations; empty where the model has none."""
    module, name, (opening, closing), use = tool.actuator
    entries = []
    for servo in _servos(draws):
        key = f"{_code(servo['joint'])}: " if opening == "{" else ""
        servo["joint"] = tool.names([re.escape(str(servo["joint"]))])
        values = ((a, of, servo.get(str(of), of)) for a, of in tool.arguments.items())
        given = (f"{a}={_argument(of, value)}" for a, of, value in values if value is not None)
        entries.append(f"        {key}{name}({', '.join(given)}),")
    if not entries:
        return ""
    return _ACTUATORS.format(
        timestep=draws.model.opt.timestep, use=use, module=module, name=name, opening=opening,
        entries="\n".join(entries), closing=closing,
    )  # fmt: skip


def _argument(of: object, value: object) -> str:
    """A value as Python text with five digits; a delay as the steps that it lasts."""
    if not isinstance(value, float):
        return _code(value)
    short = float(f"{value:.5g}")
    return f"steps({short})" if of in ("shortest", "longest") else repr(short)


def _constants(model: mujoco.MjModel) -> Iterator[tuple[str, tuple[int, ...], IntArray | list[int], float]]:
    """What tools have constants for: a field, a place in it, numbers of the model, and their factor there.

    Dry friction of a gear is that under gravity, motor against load; back-EMF is damping of the servo.
    """
    if (gears := GearFriction.of(model)) is not None:
        load = usual_load(model)
        for dof, at in zip(gears.dofs, gears.at, strict=True):
            yield "dof_frictionloss", (int(dof),), at[:2], float(load[dof])  # k_m + k_e
    back_emf = list(OF_SERVO).index("back_emf")
    for row, at in SERVOS.rows(model).items():
        yield BIAS, (row, 2), at[back_emf : back_emf + 1], -1.0


def _as_constants(model: mujoco.MjModel, arrays: Mapping[str, FloatArray]) -> None:
    """Write constants of a model, and of its draws, into the fields that every tool uses."""
    of_model = {name: getattr(model, name)[None] for name in ("numeric_data", "dof_frictionloss", BIAS)}
    for name, place, at, factor in _constants(model):
        for fields in (arrays, of_model):
            numbers = fields.get("numeric_data", of_model["numeric_data"])
            if name in fields:
                fields[name][:, *place] += factor * numbers[:, at].sum(axis=1)


def _counted(draws: Drawn) -> Iterator[tuple[str, int]]:
    """Numbers of gears and servos that events draw with those fields."""
    for name, (row, *_), at, _ in _constants(draws.model):
        if name in draws.arrays and (name, row) in draws.used:
            yield from (("numeric_data", int(number)) for number in at)


def usual_load(model: mujoco.MjModel) -> FloatArray:
    """Median force of gravity at each degree of freedom over poses within the joints' ranges, (nv,)."""
    rng, data = np.random.default_rng(SEED), mujoco.MjData(model)
    forces = np.zeros((_POSES, model.nv))
    single = np.flatnonzero(np.isin(model.jnt_type, _SINGLE))
    low, high = np.where(model.jnt_limited[single, None], model.jnt_range[single], (-np.pi, np.pi)).T
    for pose in forces:
        data.qpos[model.jnt_qposadr[single]] = rng.uniform(low, high)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        pose[:] = np.abs(data.qfrc_bias)
    return np.median(forces, axis=0)


def _lost(model: mujoco.MjModel) -> Iterator[str]:
    """Lines about what the actuators cannot say."""
    if SERVOS.acting(model, ()):
        yield (
            "firmware of servos: punch, dead band and sag of supply are not in the actuators; back-EMF is "
            "in their damping, which counts against the effort limit there"
        )
    if GearFriction.of(model) is not None:
        yield (
            "friction of gears: constant in the actuators, as under the median load of gravity; it neither "
            "grows with load nor falls with speed (examples/gear_friction.py is a hook for MuJoCo that "
            "applies it)"
        )
