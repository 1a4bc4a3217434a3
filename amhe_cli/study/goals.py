"""The goals of a study, and whether it reaches them: the true belief alone, the adaptive one against it.

The paper's own numbers (Adaptive-MHE, tables I and II) stand here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.core.statistics import Z90
from amhe_cli.study.results import CellResult
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


#: The product of these is the resistance of a box that is pushed; each by itself is harder to determine.
PAIR = ("box_mass", "floor_friction")
#: Estimates count from this long after the change; where nothing changes, from this long after the start [s].
SETTLED, BEGUN = 1.5, 3.0
#: From this long after the same instants, each parameter should be this near, or its interval hold the truth
#: [s].
RESOLVED, NEAR = 5.0, 0.15


@dataclass(frozen=True, slots=True)
class Estimates:
    """Accuracy of one group of runs; errors are rms, relative, over time and seeds.

    Args:
        task, mode: Task and mode of the group.
        n: Number of runs.
        product: Error of mass times friction.
        mass, friction: Errors of mass and of friction.
        mass_held, friction_held: Share of the time that the 90 % interval holds the truth.
        resolved: Share of runs in which 5 s after the change mass and friction are each within 15 % of the
            truth, or their interval holds it.
    """

    task: str
    mode: str
    n: int
    product: float
    mass: float
    friction: float
    mass_held: float
    friction_held: float
    resolved: float


def estimates(group: Group) -> Estimates | None:
    """The accuracy of a group; None where nothing was estimated, or not for long enough."""
    rows = [_judged(result) for result in group.results if f"belief_sd/{PAIR[0]}" in result.trace]
    rows = [row for row in rows if row is not None]
    if not rows:
        return None
    errors = np.concatenate([errors for errors, _, _ in rows])
    mass, friction, product = np.sqrt((errors**2).mean(axis=0)).tolist()
    mass_held, friction_held = np.concatenate([held for _, held, _ in rows]).mean(axis=0).tolist()
    resolved = float(np.mean([done for *_, done in rows]))
    return Estimates(
        group.task, group.mode, len(rows), product, mass, friction, mass_held, friction_held, resolved
    )


def change_of(result: CellResult) -> float | None:
    """Time of the first change of box or floor [s]; None: nothing changed."""
    truth = [values for name, values in result.trace.items() if name.startswith("truth/")]
    rows = [row for values in truth for row in np.flatnonzero(np.diff(values))]
    return float(result.trace["time"][min(rows) + 1]) if rows else None


def deviations(result: CellResult) -> tuple[FloatArray, FloatArray]:
    """Logarithms of believed over true mass and friction, and their sd, over time; shape (n, 2) each."""
    trace = result.trace
    believed, sd, truth = (
        np.stack([trace[f"{of}/{name}"] for name in PAIR], axis=1) for of in ("belief", "belief_sd", "truth")
    )
    return np.log(believed / truth), sd / believed


def _judged(result: CellResult) -> tuple[FloatArray, BoolArray, bool] | None:
    """Errors of mass, friction, product (m, 3); whether mass and friction are held (m, 2); if resolved."""
    off, sd = deviations(result)
    change = change_of(result)
    since = result.trace["time"] - (BEGUN - SETTLED if change is None else change)
    late = since >= SETTLED
    if not late.any():
        return None
    held = np.abs(off) <= Z90 * sd  # the intervals are those of the logarithms
    errors = np.expm1(np.column_stack((off, off.sum(axis=1))))
    at = int(np.argmin(np.abs(since - RESOLVED)))
    resolved = bool((held[at] | (np.abs(errors[at, :2]) <= NEAR)).all())
    return errors[late], held[late], resolved
