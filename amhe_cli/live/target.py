"""The controlled robot: a simulated one here, a real one behind the same interface."""

from __future__ import annotations

import time
from typing import Any, Protocol

import numpy as np

from amhe_cli.control.controller import Plan
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Samples, merged


class Target(Protocol):
    """A robot that plays plans and measures."""

    @property
    def misses(self) -> int:
        """Number of control periods that began without a new plan."""
        ...

    @property
    def deadline(self) -> float | None:
        """When the plan from the newest measurements is due, by time.monotonic() [s]; None: at any time."""
        ...

    @property
    def truth(self) -> Any:
        """The true state, of the robot's own type; None where it is unknown. Never for the controller."""
        ...

    @property
    def parameters(self) -> dict[str, float] | None:
        """The true parameters by name; None where they are unknown."""
        ...

    def in_force(self, at: float) -> FloatArray:
        """Joint targets that are played at a time [s], shape (n,)."""
        ...

    def play(self, plan: Plan) -> None:
        """Take over the newest plan, at once.

        It takes effect one period after the measurements that it was made from; until then the one before
        is played.
        """
        ...

    def measure(self) -> tuple[float, Samples]:
        """Wait for the end of the next period; its time [s], and the measurements since the last call.

        Among them is `command.position`: the joint targets that were followed, and since when.
        """
        ...


class Simulation(Protocol):
    """A simulation that follows joint targets."""

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        ...

    @property
    def state(self) -> Any:
        """The true state, of the robot's own type."""
        ...

    @property
    def parameters(self) -> dict[str, float]:
        """The true parameters by name."""
        ...

    def advance(self, targets: FloatArray, duration: float) -> Samples:
        """Follow joint targets (n,) [rad] for some time [s]; the measurements meanwhile."""
        ...


class SimTarget:
    """A plant in lock-step, or at the pace of the wall clock.

    Args:
        period: Control period [s].
        stand: Joint targets before the first plan [rad], shape (n,).
        realtime: Keep pace with the wall clock: while a plan takes too long, simulated time goes on.
        lead: Time that a command takes to act [s]: plans are played so much earlier.
    """

    def __init__(
        self, plant: Simulation, period: float, stand: FloatArray, realtime: bool = False, lead: float = 0.0
    ) -> None:
        self._plant, self._period, self._realtime, self._lead = plant, period, realtime, lead
        self._plan = self._next = Plan(0.0, period, np.asarray(stand)[None])
        self._begun: float | None = None
        self.misses = 0

    @property
    def deadline(self) -> float | None:
        """See `Target`."""
        return None if self._begun is None else self._begun + self._plant.time + self._period

    @property
    def truth(self) -> Any:
        """See `Target`."""
        return self._plant.state

    @property
    def parameters(self) -> dict[str, float]:
        """See `Target`."""
        return self._plant.parameters

    def in_force(self, at: float) -> FloatArray:
        """See `Target`."""
        return self._plan.at(at)

    def play(self, plan: Plan) -> None:
        """See `Target`."""
        self._next = plan

    def measure(self) -> tuple[float, Samples]:
        """See `Target`.

        Raises:
            SimulationError: The plant diverged.
        """
        parts, times = [], []
        for _ in range(self._periods_gone()):
            parts.append(self._plant.advance(self._sent(self._plant.time), self._period))
            times.append(self._plant.time)
        missed = [self._sent(time) for time in times[:-1]]  # those periods begin without a new plan
        self._plan = self._next
        now = times[-1]
        commands = np.array(times), np.array([*missed, self._sent(now)])
        return now, {**merged(parts), "command.position": commands}

    def _sent(self, time: float) -> FloatArray:
        """Joint targets (n,) sent at a time [s]: between two rows where the lead is no whole period."""
        share = self._lead / self._period % 1.0
        earlier = self._plan.at(time + self._lead - share * self._period)
        return earlier + share * (self._plan.at(time + self._lead + (1.0 - share) * self._period) - earlier)

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
