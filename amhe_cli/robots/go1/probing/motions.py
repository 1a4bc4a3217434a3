"""Ways to push a box that may tell of it: speeds and places of the push, over and over."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate

#: The walking push keeps to this speed [m/s], and this far beside the box's middle [m]; the trot still does
#: it when it is held (docs/probing.md).
FASTEST, WIDEST_OFFSET = 0.5, 0.12


@dataclass(frozen=True, slots=True)
class Segment:
    """One command for some time.

    Args:
        seconds: How long [s].
        speed: Of the robot ahead [m/s]; below zero it backs off.
        offset: Where to push, left of the box's middle [m]; None: wherever steers the box along its line.
    """

    seconds: float
    speed: float
    offset: float | None = None


@dataclass(frozen=True, slots=True)
class Motion:
    """One way to push, repeated for as long as there is time.

    Args:
        name: A word.
        title: In words.
        phases: Of one turn, one after the other.
    """

    name: str
    title: str
    phases: tuple[Segment, ...]

    @property
    def seconds(self) -> float:
        """How long one turn takes [s]."""
        return sum(phase.seconds for phase in self.phases)


#: Until the bumper meets the box; tells nothing, and comes before everything else.
APPROACH = Motion("approach", "walk up to the box", (Segment(1.0, 0.2),))
#: The plain push.
STEADY = Motion("steady", "push on at one speed", (Segment(1.0, 0.2),))


def _surges(offset: float | None, count: int) -> tuple[Segment, ...]:
    """The trot's stride is 0.5 s: one surge in the first half of each.

    0.5 m/s tell hardly more, and take a robot's joint targets to where its link trips (`target_jump`).
    """
    return (Segment(0.25, 0.4, offset), Segment(0.25, 0.1, offset)) * count


MOTIONS = (
    STEADY,
    Motion("surge", "a surge in every stride", _surges(None, 1)),
    Motion("sides", "surges left and right of the middle by turns", _surges(0.12, 4) + _surges(-0.12, 4)),
    Motion("release", "back off and meet the box again", (Segment(0.6, -0.2), Segment(1.4, 0.4))),
)


def named_motion(name: str) -> Motion:
    """One of `MOTIONS`."""
    return next(motion for motion in MOTIONS if motion.name == name)


class Score:
    """What is commanded when: the approach, then a motion over and over.

    Args:
        motion: After the approach.
    """

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self._ends = list(accumulate(phase.seconds for phase in motion.phases))

    def at(self, time: float) -> Segment:
        """What is commanded at a time [s]."""
        since = time - APPROACH.seconds + 1e-9
        if since < 0.0:
            return APPROACH.phases[0]
        turn = since % self.motion.seconds
        return self.motion.phases[min(bisect_right(self._ends, turn), len(self._ends) - 1)]
