"""A belief as ranges of the model's numbers, for the randomisation of trainings.

`mjlab.py` and `isaaclab.py` make a Python file of the 90 % intervals of the model's own numbers under draws
of the belief, whatever the parameters set: a value, a factor, a whole inertia.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np

from amhe_cli import __version__
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.core.statistics import correlation
from amhe_cli.system.system import System

#: Draws of the belief that intervals are taken from, and the seed of their generator.
DRAWS, SEED = 10_000, 0
#: Correlations from this size on are named in the file.
STRONG = 0.5

_ENDS = (5.0, 95.0)


@dataclass(frozen=True, slots=True)
class Term:
    """One entry of a training's randomisation.

    Args:
        name: Name of the entry.
        function: The function that it calls.
        selector: Keyword and names of what it is about, such as ('joint_names', ['hip']).
        values: The function's other arguments.
    """

    name: str
    function: str
    selector: tuple[str, Sequence[str]]
    values: Mapping[str, object]


@dataclass(eq=False)
class Drawn:
    """Numbers of a model under draws of a belief.

    Args:
        system: The system.
        model: Its model under the belief's estimate.
        theta: The draws within the bounds, shape (n, d).
        arrays: Field of the model -> draws (n, ...).
        used: Fields and rows that terms were made of.
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


def drawn(system: System, belief: Belief) -> Drawn:
    """The numbers of a system's model that its parameters set, under draws of a belief about them."""
    space = system.space.with_prior(belief)
    low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("lower", "upper"))
    theta = np.clip(belief.sample(DRAWS, SEED), low, high)
    arrays = {
        name: np.repeat(np.asarray(getattr(system.model, name), dtype=np.float64)[None], DRAWS, axis=0)
        for name in system.edits.fields
    }
    system.edits.write(arrays, theta)
    return Drawn(system, system.edits.apply(system.model, space.nominal), theta, arrays)


def ends(values: FloatArray) -> tuple[float, float]:
    """5 % and 95 % quantile of draws, with five digits."""
    low, high = np.percentile(values, _ENDS)
    return float(f"{low:.5g}"), float(f"{high:.5g}")


def servos(found: Drawn) -> Iterator[tuple[int, tuple[float, float], tuple[float, float]]]:
    """Row of each position servo that parameters set, with the intervals of its two gains."""
    for row in found.rows("actuator_gainprm", "actuator_biasprm"):
        gain, bias = found.model.actuator_gainprm[row, 0], found.model.actuator_biasprm[row]
        if gain and np.isclose(bias[1], -gain):
            kd = found.range("actuator_biasprm", [row], 2, -1.0)
            yield row, found.range("actuator_gainprm", [row], 0), kd


def head(system: System, belief: Belief, tool: str, checked: str, found: Drawn, use: str) -> str:
    """Docstring of the file, and comments on what is not in it."""
    left = "".join(f"# {line}\n" for line in _left_out(system, belief, found))
    missing = f"#\n# Identified, but not in these terms:\n{left}" if left else ""
    return f'''"""What amhe {__version__} identified of {system.name}, as randomisation for {tool}.

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
    one, other = np.unravel_index(matrix.argmax(), matrix.shape)
    return f"that of {belief.names[one]} and {belief.names[other]} is {matrix.max():.2f} here."


def _left_out(system: System, belief: Belief, found: Drawn) -> Iterator[str]:
    """A line for each parameter that moves a number which no term covers, or none of the model's."""
    for column, name in enumerate(belief.names):
        moved = _moved(system, belief, column)
        if moved and moved <= found.used:
            continue
        low, high = ends(found.theta[:, column])
        what = "" if system.sets[name] == name else f": {system.sets[name]}"
        yield f"{name}, {low:g} to {high:g}{what}"


def _moved(system: System, belief: Belief, column: int) -> set[tuple[str, int]]:
    """Fields and rows of the model that a parameter moves."""
    theta = np.tile(belief.estimate, (2, 1))
    theta[1] = np.where(np.arange(theta.shape[1]) == column, belief.given({}).sample(1, SEED)[0], theta[1])
    arrays = {
        name: np.repeat(np.asarray(getattr(system.model, name), dtype=np.float64)[None], 2, axis=0)
        for name in system.edits.fields
    }
    system.edits.write(arrays, theta)
    return {
        (name, int(row))
        for name, (one, other) in arrays.items()
        for row in np.unique(np.nonzero(one != other)[0])
    }


def selected(term: Term, kind: Callable[[list[str]], object]) -> str:
    """Names as regular expressions, which both tools take them for."""
    keyword, names = term.selector
    return f"{keyword}={code(kind([re.escape(name) for name in names]))}"


def code(value: object) -> str:
    """A value as Python text, with the quotes of the rest of the file."""
    return repr(value).replace("'", '"')


def joint_of(model: mujoco.MjModel, name: str, row: int) -> str:
    """Name of the joint that a row of a field `dof_...` or `jnt_...` belongs to."""
    return model.joint(int(model.dof_jntid[row]) if name.startswith("dof_") else row).name


def term_name(elements: Sequence[str], what: str) -> str:
    """A name that Python takes: 'hip_damping', 'hip_and_3_more_damping'."""
    first = elements[0] if len(elements) == 1 else f"{elements[0]}_and_{len(elements) - 1}_more"
    return re.sub(r"\W+", "_", f"{first}_{what}")
