"""The goals of a study, and whether it reaches them: the true belief alone, the adaptive one against it.

The paper's own numbers (Adaptive-MHE, tables I and II) stand here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.study.summary import Group, Groups, difference

#: Mode of the paper -> our mode; the paper has no `stale`.
PAPER_MODES = {"true": "True", "baseline": "Baseline", "adaptive": "Adaptive-MHE"}

#: Table I, T4, 15 seeds: measure -> mode -> mean and sd.
TABLE_1: dict[str, dict[str, tuple[float, float]]] = {
    "success": {"true": (1.0, 0.0), "baseline": (0.1333, 0.352), "adaptive": (0.867, 0.352)},
    "goal_error_m": {"true": (0.045, 0.02), "baseline": (0.58, 0.23), "adaptive": (0.16, 0.24)},
    "cost": {"true": (0.43e5, 0.03e5), "baseline": (0.62e5, 0.04e5), "adaptive": (0.51e5, 0.05e5)},
    "time_s": {"true": (48.1, 0.2), "baseline": (77.4, 0.13), "adaptive": (56.3, 0.04)},
}
TABLE_1_TASK = "t4"

#: Table II: (task, measure) -> mode -> value.
TABLE_2: dict[tuple[str, str], dict[str, float]] = {
    ("t1", "speed_rmse"): {"true": 0.134, "baseline": 0.160, "adaptive": 0.139},
    ("t2", "speed_rmse"): {"true": 0.108, "baseline": 0.119, "adaptive": 0.104},
    ("t3", "speed_rmse"): {"true": 0.093, "baseline": 0.117, "adaptive": 0.092},
    ("t4", "speed_rmse"): {"true": 0.095, "baseline": 0.099, "adaptive": 0.097},
    ("t5", "goal_error_m"): {"true": 0.12, "baseline": 0.42, "adaptive": 0.28},
    ("t5", "speed_rmse"): {"true": 0.051, "baseline": 0.149, "adaptive": 0.052},
}


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
        rmse = TABLE_2.get((task, "speed_rmse"))
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
