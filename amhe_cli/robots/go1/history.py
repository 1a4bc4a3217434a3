"""The numbers of every cycle that a run's report draws."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import Ending
from amhe_cli.core.files import plain
from amhe_cli.core.rotations import rotate, yaw_of
from amhe_cli.core.statistics import quantiles
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.live.episode import Cycle
from amhe_cli.robots.go1.judge import Measures
from amhe_cli.robots.go1.kinematics import feet
from amhe_cli.robots.go1.state import SensorNoise, State, heading_velocity
from amhe_cli.robots.go1.tasks import Task

#: Cycles of free walking are compared with the model from this time on [s], so many of them, and a robot is
#: another one than its model beyond this distance, in sd of the joints' noise.
_FREE, _ENOUGH, _MISS = 0.3, 25, 2.5


@dataclass(slots=True, eq=False)
class History:
    """Rows of numbers, one for each cycle; of the true state where it is known, else of the estimated one.

    Args:
        task: The task.
        estimates: Estimates of the online estimator, in adaptive runs.
        compares: Whether a robot is noticed that is another one than its model; a rehearsal's never is.
    """

    task: Task
    estimates: list[Estimate] = field(default_factory=list)
    compares: bool = True
    _troubles: dict[str, list[float]] = field(default_factory=dict)
    _rows: list[dict[str, float]] = field(default_factory=list)
    _last: Cycle | None = None
    _missed: list[FloatArray] = field(default_factory=list)

    def add(self, cycle: Cycle) -> dict[str, float]:
        """Take in a cycle; returns its row."""
        state = cycle.truth or cycle.estimate
        row = _motion(state, self.task) | _planning(cycle)
        row |= {f"belief/{name}": value for name, value in cycle.belief.items()}
        row |= self._estimated(cycle)
        row |= {f"truth/{name}": value for name, value in (cycle.parameters or {}).items()}
        self._rows.append(row)
        self._compare(cycle)
        self._last = cycle
        return row

    def _compare(self, cycle: Cycle) -> None:
        """Say if the joints of a robot that walks freely are not where its model expects them."""
        expected = self._last.plan.expected if self._last else None
        at = cycle.plan.reference
        if not (self.compares and self.task.pushes) or expected is None or at is None or at.pushing:
            return
        if cycle.time > _FREE and abs(expected.time - cycle.time) < 1e-6:
            self._missed.append(cycle.estimate.joints - expected.joints)
        if len(self._missed) == _ENOUGH and self.miss > _MISS:
            text = f"the joints are {self.miss:.0f} times their noise from where the model expects them"
            advice = "identify the robot first, with a probe of `task=walk` (docs/tasks.md)"
            self._troubles.setdefault(f"{text}: {advice}", []).append(cycle.time)

    @property
    def miss(self) -> float:
        """Rms distance of the joints from where they were expected, in sd of their noise; NaN: unknown."""
        return (
            float(np.sqrt(np.square(self._missed).mean()) / SensorNoise().joint) if self._missed else np.nan
        )

    def _estimated(self, cycle: Cycle) -> dict[str, float]:
        """Interval and time of the newest estimate; {} before the first."""
        for news in cycle.news:
            if isinstance(news, Estimate):
                self.estimates.append(news)
            else:
                self._troubles.setdefault(news.text, []).append(news.time)
        if not self.estimates:
            return {}
        newest = self.estimates[-1]
        ends = zip(newest.belief.names, newest.lower, newest.upper, strict=True)
        return {
            f"{end}/{name}": float(v)
            for name, *pair in ends
            for end, v in zip(("lower", "upper"), pair, strict=True)
        }

    @property
    def troubles(self) -> list[str]:
        """Troubles of the estimator, each with its first time and its count: 'at 3.2 s it died; 2 times'."""
        return [
            f"at {times[0]:.1f} s {text}{f'; {len(times)} times' if len(times) > 1 else ''}"
            for text, times in self._troubles.items()
        ]

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self._rows)

    @property
    def belief(self) -> dict[str, float]:
        """Believed parameters at the end, by name; {} before the first cycle."""
        return self._named("belief/")

    @property
    def truth(self) -> dict[str, float]:
        """True parameters at the end, by name; {} where they are unknown."""
        return self._named("truth/")

    @property
    def misses(self) -> int:
        """Number of periods without a new plan."""
        return self._last.misses if self._last else 0

    def column(self, name: str) -> FloatArray:
        """One number of every cycle, shape (n,)."""
        return np.array([row.get(name, np.nan) for row in self._rows])

    def columns(self) -> Mapping[str, FloatArray]:
        """All numbers of every cycle, by name."""
        return {name: self.column(name) for name in (self._rows[-1] if self._rows else ())}

    def _named(self, prefix: str) -> dict[str, float]:
        last = self._rows[-1] if self._rows else {}
        return {name.removeprefix(prefix): value for name, value in last.items() if name.startswith(prefix)}


def _motion(state: State, task: Task) -> dict[str, float]:
    box, trunk = state.box.position, state.trunk.position
    place = task.path.place(box[:2])
    foot = trunk + rotate(state.trunk.orientation, feet(state.joints)[0])  # the front right foot
    return {
        "time": state.time,
        "trunk_x": float(trunk[0]),
        "trunk_y": float(trunk[1]),
        "trunk_yaw": float(yaw_of(state.trunk.orientation)),
        "box_x": float(box[0]),
        "box_y": float(box[1]),
        "box_yaw": float(yaw_of(state.box.orientation)),
        "foot_x": float(foot[0]),
        "foot_y": float(foot[1]),
        "foot_z": float(foot[2]),
        "speed": heading_velocity(state.trunk)[0],
        "command": task.commanded_speed(float(place.progress)),
        "to_goal": float(np.hypot(*(box[:2] - task.path.goal))),
        "left": float(place.left),
    }


def _planning(cycle: Cycle) -> dict[str, float]:
    step = cycle.plan.step
    return {
        "plan_ms": cycle.plan_ms,
        "effective_samples": step.effective_samples if step else np.nan,
        "rollouts": step.rollouts if step else 0,
        "diverged": step.diverged if step else 0,
    }


def run_record(measures: Measures, history: History, ending: Ending) -> dict[str, Any]:
    """Outcome of a run as plain values, ready for JSON; numbers that do not exist are None.

    Args:
        measures: Success, errors and cost of the run.
        history: Cycles and online estimates of the run.
        ending: How the loop ended.
    """
    numbers = asdict(measures)
    terms = numbers.pop("terms")
    columns = history.columns()
    return plain(
        {
            **numbers,
            "interrupted": ending.interrupted,
            "error": None if ending.error is None else str(ending.error),
            "trip": getattr(ending.error, "trip", "") or None,
            "cost_terms": terms,
            "belief": history.belief,
            "estimator": _estimator(history),
            "truth": history.truth,
            "cycles": history.cycles,
            "cycle_ms": quantiles(columns.get("plan_ms", np.empty(0))),
            "deadline_misses": history.misses,
            "rollouts": int(columns["rollouts"].sum()) if columns else 0,
            "least_rollouts": int(columns["rollouts"].min()) if columns else 0,
            "diverged": int(columns["diverged"].sum()) if columns else 0,
        }
    )


def _estimator(history: History) -> dict[str, Any] | None:
    """Updates, times and troubles of the online estimator; None if the run had none."""
    found = history.estimates
    if not found:
        return None
    last = found[-1]
    return {
        "updates": len(found),
        "marks": Counter(e.mark for e in found),
        "sd": dict(zip(last.belief.names, last.sd, strict=True)),
        "update_ms": quantiles(np.array([e.update_ms for e in found if e.rollouts])),
        "diverged": sum(e.diverged for e in found),
        "troubles": history.troubles,
    }
