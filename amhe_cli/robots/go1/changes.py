"""Changes of a running plant: another load in the box, another floor under it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from amhe_cli.robots.go1.model import FLOOR_PAIR


def set_floor_friction(model: mujoco.MjModel, friction: float) -> None:
    """Set the friction of box against floor, in place and in both directions of the floor's plane."""
    model.pair(FLOOR_PAIR).friction[:2] = friction


def set_box_mass(model: mujoco.MjModel, mass: float) -> None:
    """Set the box's mass [kg] in place; inertia and the model's derived constants follow."""
    box = model.body("box")
    box.inertia[:] *= mass / box.mass[0]
    box.mass[0] = mass
    # Without this the contact solver keeps scaling by the old mass. It writes into the data it is given.
    mujoco.mj_setConst(model, mujoco.MjData(model))


@dataclass(frozen=True, slots=True)
class Change:
    """One change of the plant, once.

    Args:
        mass: New mass of the box [kg]; None: as it is.
        floor_friction: New friction of box against floor; None: as it is.
        at_time: When [s]; None: whenever the place says.
        beyond_x: As soon as the box's centre passes this x [m]; None: whenever the time says.
    """

    mass: float | None = None
    floor_friction: float | None = None
    at_time: float | None = None
    beyond_x: float | None = None

    def due(self, time: float, box_x: float) -> bool:
        """Whether the change has come, at this time [s] and place of the box [m]."""
        late = self.at_time is not None and time >= self.at_time
        far = self.beyond_x is not None and box_x >= self.beyond_x
        return late or far

    def apply(self, model: mujoco.MjModel) -> None:
        """Write the new numbers into the plant's model."""
        if self.mass is not None:
            set_box_mass(model, self.mass)
        if self.floor_friction is not None:
            set_floor_friction(model, self.floor_friction)
