"""Results by group: all seeds of one task, mode and setting together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.study.cells import Setting
from amhe_cli.study.results import CellResult
from amhe_cli.study.statistics import Difference, Spread, paired, rate, spread

RATES = ("success", "on_time", "fell")
MEASURES = ("goal_error_m", "speed_rmse", "cost", "time_s", "path_rmse_m")
#: Every interval is drawn from this seed, so that the same cells give the same digits.
_SEED = 0


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Seeds of one task, mode and setting.

    Args:
        task, mode, setting: Task, mode and setting that the seeds share.
        results: Results of the cells that were run, by seed.
        failed: Number of cells without a result.
    """

    task: str
    mode: str
    setting: Setting
    results: tuple[CellResult, ...]
    failed: int

    @property
    def n(self) -> int:
        """Number of seeds that count."""
        return len(self.results)

    def values(self, name: str) -> FloatArray:
        """A measure over the seeds, shape (n,)."""
        return np.array([result.measure(name) for result in self.results])

    def spread(self, name: str) -> Spread:
        """Spread of a measure or a rate."""
        if name in RATES:
            return rate(self.values(name))
        return spread(self.values(name), np.random.default_rng(_SEED))


class Groups:
    """All groups of a study, in a given order of tasks and modes; unknown ones come last.

    Args:
        results: Results of a study.
        base: Operating point of the study: the setting of the tables.
        tasks, modes: Order of tasks and modes.
    """

    def __init__(
        self, results: Iterable[CellResult], base: Setting, tasks: Sequence[str], modes: Sequence[str]
    ) -> None:
        self.base, self._modes = base, modes
        found: dict[tuple[str, str, Setting], list[CellResult]] = {}
        for result in sorted(results, key=lambda one: one.cell.seed):
            cell = result.cell
            found.setdefault((cell.task, cell.mode, cell.setting), []).append(result)

        def order(key: tuple[str, str, Setting]) -> tuple[Any, ...]:
            task, mode, setting = key
            listed = tuple((path, str(type(value)), value) for path, value in setting)
            return setting != base, listed, _rank(tasks, task), task, _rank(modes, mode), mode

        self._groups = {}
        for key in sorted(found, key=order):
            done = tuple(result for result in found[key] if result.reason is None)
            self._groups[key] = Group(*key, done, len(found[key]) - len(done))

    def __iter__(self) -> Iterator[Group]:
        """All groups in order."""
        return iter(self._groups.values())

    def get(self, task: str, mode: str, setting: Setting | None = None) -> Group | None:
        """One group, at the operating point where no setting is given."""
        return self._groups.get((task, mode, self.base if setting is None else setting))

    def at_base(self) -> list[Group]:
        """Groups at the operating point that have results."""
        return [group for group in self if group.setting == self.base and group.n]

    @property
    def tasks(self) -> list[str]:
        """Tasks that have results at the operating point."""
        return list(dict.fromkeys(group.task for group in self.at_base()))

    def of(self, task: str) -> list[Group]:
        """Groups of a task at the operating point, mode by mode."""
        return [group for group in self.at_base() if group.task == task]

    def modes_of(self, tasks: Iterable[str]) -> list[str]:
        """Modes in which any of the tasks has results, in order."""
        found = {group.mode for task in tasks for group in self.of(task)}
        return sorted(found, key=lambda mode: _rank(self._modes, mode))


def difference(group: Group, reference: Group, name: str) -> Difference:
    """Difference of a group from another on the seeds that both have."""
    other = {result.cell.seed: result for result in reference.results}
    both = [(result, other[result.cell.seed]) for result in group.results if result.cell.seed in other]
    values, references = (np.array([pair[i].measure(name) for pair in both]) for i in (0, 1))
    return paired(values, references, np.random.default_rng(_SEED))


def summary(groups: Iterable[Group]) -> list[dict[str, Any]]:
    """Content of summary.json."""
    return [
        {
            "task": group.task,
            "mode": group.mode,
            "setting": dict(group.setting),
            "n": group.n,
            "failed": group.failed,
            "measures": {name: group.spread(name).numbers for name in (*RATES, *MEASURES)},
        }
        for group in groups
    ]


def _rank(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else len(names)
