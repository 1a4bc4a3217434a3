"""The goals of a study, and whether it reaches them: the true belief alone, the adaptive one against it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.study import paper
from amhe_cli.study.summary import Group, Groups, difference

#: Task -> what its true mode should reach; other limits are the paper's speed errors.
_WALKING = {"success": 1.0, "on_time": 1.0, "fell": 0.0}
_TRUE = {**dict.fromkeys(("t1", "t2", "t3", "t4"), _WALKING), "t5": {"fell": 0.0, "goal_error_m": 0.12}}
#: Measure -> by how much the adaptive mode may be worse than the true one: a difference, or a ratio.
_ADAPTIVE = {
    "success": ("difference", 0.0), "on_time": ("difference", 0.0), "goal_error_m": ("difference", 0.02),
    "speed_rmse": ("difference", 0.005), "cost": ("ratio", 0.05), "time_s": ("ratio", 0.05),
}  # fmt: skip
#: Measures that should be large.
_LARGE = ("success", "on_time")


@dataclass(frozen=True, slots=True)
class Goal:
    """A measured number and its limit.

    Args:
        task, mode, measure: Task, mode and measure that the goal is about.
        kind: 'value'; 'difference' from or 'ratio' to (minus one) the true mode, paired by seeds.
        value, low, high: The number with its 95 % interval.
        limit: The limit that the value should keep.
        n: Number of seeds that were judged.
    """

    task: str
    mode: str
    measure: str
    kind: str
    value: float
    low: float
    high: float
    limit: float
    n: int

    @property
    def at_least(self) -> bool:
        """Whether the limit is a lower one."""
        return self.measure in _LARGE

    @property
    def reached(self) -> bool:
        """Whether the value itself, not its interval, keeps the limit."""
        return (self.value - self.limit) * (-1.0 if self.at_least else 1.0) <= 1e-12


def goals(groups: Groups) -> list[Goal]:
    """All goals that the existing results allow to judge."""
    found: list[Goal] = []
    for task in groups.tasks:
        true, adaptive = groups.get(task, "true"), groups.get(task, "adaptive")
        if not true or not true.n:
            continue
        rmse = paper.TABLE_2.get((task, "speed_rmse"))
        limits = _TRUE.get(task, {}) | ({"speed_rmse": rmse["true"]} if rmse else {})
        for name, limit in limits.items():
            s = true.spread(name)
            found.append(Goal(task, "true", name, "value", s.mean, s.low, s.high, limit, s.n))
        found += _against(adaptive, true) if adaptive else []
    return [goal for goal in found if np.isfinite(goal.value)]


def _against(group: Group, true: Group) -> list[Goal]:
    found = []
    for name, (kind, limit) in _ADAPTIVE.items():
        d = difference(group, true, name)
        numbers = (d.ratio, d.ratio_low, d.ratio_high) if kind == "ratio" else (d.mean, d.low, d.high)
        found.append(Goal(group.task, group.mode, name, kind, *numbers, limit, d.n))
    return found
