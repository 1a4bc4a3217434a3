"""A box that is pushed not to a goal but to learn of it: a score in place of the task's commanded speed."""

from __future__ import annotations

from dataclasses import dataclass, replace

from amhe_cli.core.rotations import yaw_of
from amhe_cli.robots.go1.behaviours.course import Course
from amhe_cli.robots.go1.behaviours.objective import Reference
from amhe_cli.robots.go1.behaviours.steering import Helm
from amhe_cli.robots.go1.behaviours.walking import Walking
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.probing.motions import APPROACH, FASTEST, WIDEST_OFFSET, Motion, Score
from amhe_cli.robots.go1.state import State
from amhe_cli.robots.go1.tasks import SPEED, TAPER, Believed, Task

#: The box is in front of the robot, on a line that no probe comes to the end of [m].
_PLACE, _LENGTH = Box().position, 100.0


class ScoreHelm(Helm):
    """Steers along a line as `Helm` does, at the speed and the place of the push that a score commands.

    While it pushes off the middle, the box turns as it likes and the robot follows its yaw.

    Args:
        score: What to do when.
        path: Line of the box.
        half_length, half_width: Of the box along and across the push [m].
    """

    def __init__(self, score: Score, path: Course, half_length: float, half_width: float) -> None:
        super().__init__(path, SPEED, TAPER, half_length, half_width)
        self._score = score

    def reference(self, state: State) -> Reference:
        """What the controller is to do now; a lost face is found again first."""
        at, phase = super().reference(state), self._score.at(state.time)
        if self.retreating:
            return at
        gap, _ = self.gap(state)
        speed = min(phase.speed, FASTEST)
        at = replace(at, speed=speed, pushing=float(gap < self._steering.touching and speed > 0.0))
        if phase.offset is None:
            return at
        yaw = float(yaw_of(state.box.orientation))
        offset = max(-WIDEST_OFFSET, min(phase.offset, WIDEST_OFFSET))
        return replace(at, offset=offset, heading=yaw, yaw=yaw, box_yaw=yaw)


@dataclass(frozen=True, slots=True)
class ProbeTask(Task):
    """A task's box and floor, pushed by a score; for the rest see `Task`.

    Args:
        motion: What is done after the approach, for the task's nominal time.
    """

    motion: Motion = APPROACH

    @property
    def score(self) -> Score:
        """With the approach."""
        return Score(self.motion)

    def behaviour(self) -> Walking:
        """See `Task.behaviour`."""
        depth, width, _ = self.box.size
        return Walking(ScoreHelm(self.score, self.path, 0.5 * depth, 0.5 * width))


def probe_task(task: Task, motion: Motion, seconds: float, box: Believed, believed: Believed) -> ProbeTask:
    """A task as it is before anything changes, as something to probe.

    Args:
        task: Gives box and floor.
        motion: How to push.
        seconds: How long, the approach included [s].
        box: The plant's numbers.
        believed: What the controller plans with where there is no other belief.
    """
    placed = replace(task.box, position=_PLACE, yaw=0.0, mass=box.box_mass, floor_friction=box.floor_friction)
    return ProbeTask(
        task.name, f"probing the box of {task.name}", placed, Course(_PLACE, 0.0, _LENGTH), seconds,
        baseline=believed, motion=motion,
    )  # fmt: skip
