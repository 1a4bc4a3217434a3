"""Results by group, all seeds of one task, mode and setting together, with their statistics over seeds.

Spreads, bootstrap intervals of means and of paired differences, Wilson intervals of rates; and ablations: one
value of one setting, all others at the operating point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.study.cells import Setting
from amhe_cli.study.results import CellResult

#: Resamples of a bootstrap.
RESAMPLES = 10_000
#: 97.5 % point of the normal distribution.
_Z95 = 1.959963984540054


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of values over seeds; NaN where there are too few.

    Args:
        n: Number of values.
        mean: Mean of the values; of a rate, the share.
        sd: Standard deviation of the values (n - 1).
        median: Median of the values.
        low, high: 95 % interval of the mean.
    """

    n: int
    mean: float
    sd: float
    median: float
    low: float
    high: float

    @property
    def numbers(self) -> dict[str, float]:
        """All but n, by name."""
        return {name: value for name, value in asdict(self).items() if name != "n"}


def spread(values: FloatArray, rng: np.random.Generator) -> Spread:
    """Spread of a measure, shape (n,); NaN values do not count. The interval is that of the bootstrap."""
    values = values[np.isfinite(values)]
    low, high = bootstrap(values[:, None], lambda x: x[..., 0].mean(axis=-1), rng)
    return _spread(values, low, high)


def rate(values: FloatArray) -> Spread:
    """Rate of a yes or no, shape (n,) of 0 and 1, with Wilson's interval."""
    return _spread(values, *wilson(int(values.sum()), values.size))


def _spread(values: FloatArray, low: float, high: float) -> Spread:
    if not values.size:
        return Spread(0, *[float("nan")] * 5)
    sd = float(values.std(ddof=1)) if values.size > 1 else float("nan")
    return Spread(values.size, float(values.mean()), sd, float(np.median(values)), low, high)


@dataclass(frozen=True, slots=True)
class Difference:
    """One mode against another on the same seeds.

    Args:
        n: Number of seeds that both have.
        mean, low, high: Mean of the paired differences, with its 95 % interval.
        ratio, ratio_low, ratio_high: Ratio of the means minus one, with its interval: 0.05 is five percent
            more.
    """

    n: int
    mean: float
    low: float
    high: float
    ratio: float
    ratio_low: float
    ratio_high: float


def paired(values: FloatArray, reference: FloatArray, rng: np.random.Generator) -> Difference:
    """How `values` (n,) differ from `reference` (n,), pair by pair; NaN in either drops the pair."""
    pairs = np.stack((values, reference), axis=1)
    pairs = pairs[np.isfinite(pairs).all(axis=1)]
    if not len(pairs):
        return Difference(0, *[float("nan")] * 6)

    def difference(x: FloatArray) -> FloatArray:
        return (x[..., 0] - x[..., 1]).mean(axis=-1)

    def ratio(x: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return x[..., 0].mean(axis=-1) / x[..., 1].mean(axis=-1) - 1.0

    return Difference(
        len(pairs),
        float(difference(pairs)), *bootstrap(pairs, difference, rng),
        float(ratio(pairs)), *bootstrap(pairs, ratio, rng),
    )  # fmt: skip


def bootstrap(
    rows: FloatArray, statistic: Callable[[FloatArray], FloatArray], rng: np.random.Generator
) -> tuple[float, float]:
    """95 % percentile interval, widened by sqrt(n / (n - 1)) since few rows make it too narrow.

    Hesterberg, What Teachers Should Know About the Bootstrap (2015), section 4.

    Args:
        rows: Independent rows, shape (n, k); fewer than two have no interval.
        statistic: Takes resamples (r, n, k) to an array (r,), and rows (n, k) to a number.
        rng: Random generator of the resampling.
    """
    n = len(rows)
    if n < 2:
        return float("nan"), float("nan")
    resampled = statistic(rows[rng.integers(n, size=(RESAMPLES, n))])
    centre, wider = float(statistic(rows)), np.sqrt(n / (n - 1))
    low, high = centre + wider * (np.quantile(resampled, (0.025, 0.975)) - centre)
    return float(low), float(high)


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % interval of a rate by Wilson's score; it stays within 0 and 1, and is right at both ends."""
    if not n:
        return float("nan"), float("nan")
    share, z2 = successes / n, _Z95**2
    centre = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = _Z95 * np.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


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


@dataclass(frozen=True, slots=True, eq=False)
class Ablation:
    """One setting over its values, in one task and mode.

    Args:
        path: Path of the setting.
        task, mode: Task and mode in which it was tried.
        values: Values of the setting, in order.
        groups: One group of runs for each value.
        default: Index of the operating point among them; None: it was not run.
    """

    path: str
    task: str
    mode: str
    values: tuple[Any, ...]
    groups: tuple[Group, ...]
    default: int | None


def ablations(groups: Groups, defaults: Mapping[str, Any]) -> list[Ablation]:
    """All ablations that were run.

    Args:
        defaults: Each setting's default, by its path.
    """
    base, found = dict(groups.base), dict[tuple[str, str, str], list[tuple[Any, Group]]]()
    for group in groups:
        other = dict(group.setting)
        changed = [path for path in base.keys() | other.keys() if base.get(path) != other.get(path)]
        if len(changed) == 1 and group.n:
            (path,) = changed
            value = other.get(path, defaults.get(path))
            found.setdefault((path, group.task, group.mode), []).append((value, group))
    made = []
    for (path, task, mode), tried in sorted(found.items()):
        at_base = groups.get(task, mode)
        if at_base and at_base.n:
            tried.append((base.get(path, defaults.get(path)), at_base))
        if all(isinstance(value, (int, float)) for value, _ in tried):
            tried.sort(key=lambda pair: pair[0])
        values, members = zip(*tried, strict=True)
        default = members.index(at_base) if at_base in members else None
        made.append(Ablation(path, task, mode, values, members, default))
    return made
