"""Motions that may reveal the parameters of a box: speeds and places of the push, over and over; no goal."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.behaviours.objective import Course, PushWeights, Reference, limited
from amhe_cli.robots.go1.behaviours.walking import Helm, WalkGains, Walking
from amhe_cli.robots.go1.model import Box
from amhe_cli.robots.go1.state import State
from amhe_cli.robots.go1.tasks import LONGEST, Believed, Task

#: The walking push keeps to this speed [m/s], and this far beside the box's middle [m]; the trot still does
#: it when it is held (docs/probing.md).
FASTEST, WIDEST_OFFSET = 0.5, 0.12


@dataclass(frozen=True, slots=True)
class Segment:
    """A constant command for some time.

    Args:
        seconds: Duration [s].
        speed: Speed of the robot ahead [m/s]; below zero it backs off.
        offset: Place of the push, left of the box's middle [m]; None: the place that steers the box along its
            line.
    """

    seconds: float
    speed: float
    offset: float | None = None


@dataclass(frozen=True, slots=True)
class Motion:
    """One way to push, repeated for as long as there is time.

    Args:
        name: Short name.
        title: Title in words.
        phases: Segments of the motion, one after the other.
        bob: How far the trunk rises and sinks, once a second [m].
    """

    name: str
    title: str
    phases: tuple[Segment, ...]
    bob: float = 0.0

    @property
    def seconds(self) -> float:
        """Duration of one repetition [s]."""
        return sum(phase.seconds for phase in self.phases)

    def at(self, time: float) -> Segment:
        """The command at a time [s]: the approach, then the motion over and over."""
        since = time - APPROACH.seconds + 1e-9
        if since < 0.0:
            return APPROACH.phases[0]
        ends = list(accumulate(phase.seconds for phase in self.phases))
        return self.phases[min(bisect_right(ends, since % self.seconds), len(ends) - 1)]


#: The approach, until the bumper meets the box; it reveals nothing, and comes before everything else.
APPROACH = Motion("approach", "walk up to the box", (Segment(1.0, 0.2),))
#: The plain push.
STEADY = Motion("steady", "push on at one speed", (Segment(1.0, 0.2),))


def _surges(offset: float) -> tuple[Segment, ...]:
    """Two surges of speed, in the first halves of strides; 0.5 m/s would trip the link (`target_jump`)."""
    return (Segment(0.25, 0.4, offset), Segment(0.25, 0.05, offset)) * 2


MOTIONS = (
    STEADY,
    Motion("sides", "surges left and right in turn", _surges(0.12) + _surges(-0.12)),
    Motion("bob", "push on while the trunk rises and sinks", STEADY.phases, bob=0.04),
)


def named_motion(name: str) -> Motion:
    """The motion of `MOTIONS` with a given name."""
    return next(motion for motion in MOTIONS if motion.name == name)


#: Place of the box in front of the robot, and length of its path, to whose end no probe comes [m].
_PLACE, _LENGTH = Box().position, 100.0
_GAIT = Gait()
#: Plans are made for the trunk's height so much later [s]: a third of their horizon.
_AHEAD = 0.1


class MotionHelm(Helm):
    """Steers along a line as `Helm` does, at the speed and the place of the push that a motion commands.

    While it pushes off the middle, the box turns as it likes and the robot follows its yaw.

    Args:
        motion: The motion after the approach.
    """

    def __init__(self, motion: Motion, path: Course, size: tuple[float, float, float]) -> None:
        super().__init__(path, size)
        self._motion = motion

    def reference(self, state: State, overlap: float = 0.0) -> Reference:
        """What the controller is to do now; a lost face is found again first."""
        at, phase = super().reference(state, overlap), self._motion.at(state.time)
        height = self._motion.bob * limited(2.0 * max(state.time - APPROACH.seconds, 0.0), 1.0)
        at = replace(at, lift=height * float(np.sin(2.0 * np.pi * (state.time + _AHEAD))))
        if self.retreating:
            return at
        gap, _ = self.gap(state, overlap)
        speed = min(phase.speed, FASTEST)
        at = replace(
            at, speed=speed, harder=0.0, pushing=float(gap < self._steering.touching and speed > 0.0)
        )
        if phase.offset is None:
            return at
        yaw, offset = state.box.yaw, limited(phase.offset, WIDEST_OFFSET)
        return replace(at, offset=offset, heading=yaw, yaw=yaw, box_yaw=yaw)


@dataclass(frozen=True, slots=True)
class ProbeTask(Task):
    """A task's box and floor, pushed by a motion; for the rest see `Task`.

    Args:
        motion: What the robot does after the approach, for the task's nominal time.
    """

    motion: Motion = APPROACH

    def behaviour(self, gait: Gait = _GAIT) -> Walking:
        """See `Task.behaviour`."""
        return Walking(MotionHelm(self.motion, self.path, self.box.size), gait)


#: Free walking, which reveals the robot's own numbers: seconds, speed ahead [m/s], yaw rate [rad/s].
_STROLL = (
    (1.5, -0.3, 0.0), (1.2, 0.2, 0.0), (1.0, 0.0, 0.5), (1.5, -0.4, 0.0), (1.0, 0.45, 0.0), (1.0, 0.0, -0.5),
    (0.8, -0.2, -0.4), (0.8, 0.2, 0.4), (1.2, 0.0, 0.0),
)  # fmt: skip


class Stroll(Helm):
    """Walks back and ahead and turns, away from the box, which nothing touches."""

    def reference(self, state: State, overlap: float = 0.0) -> Reference:
        """See `Helm`."""
        seconds, speeds, turns = np.array(_STROLL).T
        time, ends = state.time % seconds.sum(), np.cumsum(seconds)
        yaw = float(turns @ np.clip(time - ends + seconds, 0.0, seconds))
        phase = int(np.searchsorted(ends, time, side="right"))
        speed, turn = float(speeds[phase]), float(turns[phase])
        return Reference(
            state.time, speed, state.trunk.position[:2], heading=yaw, yaw=yaw, turn=turn, pushing=0.0,
            box_yaw=state.box.yaw,
        )  # fmt: skip


class WalkTask(ProbeTask):
    """Free walking; the box stands where the robot does not come."""

    @property
    def pushes(self) -> bool:
        """See `Task.pushes`."""
        return False

    def behaviour(self, gait: Gait = _GAIT) -> Walking:
        """See `Task.behaviour`."""
        alone = PushWeights(box_speed=0.0, box_left=0.0, box_yaw=0.0, box_tilt=0.0, robot_left=0.0)
        return Walking(Stroll(self.path, self.box.size), gait, alone, WalkGains(left=0.0))


#: The task of `amhe probe --task walk`.
WALK = WalkTask(
    "walk", "free walking", Box(), Course(_PLACE, 0.0, _LENGTH), LONGEST,
    motion=Motion("stroll", "walk back and ahead, turn, and step in place", (Segment(10.0, 0.2),)),
)  # fmt: skip


def probe_task(task: Task, motion: Motion, seconds: float, box: Believed, believed: Believed) -> ProbeTask:
    """A task as it is before anything changes, as a probe.

    Args:
        task: The task with the box and the floor to probe.
        motion: How to push.
        seconds: Duration with the approach [s].
        box: The box with the plant's parameters.
        believed: Belief of the controller where there is no other.
    """
    placed = replace(task.box, position=_PLACE, yaw=0.0, mass=box.box_mass, floor_friction=box.floor_friction)
    return ProbeTask(
        task.name, f"probing the box of {task.name}", placed, Course(_PLACE, 0.0, _LENGTH), seconds,
        baseline=believed, motion=motion,
    )  # fmt: skip
