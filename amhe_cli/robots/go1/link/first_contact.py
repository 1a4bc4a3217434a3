"""First contact: who answers, how much of it arrives, and how long a command takes there and back."""

from __future__ import annotations

import math
import statistics
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amhe_cli.robots.go1.link import wire
from amhe_cli.robots.go1.link.state import RobotState

#: Turns of the motors' mode whose echoes are timed, and the time given to one [s].
_TURNS, _PATIENCE = 10, 0.1
#: Shortest and longest time over which the robot's clock is compared with ours [s]: states may be late.
_PACED, _PACED_LONGEST = 0.25, 1.0
#: How far the pace may be from 1: clocks differ by far less, a forgotten `slow` by far more.
_PACE_ERROR = 0.05
#: Motors that nobody drives have less torque than this [N m].
_DRIVEN = 2.0
#: Number of states over which the share is taken, and the most missing ones that a pause counts as.
_SPAN, _PAUSE = 200, 10


class Share:
    """Share of the robot's states that reach us: with a second program at the same robot it is about a half.

    A long pause counts little, because it is another fault and is reported as that.
    """

    def __init__(self) -> None:
        self._gaps: deque[tuple[int, int]] = deque()
        self._last: int | None = None

    def see(self, tick: int) -> float:
        """Take in the tick of a state; the share of the last 200 that came, from 0 to 1."""
        missing = 0 if self._last is None else tick - self._last - 1
        self._last = tick
        if missing > 0:
            self._gaps.append((tick, min(missing, _PAUSE)))
        while self._gaps and tick - self._gaps[0][0] >= _SPAN:
            self._gaps.popleft()
        return 1.0 - min(1.0, sum(gap for _, gap in self._gaps) / _SPAN)


@dataclass(slots=True)
class Contact:
    """Counts what arrives before anything moves, and times echoes.

    A state contains each motor's mode. Servo mode without gains and damping mode both leave a motor alone, so
    that switching from one to the other moves nothing, and the echo gives the round-trip time.

    Attributes:
        mode: Mode to command now.
        driven: Whether another program drives the motors.
        pace: Recent seconds of the robot's clock per second of ours; 0: not known yet.
    """

    mode: int = wire.DAMPED
    driven: bool = False
    pace: float = 0.0
    _paced: tuple[int, float] = (0, -math.inf)
    _echoes: list[float] = field(default_factory=list)
    _turned: float = -1.0
    _good: int = 0
    _ticks: tuple[int, int] | None = None
    _strange: Counter[tuple[int, str]] = field(default_factory=Counter)

    def turn(self, now: float) -> int:
        """The motors' mode to command at a time [s]."""
        if self._turned < 0.0 or now - self._turned > _PATIENCE:
            self._turned = now
            self.mode = wire.DAMPED if self.mode == wire.SERVO else wire.SERVO
        if self.complete:
            self.mode = wire.SERVO
        return self.mode

    def see(self, state: RobotState, arrival: float) -> None:
        """Take in a good state."""
        self._good += 1
        self._ticks = (self._ticks[0] if self._ticks else state.tick, state.tick)
        if not self.complete and self._turned >= 0.0 and (state.modes == self.mode).all():
            self._echoes.append(arrival - self._turned)
            self._turned = -1.0
        self.driven = bool((state.modes == wire.SERVO).all() and np.abs(state.torques).max() > _DRIVEN)
        self._see_pace(state.tick, arrival)

    def _see_pace(self, tick: int, arrival: float) -> None:
        since = arrival - self._paced[1]
        if since >= _PACED:
            self.pace = 1e-3 * (tick - self._paced[0]) / since
        if since >= _PACED_LONGEST:
            self._paced = tick, arrival

    def see_strange(self, size: int, why: str) -> None:
        """Count a datagram of so many bytes that is not a state, and why it is none."""
        self._strange[size, why] += 1

    @property
    def complete(self) -> bool:
        """Whether enough echoes have come."""
        return len(self._echoes) >= _TURNS

    @property
    def round_trip(self) -> float:
        """Time for a command to go there and back [s]; 0 before the first echo."""
        return statistics.median(self._echoes) if self._echoes else 0.0

    @property
    def in_step(self) -> bool:
        """Whether the robot's time goes as fast as ours."""
        return abs(self.pace - 1.0) <= _PACE_ERROR

    @property
    def report(self) -> dict[str, Any]:
        """The findings as plain values; `share` is that of the robot's states that arrived."""
        expected = self._ticks[1] - self._ticks[0] + 1 if self._ticks else 0
        (size, why), _ = (self._strange.most_common(1) or [((0, ""), 0)])[0]
        return {
            "complete": self.complete,
            "pace": round(self.pace, 3),
            "in_step": self.in_step,
            "round_trip_ms": round(1e3 * self.round_trip, 2),
            "states": self._good,
            "share": round(min(1.0, self._good / expected), 3) if expected > 0 else 0.0,
            "strange": sum(self._strange.values()),
            "strange_size": size,
            "strange_why": why,
        }
