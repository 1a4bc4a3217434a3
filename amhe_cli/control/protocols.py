"""What the controller needs of a robot, and of the behaviour that a task wants from it.

States, the bodies of rollouts and a behaviour's reference are the robot's own types: the controller passes
them on, and reads only the `time` [s] of a state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from amhe_cli.core.arrays import FloatArray, IntArray


class Robot(Protocol):
    """A robot with n position-controlled joints, and what is around it, as the planner's model has them."""

    @property
    def lower(self) -> FloatArray:
        """Lower limits of the joint targets [rad], shape (n,)."""
        ...

    @property
    def upper(self) -> FloatArray:
        """Upper limits of the joint targets [rad], shape (n,)."""
        ...

    @property
    def servos(self) -> IntArray:
        """Columns of the engine's input vector that hold the joint targets, shape (n,)."""
        ...

    def coordinates(self, state: Any) -> tuple[FloatArray, FloatArray]:
        """Coordinates (nq,) and velocities (nv,) of the planner's model in a state."""
        ...

    def state_of(self, time: float, qpos: FloatArray, qvel: FloatArray) -> Any:
        """The state at a time [s] from coordinates (nq,) and velocities (nv,)."""
        ...

    def bodies(self, qpos: FloatArray, qvel: FloatArray) -> Any:
        """Motion of the bodies that a cost is about, from rollouts (n, H, nq) and (n, H, nv)."""
        ...


class Move(Protocol):
    """A behaviour in one situation; valid for one control cycle."""

    @property
    def reference(self) -> Any:
        """Speeds, lines and headings that the behaviour aims at."""
        ...

    @property
    def command(self) -> FloatArray:
        """Command of the behaviour itself, shape (c,); the channels of a plan are added to it."""
        ...

    def targets(self, times: FloatArray, commands: FloatArray) -> FloatArray:
        """Joint targets [rad], shape (n, H, joints), at times [s] (H,) under commands (n, c)."""
        ...

    def terms(self, times: FloatArray, bodies: Any) -> dict[str, FloatArray]:
        """Weighted terms of the running cost, each shape (n, H), at times [s] (H,) for `Robot.bodies`."""
        ...


class Behaviour(Protocol):
    """How a task moves the robot."""

    @property
    def channel_sigma(self) -> FloatArray:
        """Start sd of the sampling noise on the command's channels, shape (c,)."""
        ...

    @property
    def knot_weight(self) -> float:
        """Cost of a plan's knots, which lead away from the behaviour's own joint targets [1/rad^2]."""
        ...

    def switches(self, start: float, end: float) -> bool:
        """Whether a contact mode switches in (start, end] [s]: which contacts the behaviour plans."""
        ...

    def move(self, state: Any, belief: Mapping[str, float]) -> Move:
        """The move from a state on, under believed parameters by name.

        Call it once a cycle, in order: a behaviour may remember what it has done.
        """
        ...
