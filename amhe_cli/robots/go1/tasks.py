"""The tasks T1 to T5, hw1 and hw2 as data: what is pushed where, and what changes on the way.

World: x ahead, y left, z up. The robot starts at the origin, heading along x. Definitions: docs/tasks.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.shown import Floor
from amhe_cli.robots.go1.behaviours.gait import Gait, standing
from amhe_cli.robots.go1.behaviours.objective import Course
from amhe_cli.robots.go1.behaviours.sweeping import Sweeping, SweepShape
from amhe_cli.robots.go1.behaviours.walking import Helm, Walking, commanded_speed
from amhe_cli.robots.go1.model import Box, Change

#: The longest that an episode takes [s].
LONGEST = 40.0

_AHEAD = (0.6, 0.0)
_GAIT = Gait()
#: Start of a box beside the front right foot, so near that the leg reaches it: its face is 4 cm from that
#: foot.
_BESIDE = (0.1, -0.34)


@dataclass(frozen=True, slots=True)
class Believed:
    """A fixed belief: mass of the box [kg], and its friction against the floor."""

    box_mass: float
    floor_friction: float


@dataclass(frozen=True, slots=True)
class Task:
    """What is pushed where, what changes on the way, and what is believed at the start.

    Args:
        name: Name on the command line.
        title: Title in words.
        box: The box at the start, with the plant's true parameters.
        path: Path of the box's centre; its end is the goal.
        nominal_time: Nominal duration [s].
        changes: Changes of the plant on the way.
        baseline: The fixed belief of mode `baseline`.
        stale: The fixed belief of mode `stale`, where there is one.
        one_leg: Whether the robot pushes with a front leg and stands on the other three; otherwise it walks.
        corridor: Largest allowed distance of the box from its path [m].
    """

    name: str
    title: str
    box: Box
    path: Course
    nominal_time: float
    changes: tuple[Change, ...] = ()
    baseline: Believed = Believed(4.0, 0.4)
    stale: Believed | None = None
    one_leg: bool = False
    corridor: float = np.inf

    def behaviour(self, gait: Gait = _GAIT) -> Walking | Sweeping:
        """A new behaviour that performs the task; each episode needs its own."""
        if self.one_leg:
            return Sweeping(self.path, 0.5 * self.box.size[1], gait=standing(gait))
        return Walking(Helm(self.path, self.box.size), gait)

    def commanded_speed(self, progress: float) -> float:
        """See `walking.commanded_speed`; on one leg the robot stands."""
        return 0.0 if self.one_leg else commanded_speed(self.path, progress)

    @property
    def pushes(self) -> bool:
        """Whether the robot walks, and pushes what it comes to."""
        return not self.one_leg

    @property
    def judged_from(self) -> float:
        """Time from which the speed is judged [s]: with one leg, from when it is free."""
        return SweepShape().shift_time if self.one_leg else 1.0

    @property
    def floor(self) -> Floor:
        """What a report draws on the floor."""
        path = self.path
        placed = [(c.beyond_x, c.floor_friction) for c in self.changes if c.beyond_x is not None]
        return Floor(
            path.points(np.linspace(0.0, path.length, 61 if path.curvature else 2)),
            self.box.yaw + path.curvature * path.length,
            self.box.size[:2],
            min((x for x, friction in placed if friction is not None), default=None),
            tuple(x for x, friction in placed if friction is None),
            self.one_leg,
        )

    def change_texts(self) -> list[str]:
        """What changes during the run, in words."""
        texts = []
        for change in self.changes:
            when = f"{change.at_time:g} s" if change.at_time is not None else f"x = {change.beyond_x:g} m"
            if change.mass is not None:
                texts.append(f"from {when} on the box weighs {change.mass:g} kg")
            if change.floor_friction is not None:
                texts.append(f"from {when} on the floor friction is {change.floor_friction:g}")
        return texts


_LIGHT, _STALE = Believed(2.0, 0.3), Believed(2.0, 0.2)
_TERRAIN = (Change(floor_friction=0.8, beyond_x=1.5),)

TASKS = {
    task.name: task
    for task in (
        Task(
            "t1", "single-goal push", Box(mass=4.0, floor_friction=0.6), Course(_AHEAD, 0.0, 2.4), 12.0,
            baseline=_LIGHT,
        ),
        Task(
            "t2", "circular path", Box(mass=4.0, floor_friction=0.4),
            Course(_AHEAD, 0.0, 1.5 * np.pi, curvature=1.0 / 1.5), 23.6, baseline=_LIGHT, corridor=0.4,
        ),
        Task(
            "t3", "mass switch", Box(mass=4.0, floor_friction=0.4), Course(_AHEAD, 0.0, 3.0), 15.0,
            (Change(mass=6.0, at_time=10.0),), stale=_STALE,
        ),
        Task(
            "t4", "terrain change", Box(mass=4.0, floor_friction=0.4), Course(_AHEAD, 0.0, 2.4), 12.0,
            _TERRAIN, stale=_STALE,
        ),
        Task(
            "t5", "one front leg", Box((0.2, 0.3, 0.3), 3.0, 0.4, _BESIDE),
            Course(_BESIDE, -0.5 * np.pi, 0.5), 10.0, baseline=_LIGHT, one_leg=True,
        ),
        Task(
            "hw1", "a load put into the basket", Box(mass=3.0, floor_friction=0.4), Course(_AHEAD, 0.0, 2.4),
            12.0, (Change(mass=4.0, beyond_x=1.8),), baseline=Believed(3.0, 0.4),
        ),
        Task(
            "hw2", "from concrete to turf", Box(mass=4.0, floor_friction=0.4), Course(_AHEAD, 0.0, 2.4), 12.0,
            _TERRAIN, baseline=Believed(4.0, 0.6),
        ),
    )
}  # fmt: skip


def find_task(name: str) -> Task:
    """The task with a given name.

    Raises:
        ConfigError: There is no such task; the text lists all.
    """
    if name not in TASKS:
        raise ConfigError(one_of("task", name, TASKS))
    return TASKS[name]
