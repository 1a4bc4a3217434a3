"""How well an episode went, by the truth: when it is over, success, speed, path and cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amhe_cli.logs.messages.writer import ERROR, OK, WARN
from amhe_cli.robots.go1.state import State, heading_velocity
from amhe_cli.robots.go1.tasks import LONGEST, TAPER, Task

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
        task: The task that the robot performs.
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
        self._left += periods * [float(place.left)]
        self._charge(state, periods)
        self._judge_speed(state, float(place.progress), periods)
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
