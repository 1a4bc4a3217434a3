"""How well an episode goes, by the truth: when it is over, success, speed, path and cost; and its numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import Ending
from amhe_cli.core.files import plain
from amhe_cli.core.rotations import rotate
from amhe_cli.core.statistics import quantiles
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.live.episode import Cycle
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.robots.go1.behaviours.walking import TAPER
from amhe_cli.robots.go1.kinematics import feet
from amhe_cli.robots.go1.state import SensorNoise, State, heading_velocity
from amhe_cli.robots.go1.tasks import LONGEST, Task

#: The box has arrived when it has been this near to the goal [m] for so long [s].
NEAR, HOLD = 0.05, 0.5
#: A final error up to this is a success [m]; on time is within this multiple of the nominal time.
CLOSE_ENOUGH, ON_TIME = 0.15, 1.25
#: A robot has fallen when its trunk leans more than this [rad] or is lower than this [m].
FALLEN_TILT, FALLEN_HEIGHT = np.deg2rad(60.0), 0.12


@dataclass(frozen=True, slots=True)
class Measures:
    """The numbers of one episode.

    Args:
        success: The box is close enough to the goal, the robot upright, and the path was kept.
        arrived: The box came to rest at its goal, on its path or not.
        on_time: A success by arrival within 1.25 times the nominal time.
        fell: The robot fell.
        goal_error_m: Final distance of the box's centre from the goal [m].
        cost: J, the running cost of the true states at 50 Hz up to 40 s, after a fall at its last value; of a
            stopped episode, up to the stop.
        time_s: Time of arrival, else the longest time; of a stopped episode, the time of the stop [s].
        speed_rmse: Rms error of the trunk's forward speed against the command [m/s]; None: never judged.
        path_rmse_m: Rms distance of the box from its path [m].
        terms: The terms of `cost`, up to the end of the episode.
    """

    success: bool
    arrived: bool
    on_time: bool
    fell: bool
    goal_error_m: float
    cost: float
    time_s: float
    speed_rmse: float | None
    path_rmse_m: float
    terms: dict[str, float]


class Judge:
    """Watches an episode, one true state a control period, and says when it is over.

    A state also stands for the periods before it that brought none: a late controller must not look cheap.

    Args:
        running_cost: Terms of the running cost of a state, from a behaviour that performs the task.
        period: Time between two states [s].
        longest: Longest duration of the episode [s].

    Attributes:
        last_cost: Running cost of the newest state.
        fell, arrived: How the episode ended, if it has ended.
    """

    def __init__(
        self,
        task: Task,
        running_cost: Callable[[State], dict[str, float]],
        period: float,
        longest: float = LONGEST,
    ) -> None:
        self._task, self._running_cost, self._period, self._longest = task, running_cost, period, longest
        self._terms: dict[str, float] = {}
        self._speed_errors: list[float] = []
        self._left: list[float] = []
        self._near_since: float | None = None
        self._tapering = False
        self._goal_error = np.inf
        self._time = 0.0
        self.last_cost = 0.0
        self.fell = False
        self.arrived = False

    def watch(self, state: State) -> bool:
        """Take in one state; True when the episode is over."""
        place = self._task.path.place(state.box.position[:2])
        periods = 1 if not self._left else max(1, round((state.time - self._time) / self._period))
        self._time = state.time
        self._goal_error = float(np.hypot(*(state.box.position[:2] - self._task.path.goal)))
        self._left += periods * [place.left]
        self._charge(state, periods)
        self._judge_speed(state, place.progress, periods)
        self.fell = has_fallen(state)
        self.arrived = not self.fell and self._has_arrived(state.time)
        return self.over

    @property
    def over(self) -> bool:
        """Whether the episode has come to its end, by arrival, a fall, or its limit."""
        return self.fell or self.arrived or self._time >= self._longest - 1e-9

    @property
    def verdict(self) -> tuple[int, str]:
        """How the episode ended: a level of diagnostics, and one line of text."""
        if self.fell:
            return ERROR, "the robot fell"
        return (OK, "the box has arrived") if self.arrived else (WARN, "the time is up")

    def measures(self) -> Measures:
        """The measures so far."""
        left = np.array(self._left or [0.0])
        strayed = float(np.abs(left).max()) > self._task.corridor
        success = not self.fell and not strayed and self._goal_error <= CLOSE_ENOUGH
        errors = np.array(self._speed_errors)
        charged = self._longest if self.over and not self.arrived else self._time
        return Measures(
            success=success,
            arrived=self.arrived,
            on_time=success and self.arrived and self._time <= ON_TIME * self._task.nominal_time,
            fell=self.fell,
            goal_error_m=self._goal_error,
            cost=sum(self._terms.values()) + self.last_cost * ((charged - self._time) / self._period),
            time_s=charged,
            speed_rmse=float(np.sqrt((errors**2).mean())) if errors.size else None,
            path_rmse_m=float(np.sqrt((left**2).mean())),
            terms=dict(self._terms),
        )

    def _charge(self, state: State, periods: int) -> None:
        terms = self._running_cost(state)
        self.last_cost = sum(terms.values())
        for name, value in terms.items():
            self._terms[name] = self._terms.get(name, 0.0) + periods * value

    def _judge_speed(self, state: State, progress: float, periods: int) -> None:
        task = self._task
        self._tapering |= not task.one_leg and progress > task.path.length - TAPER
        if state.time >= task.judged_from and not self._tapering:
            error = heading_velocity(state.trunk)[0] - task.commanded_speed(progress)
            self._speed_errors += periods * [error]

    def _has_arrived(self, time: float) -> bool:
        if self._goal_error >= NEAR:
            self._near_since = None
        elif self._near_since is None:
            self._near_since = time
        return self._near_since is not None and time - self._near_since >= HOLD - 1e-9


def has_fallen(state: State) -> bool:
    """Whether the robot lies rather than stands."""
    _, x, y, _ = state.trunk.orientation
    upright = 1.0 - 2.0 * (x * x + y * y)  # cosine between the trunk's z and the world's
    return bool(upright < np.cos(FALLEN_TILT) or state.trunk.position[2] < FALLEN_HEIGHT)


#: Cycles of free walking are compared with the model from this time on [s], so many of them. A robot is
#: another one than its model beyond this distance of the joints, in sd of their noise, or this mean speed
#: of the trunk, up or down, beside the expected one [m/s]: our own plant has 4 to 8 mm/s. A box whose middle
#: is so far from where its stated height has it [m] has its mass times friction 6 % wrong.
_FREE, _ENOUGH, _MISS, _RISE, _LIFT = 0.3, 25, 2.5, 0.0125, 0.003
_ROBOT = "weigh and identify the robot first, with a probe of `task=walk` (docs/tasks.md)"
_BOX = "measure it (`boxes.box`), or add `box_size` to `unknowns` (docs/tasks.md)"


@dataclass(slots=True, eq=False)
class History:
    """Rows of numbers, one for each cycle; of the true state where it is known, else of the estimated one.

    Args:
        estimates: Estimates of the online estimator, in adaptive runs.
        compares: Whether a robot is noticed that is another one than its model; a rehearsal's never is.
    """

    task: Task
    estimates: list[Estimate] = field(default_factory=list)
    compares: bool = True
    _troubles: dict[str, list[float]] = field(default_factory=dict)
    _rows: list[dict[str, float]] = field(default_factory=list)
    _last: Cycle | None = None
    _walked: list[tuple[FloatArray, float, float]] = field(default_factory=list)

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
        """Say if the robot, while it walks freely, or the box is another one than its model."""
        expected = self._last.plan.expected if self._last else None
        at = cycle.plan.reference
        if not (self.compares and self.task.pushes) or expected is None or at is None or at.pushing:
            return
        if cycle.time > _FREE and abs(expected.time - cycle.time) < 1e-6:
            now, lifted = cycle.estimate, cycle.estimate.box.position[2] - 0.5 * self.task.box.size[2]
            rising = now.trunk.velocity[2] - expected.trunk.velocity[2]
            self._walked.append((now.joints - expected.joints, float(rising), float(lifted)))
        if len(self._walked) != _ENOUGH:
            return
        rise, lift = np.mean([one[1:] for one in self._walked], axis=0).tolist()
        found = []
        if self.miss > _MISS:
            found = [(f"joints are {self.miss:.0f} times their noise from where they are expected", _ROBOT)]
        elif abs(rise) > _RISE:
            found = [
                (f"trunk rises or sinks {1e3 * abs(rise):.0f} mm/s faster than the model expects", _ROBOT)
            ]
        if abs(lift) > _LIFT and "floor_overlap" not in cycle.belief:
            off = f"{1e3 * abs(lift):.0f} mm {'higher' if lift > 0.0 else 'lower'}"
            found.append((f"box's middle is {off} than half of its stated height", _BOX))
        for text, advice in found:
            self._troubles.setdefault(f"the {text}: {advice}", []).append(cycle.time)

    @property
    def miss(self) -> float:
        """Rms distance of the joints from where they were expected, in sd of their noise; NaN: unknown."""
        missed = [one[0] for one in self._walked]
        return float(np.sqrt(np.square(missed).mean()) / SensorNoise().joint) if missed else np.nan

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
        "trunk_yaw": state.trunk.yaw,
        "box_x": float(box[0]),
        "box_y": float(box[1]),
        "box_yaw": state.box.yaw,
        "foot_x": float(foot[0]),
        "foot_y": float(foot[1]),
        "foot_z": float(foot[2]),
        "speed": heading_velocity(state.trunk)[0],
        "command": task.commanded_speed(place.progress),
        "to_goal": float(np.hypot(*(box[:2] - task.path.goal))),
        "left": place.left,
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
