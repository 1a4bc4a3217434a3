"""One card: as many worlds as a job needs, in turns by what its memory holds."""

from __future__ import annotations

import warp as wp

from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.gpu.blueprint import Blueprint, Room, bytes_per_world, first_room
from amhe_cli.engine.gpu.worlds import Job, Worlds
from amhe_cli.engine.rollout import Predicted
from amhe_cli.engine.step_cost import FEWEST

#: Share of the memory of a card that one set of worlds and its records may take.
MEMORY_SHARE = 0.25
#: Buffers are doubled at most so many times; a world that needs more has not completed.
DOUBLINGS = 4
#: Sets of worlds that are kept, of different size.
KEPT = 3
#: Rollouts at once on warp's own processor device, which is for tests.
WITHOUT_CARD = 4096


class Card:
    """The worlds of one device.

    Args:
        blueprint: What all worlds share.
        device: Warp's name of the device.
    """

    def __init__(self, blueprint: Blueprint, device: str) -> None:
        self.blueprint, self._device = blueprint, device
        #: Buffers of a world; they grow.
        self.room = first_room(blueprint.model)
        self._kept: dict[int, Worlds] = {}
        self._bytes: dict[Room, int] = {}

    @property
    def memory(self) -> int:
        """Memory of the device [bytes]; 0 for warp's processor device."""
        device = wp.get_device(self._device)
        return device.total_memory if device.is_cuda else 0

    def run(self, job: Job) -> Predicted:
        """Run a job, again with larger buffers where they were too small.

        Returns:
            The wanted numbers, shape (n, s, k) each, and False where a rollout diverged, shape (n,).

        Raises:
            SimulationError: mujoco-warp refused a rollout.
        """
        for last in (*DOUBLINGS * (False,), True):
            try:
                values, completed, full = self.worlds(len(job.queue)).run(job)
            except RuntimeError as error:
                raise SimulationError(f"mujoco-warp refused a rollout: {error}") from error
            if last or not full:
                break
            self.room = self.room.larger()
            self._kept.clear()
        return Predicted(tuple(values), completed)

    def at_once(self, record: int) -> int:
        """How many rollouts the device holds, each with a record of so many bytes."""
        if not self.memory:
            return WITHOUT_CARD
        if self.room not in self._bytes:
            self._bytes[self.room] = bytes_per_world(self.blueprint, self.room, self._device)
        return max(1, int(MEMORY_SHARE * self.memory / (self._bytes[self.room] + record)))

    def worlds(self, count: int) -> Worlds:
        """Worlds for so many queues, of few different sizes, so that they are used again.

        Up to some thousand worlds a step takes as long as that of one.
        """
        least = FEWEST if self.memory else 16
        grain = max(least, 2 ** (max(count - 1, 1).bit_length() - 6))
        size = -(-count // grain) * grain
        worlds = self._kept.pop(size, None)
        if worlds is None:
            while len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]
            worlds = Worlds(self.blueprint, size, self.room, self._device)
        self._kept[size] = worlds  # the last used is the last to go
        return worlds
