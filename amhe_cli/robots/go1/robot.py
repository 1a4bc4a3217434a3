"""The Go1 and its box as the controller sees them; see `control.protocols.Robot`."""

from __future__ import annotations

from dataclasses import dataclass

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.robots.go1.kinematics import LOWER, UPPER
from amhe_cli.robots.go1.model import ModelLayout
from amhe_cli.robots.go1.state import Body, State, coordinates, state_of


@dataclass(frozen=True, slots=True, eq=False)
class Go1:
    """The robot of the planner's model.

    Args:
        at: Addresses of robot and box in that model's state.
        sigma: Start sd of the sampling noise on each joint's knots [rad], shape (12,).
    """

    at: ModelLayout
    sigma: FloatArray

    @property
    def lower(self) -> FloatArray:
        """See `Robot`."""
        return LOWER

    @property
    def upper(self) -> FloatArray:
        """See `Robot`."""
        return UPPER

    @property
    def servos(self) -> IntArray:
        """See `Robot`."""
        return self.at.servos

    def coordinates(self, state: State) -> tuple[FloatArray, FloatArray]:
        """See `Robot`."""
        return coordinates(self.at, state)

    def state_of(self, time: float, qpos: FloatArray, qvel: FloatArray) -> State:
        """See `Robot`."""
        return state_of(self.at, time, qpos, qvel)

    def bodies(self, qpos: FloatArray, qvel: FloatArray) -> tuple[Body, Body]:
        """Trunk and box."""

        def body(q: slice, v: slice) -> Body:
            pose, twist = qpos[..., q], qvel[..., v]
            return Body(pose[..., :3], pose[..., 3:], twist[..., :3], twist[..., 3:])

        return body(self.at.trunk, self.at.trunk_v), body(self.at.box, self.at.box_v)
