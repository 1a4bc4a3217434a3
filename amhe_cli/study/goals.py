"""The goals of a study, and whether it reaches them: the true belief alone, the adaptive one against it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from amhe_cli.study import paper
from amhe_cli.study.summary import Group, Groups, difference

#: Tasks that every seed should finish, and the task with one leg, whose end is judged by distance.
_WALKING, _ONE_LEG, _ONE_LEG_ERROR = ("t1", "t2", "t3", "t4"), "t5", 0.12
#: The adaptive mode succeeds no less often than the true one.
_AT_LEAST = {"success": 0.0, "on_time": 0.0}
#: The adaptive mode may be worse by this much: in the measure's unit, or as a share.
_ALLOWED = {"goal_error_m": 0.02, "speed_rmse": 0.005}
_ALLOWED_SHARE = {"cost": 0.05, "time_s": 0.05}


@dataclass(frozen=True, slots=True)
class Goal:
    """A measured number and its limit.

    Args:
        task, mode, measure: Task, mode and measure that the goal is about.
        kind: 'value'; 'difference' from or 'ratio' to (minus one) the true mode, paired by seeds.
        value, low, high: The number with its 95 % interval.
        limit: The limit that the value should keep.
        n: Number of seeds that were judged.
        at_least: Whether the limit is a lower one.
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
    at_least: bool = False

    @property
    def reached(self) -> bool:
        """Whether the value itself, not its interval, keeps the limit."""
        return self.value >= self.limit - 1e-12 if self.at_least else self.value <= self.limit + 1e-12


def goals(groups: Groups) -> list[Goal]:
    """All goals that the existing results allow to judge."""
    found: list[Goal] = []
    for task in groups.tasks:
        true, adaptive = groups.get(task, "true"), groups.get(task, "adaptive")
        if true and true.n:
            found += _true(true)
            if adaptive and adaptive.n:
                found += _adaptive(adaptive, true)
    return [goal for goal in found if np.isfinite(goal.value)]


def _true(group: Group) -> Iterator[Goal]:
    if group.task in _WALKING:
        yield _value(group, "success", 1.0, at_least=True)
        yield _value(group, "on_time", 1.0, at_least=True)
    if group.task in (*_WALKING, _ONE_LEG):
        yield _value(group, "fell", 0.0)
    if group.task == _ONE_LEG:
        yield _value(group, "goal_error_m", _ONE_LEG_ERROR)
    if rmse := paper.TABLE_2.get((group.task, "speed_rmse")):
        yield _value(group, "speed_rmse", rmse["true"])


def _adaptive(group: Group, true: Group) -> Iterator[Goal]:
    for name, limit in (_AT_LEAST | _ALLOWED | _ALLOWED_SHARE).items():
        found = difference(group, true, name)
        if name in _ALLOWED_SHARE:
            numbers = ("ratio", found.ratio, found.ratio_low, found.ratio_high)
        else:
            numbers = ("difference", found.mean, found.low, found.high)
        if found.n:
            yield Goal(group.task, group.mode, name, *numbers, limit, found.n, name in _AT_LEAST)


def _value(group: Group, name: str, limit: float, at_least: bool = False) -> Goal:
    spread = group.spread(name)
    numbers = (spread.mean, spread.low, spread.high)
    return Goal(group.task, group.mode, name, "value", *numbers, limit, spread.n, at_least)
