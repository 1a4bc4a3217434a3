"""A belief as a Python file for the randomisation of trainings: 90 % intervals of the model's own numbers.

The intervals are those under draws of the belief, whatever its parameters set: a value, a factor, a whole
inertia. `mjlab.py` and `isaaclab.py` name the terms and the text about them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import indent

import mujoco
import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.core.statistics import correlation
from amhe_cli.system.system import System

#: Draws of the belief that intervals are taken from.
DRAWS = 10_000
#: Seed of their generator.
SEED = 0
#: Correlations from this size on are named in the file.
STRONG = 0.5

_ENDS = (5.0, 95.0)
_TERM = """EventTermCfg(
    func={function},
    mode="startup",
    params={{
        "asset_cfg": SceneEntityCfg({entity}, {selector}),
{values}    }},
)"""


@dataclass(frozen=True, slots=True)
class Event:
    """One entry of a training's randomisation.

    Args:
        what: What is randomised, for the entry's name: 'damping'.
        function: The function that it calls.
        kind: What it is about: 'joint', 'body', 'actuator', 'geom' or 'pair'.
        names: The names of those.
        values: The function's other arguments.
    """

    what: str
    function: str
    kind: str
    names: Sequence[str]
    values: Mapping[str, object]

    @property
    def name(self) -> str:
        """A name that Python takes: 'hip_damping', 'hip_and_3_more_damping'."""
        first = self.names[0] if len(self.names) == 1 else f"{self.names[0]}_and_{len(self.names) - 1}_more"
        return re.sub(r"\W+", "_", f"{first}_{self.what}")


@dataclass(eq=False)
class Drawn:
    """Numbers of a model under draws of a belief.

    Args:
        system: The system.
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

    def columns(self, name: str, row: int) -> set[int]:
        """Columns of a row that parameters set."""
        return {
            column for c in self.system.edits.cells if (c.field, c.row) == (name, row) for column in c.columns
        }

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

    def servos(self) -> Iterator[tuple[int, tuple[float, float], tuple[float, float]]]:
        """Row of each position servo that parameters set, with the intervals of its two gains."""
        for row in self.rows("actuator_gainprm", "actuator_biasprm"):
            gain, bias = self.model.actuator_gainprm[row, 0], self.model.actuator_biasprm[row]
            if gain and np.isclose(bias[1], -gain):
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
        actuators: Code of the identified actuators, and lines about what is lost in it.
    """

    events: Callable[[Drawn], Iterable[Event]]
    head: Sequence[str]
    entity: str
    names: Callable[[list[str]], Sequence[str]]
    entry: str
    text: str
    actuators: Callable[[Drawn], tuple[str, Sequence[str]]]


def randomisation(system: System, belief: Belief, tool: Tool) -> str:
    """Python file of a belief's intervals as events of a tool, and of its actuators."""
    draws = _drawn(system, belief)
    entries = []
    for event in tool.events(draws):
        selector = f"{event.kind}_names={code(tool.names([re.escape(name) for name in event.names]))}"
        values = "".join(f'        "{key}": {code(value)},\n' for key, value in event.values.items())
        term = _TERM.format(function=event.function, entity=tool.entity, selector=selector, values=values)
        spaces = tool.entry[: len(tool.entry) - len(tool.entry.lstrip())]
        entries.append(indent(tool.entry.lstrip().format(event.name, term), spaces))
    actuators, lost = tool.actuators(draws)
    late = system.edits.late if actuators else frozenset()
    head = _head(draws, belief, [*_left_out(draws, belief, late), *lost], *tool.head)
    return head + tool.text.replace("$entries", "\n".join(entries)) + actuators


def ends(values: FloatArray) -> tuple[float, float]:
    """5 % and 95 % quantile of draws, with five digits."""
    low, high = np.percentile(values, _ENDS)
    return float(f"{low:.5g}"), float(f"{high:.5g}")


def code(value: object) -> str:
    """A value as Python text, with the quotes of the rest of the file."""
    return repr(value).replace("'", '"')


def _drawn(system: System, belief: Belief) -> Drawn:
    space = system.space.with_prior(belief)
    low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("lower", "upper"))
    theta = np.clip(belief.sample(DRAWS, SEED), low, high)
    return Drawn(system, system.edits.apply(system.model, space.nominal), theta, _written(system, theta))


def _written(system: System, theta: FloatArray) -> dict[str, FloatArray]:
    """Fields of the model that parameters set, under each row of theta (n, d)."""
    arrays = {
        name: np.repeat(np.asarray(getattr(system.model, name), dtype=np.float64)[None], len(theta), axis=0)
        for name in system.edits.fields
    }
    system.edits.write(arrays, theta)
    return arrays


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
    for column, name in enumerate(belief.names):
        moved = _moved(draws.system, belief, column)
        if (moved or name in late) and moved <= draws.used:
            continue
        low, high = ends(draws.theta[:, column])
        what = "" if draws.system.sets[name] == name else f": {draws.system.sets[name]}"
        yield f"{name}, {low:g} to {high:g}{what}"


def _moved(system: System, belief: Belief, column: int) -> set[tuple[str, int]]:
    """Fields and rows of the model that a parameter moves."""
    theta = np.tile(belief.estimate, (2, 1))
    theta[1, column] = belief.given({}).sample(1, SEED)[0, column]
    return {
        (name, int(row))
        for name, (before, after) in _written(system, theta).items()
        for row in np.unique(np.nonzero(before != after)[0])
    }
