"""What a step of a model takes on a core and on a card, by a table older than that of docs/gpu.md."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.engine.states import collides

#: A card has at least so many worlds; fewer would be no quicker.
FEWEST = 1024


@dataclass(frozen=True, slots=True)
class StepCost:
    """What a step of a model takes: one H100, and the cores beside it.

    Args:
        contacts: Whether it can collide.
        dofs: Its degrees of freedom.
        core: Time of one step on one core [s].
        card: Time of one step on a card, however few the worlds are [s].
        world: Time that each world adds to it, of which there are `FEWEST` at least [s].
    """

    contacts: bool
    dofs: int
    core: float
    card: float
    world: float

    def on_card(self, worlds: int) -> float:
        """Time of one step of so many worlds on a card [s]."""
        return self.card + self.world * max(worlds, FEWEST)

    def fewest(self, threads: int) -> float:
        """Number of rollouts of one length from which a card is quicker than so many cores; inf if never."""
        each = self.core / threads
        if (few := self.on_card(1) / each) <= FEWEST:
            return few
        return self.card / (each - self.world) if each > self.world else np.inf


#: pendulum, 12 joints, cube_toss, go1_push.
TABLE = (
    StepCost(False, 1, 6.2e-6, 0.27e-3, 0.02e-6),
    StepCost(False, 12, 22e-6, 0.40e-3, 0.055e-6),
    StepCost(True, 6, 7.3e-6, 0.67e-3, 0.07e-6),
    StepCost(True, 24, 123e-6, 1.6e-3, 0.65e-6),
)


def step_cost(model: mujoco.MjModel) -> StepCost:
    """The line of the table that is nearest to a model: of those that collide or not, by its size."""
    alike = [line for line in TABLE if line.contacts == collides(model)]
    return min(alike, key=lambda line: abs(np.log(max(model.nv, 1) / line.dofs)))
