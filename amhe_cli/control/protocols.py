"""What the controller asks of a task: where the robot is to go from here, and what a motion costs."""

from __future__ import annotations

from typing import Protocol

from amhe_cli.core.arrays import BoolArray, FloatArray
from amhe_cli.robots.go1.behaviours.objective import Reference
from amhe_cli.robots.go1.state import Body, State


class Move(Protocol):
    """A behaviour in one situation; valid for one control cycle."""

    @property
    def reference(self) -> Reference:
        """What is wanted."""
        ...

    @property
    def command(self) -> FloatArray:
        """The bare reference's command, to which the channels of plans add, shape (c,)."""
        ...

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        """Joint targets [rad], shape (n, H, 12), at times [s] (H,) under commands (n, c)."""
        ...

    def terms(self, times: FloatArray, trunk: Body, box: Body) -> dict[str, FloatArray]:
        """Weighted terms of the running cost, each shape (..., H), of motions with axes (..., H)."""
        ...


class Behaviour(Protocol):
    """How a task moves the robot."""

    @property
    def channel_sigma(self) -> FloatArray:
        """Noise of the channels, shape (c,)."""
        ...

    @property
    def knot_weight(self) -> float:
        """Cost of a plan's knots: of leaving the reference's joint targets [1/rad^2]."""
        ...

    def switches(self, start: float, end: float) -> bool:
        """Whether a foot lifts off or touches down in (start, end] [s]."""
        ...

    def standing(self, times: FloatArray) -> BoolArray:
        """Feet that should stand at times [s] (...), shape (..., 4)."""
        ...

    def move(self, state: State, resistance: float) -> Move:
        """From this state on, where the box's friction resists with so many newtons.

        To be asked once a cycle, in order: a behaviour remembers where feet and foot targets were.
        """
        ...

    def running_cost(self, state: State) -> dict[str, float]:
        """Terms of the running cost of a realised state, by the task's fixed path reference."""
        ...
