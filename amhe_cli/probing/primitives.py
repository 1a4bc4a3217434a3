"""Short excitations of a box that is pushed: speeds and places of the push over time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

#: The walking push keeps to this speed [m/s], and this far beside the box's middle [m]; the trot still does
#: it when it is held (docs/probing.md).
FASTEST, WIDEST_OFFSET = 0.5, 0.12


@dataclass(frozen=True, slots=True)
class Phase:
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
class Primitive:
    """One excitation.

    Args:
        name: A word.
        title: In words.
        phases: One after the other.
    """

    name: str
    title: str
    phases: tuple[Phase, ...]

    @property
    def seconds(self) -> float:
        """How long it takes [s]."""
        return sum(phase.seconds for phase in self.phases)


#: Until the bumper meets the box; tells nothing, and comes before everything else.
APPROACH = Primitive("approach", "walk up to the box", (Phase(1.0, 0.2),))
#: What an equally long plain push is made of.
STEADY = Primitive("steady", "push on at one speed", (Phase(1.0, 0.2),))

_WAVER = (Phase(0.25, 0.5), Phase(0.25, 0.0)) * 4

LIBRARY = (
    STEADY,
    Primitive("fast", "push on faster", (Phase(1.0, 0.4),)),
    Primitive("waver", "a surge in every stride", _WAVER),
    Primitive("pulse", "push fast, stand, twice", (Phase(0.5, 0.4), Phase(0.5, 0.0)) * 2),
    Primitive("stop", "push, then let the box come to rest", (Phase(1.0, 0.4), Phase(0.5, 0.0))),
    Primitive("release", "back off and meet the box again", (Phase(0.6, -0.2), Phase(1.4, 0.4))),
    Primitive("left", "surges left of the middle", tuple(replace(p, offset=0.12) for p in _WAVER)),
    Primitive("right", "surges right of the middle", tuple(replace(p, offset=-0.12) for p in _WAVER)),
)


class Score:
    """Primitives one after the other, with the approach before them.

    Args:
        sequence: The primitives.
    """

    def __init__(self, sequence: Sequence[Primitive]) -> None:
        self.parts = (APPROACH, *sequence)
        self._phases = [phase for part in self.parts for phase in part.phases]
        self._ends = list(accumulate(phase.seconds for phase in self._phases))

    @property
    def seconds(self) -> float:
        """How long all of it takes [s]."""
        return self._ends[-1]

    @property
    def starts(self) -> list[float]:
        """When each part begins [s], the approach first."""
        return [0.0, *accumulate(part.seconds for part in self.parts[:-1])]

    def at(self, time: float) -> Phase:
        """What is commanded at a time [s]; the last phase is held."""
        return self._phases[min(bisect_right(self._ends, time + 1e-9), len(self._phases) - 1)]
