"""What is controlled: a simulated robot here, a real one behind the same few calls."""

from __future__ import annotations

import time
from typing import Protocol

import numpy as np

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray
from amhe_cli.robots.go1.plant import Plant
from amhe_cli.robots.go1.state import Measurements, State, merged


class Target(Protocol):
    """A robot that plays plans and tells what it measures."""

    @property
    def misses(self) -> int:
        """Control periods that began without a new plan."""
        ...

    @property
    def truth(self) -> State | None:
        """The true state, where it is known; never for the controller."""
        ...

    @property
    def parameters(self) -> dict[str, float] | None:
        """The true parameters by name, where they are known."""
        ...

    def in_force(self, at: float) -> FloatArray:
        """Joint targets that are played at a time [s], shape (12,)."""
        ...

    def play(self, plan: Plan) -> None:
        """Hand over the newest plan, at once.

        It takes effect one period after the measurements that it was made from; until then the one before
        is played.
        """
        ...

    def measure(self) -> Measurements:
        """Wait for the next period's measurements."""
        ...


class SimTarget:
    """A plant in lock-step, or at the pace of the wall clock.

    Args:
        plant: The simulation.
        period: Of control [s].
        stand: Joint targets before the first plan, shape (12,).
        realtime: Keep pace with the wall clock: who plans too long finds that time has gone on.
    """

    def __init__(self, plant: Plant, period: float, stand: FloatArray, realtime: bool = False) -> None:
        self._plant, self._period, self._realtime = plant, period, realtime
        self._plan = self._next = Plan(0.0, period, np.asarray(stand)[None])
        self._begun: float | None = None
        self.misses = 0

    @property
    def truth(self) -> State:
        """See `Target`."""
        return self._plant.state

    @property
    def parameters(self) -> dict[str, float]:
        """See `Target`."""
        return self._plant.parameters

    @property
    def qpos(self) -> FloatArray:
        """All coordinates of the plant, for pictures, shape (nq,)."""
        return self._plant.qpos

    def in_force(self, at: float) -> FloatArray:
        """See `Target`."""
        return self._plan.at(at)

    def play(self, plan: Plan) -> None:
        """See `Target`."""
        self._next = plan

    def measure(self) -> Measurements:
        """See `Target`.

        Raises:
            SimulationError: The plant diverged.
        """
        parts = [self._advance() for _ in range(self._periods_gone())]
        self._plan = self._next
        return merged(parts)

    def _advance(self) -> Measurements:
        return self._plant.advance(self._plan.at(self._plant.time), self._period)

    def _periods_gone(self) -> int:
        """Periods to play now: one, or as many as the wall clock says; sleeps to the end of them."""
        if not self._realtime:
            return 1
        now = time.monotonic()
        if self._begun is None:
            self._begun = now
        late = now - self._begun - self._plant.time
        periods = max(1, int(np.ceil(late / self._period)))
        self.misses += periods - 1
        time.sleep(max(0.0, self._begun + self._plant.time + periods * self._period - now))
        return periods
