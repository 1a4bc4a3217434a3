"""One card: as many worlds as a job needs, in turns by what its memory holds."""

from __future__ import annotations

import logging
import os
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from typing import Any

import mujoco_warp as mjw
import warp as wp

from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.auto import FEWEST, step_cost
from amhe_cli.engine.gpu.blueprint import Blueprint, Room, first_room
from amhe_cli.engine.gpu.job import Job, NoRoomError
from amhe_cli.engine.gpu.worlds import Worlds
from amhe_cli.engine.rollout import Predicted

logger = logging.getLogger(__name__)
wp.config.log_level = wp.LOG_WARNING  # it prints a line for each kernel otherwise

#: Share of a card's memory, and of what others leave free of it, that a set of worlds and its records take.
MEMORY_SHARE, FREE_SHARE = 0.25, 0.5
#: Buffers are doubled at most so many times; a world that needs more has not completed.
DOUBLINGS = 10
#: Sets of worlds that are kept, of different size.
KEPT = 3
#: What another set of worlds takes, for its graph more than all [s].
NEW_WORLDS = 0.5
#: Rollouts at once on warp's own processor device, which is for tests.
WITHOUT_CARD = 4096


@contextmanager
def refusals() -> Iterator[None]:
    """What warp, CuPy and mujoco-warp raise, as errors in one line.

    Raises:
        NoRoomError: The card's memory is full.
        SimulationError: They refused for another reason.
    """
    full = NoRoomError("the graphics card has too little free memory; take the engine 'cpu'")
    try:
        yield
    except MemoryError:
        raise full from None
    except Exception as error:
        if type(error) not in (RuntimeError, Exception):  # warp raises these two
            raise
        if any(sign in str(error) for sign in ("allocate", "out of memory", "primary context", "load CUDA")):
            raise full from None
        raise SimulationError(f"mujoco-warp refused a rollout: {str(error).splitlines()[0]}") from error


@cache
def in_use(device: str) -> AbstractContextManager[Any]:
    """Held by the thread that uses a card: what others launch there would be captured in its graphs."""
    return threading.RLock()


def keep_current_cards() -> None:
    """Have warp leave the current card of a thread as it was.

    By default its calls do not. So a thread that freed arrays of another card, as Python does at any time,
    was on that card afterwards, and CuPy's next call was refused, or read from the wrong card.
    """
    wp.get_device("cpu").runtime.core.wp_cuda_set_context_restore_policy(True)


@cache
def free_bytes(device: str) -> int:
    """Memory of a card that others left free when this process looked first [bytes]."""
    return int(wp.get_device(device).free_memory)


class Card:
    """The worlds of one device.

    Args:
        blueprint: What all worlds share.
        device: Warp's name of the device.

    Raises:
        SimulationError: mujoco-warp cannot simulate the model.
    """

    def __init__(self, blueprint: Blueprint, device: str) -> None:
        self.blueprint, self._device = blueprint, device
        with in_use(device), refusals():
            _check_supported(blueprint, device)
        #: Buffers of a world; they grow.
        self.room = first_room(blueprint.model)
        #: Part of the share of memory that is asked for, less where it was refused.
        self.part = 1.0
        self._kept: dict[int, Worlds] = {}
        #: Threads that compile kernels; the command's own cores, which may be fewer than the computer's.
        self.compilers = (
            len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        )
        self._bytes: dict[Room, int] = {}
        #: Seconds by which larger worlds have taken longer, by the size that was wanted.
        self._longer: dict[int, float] = defaultdict(float)
        self._cost = step_cost(blueprint.model)

    @property
    def memory(self) -> int:
        """Memory of the device that is ours to use [bytes]; 0 for warp's processor device."""
        device = wp.get_device(self._device)
        if not device.is_cuda:
            return 0
        return int(min(device.total_memory, FREE_SHARE / MEMORY_SHARE * free_bytes(self._device)))

    def run(self, job: Job) -> Predicted:
        """Run a job, again with larger buffers where they were too small.

        Returns:
            The wanted numbers, shape (n, s, k) each, and False where a rollout diverged, shape (n,).

        Raises:
            NoRoomError: The card's memory is full.
            SimulationError: mujoco-warp refused a rollout.
        """
        for last in (*DOUBLINGS * (False,), True):
            with in_use(self._device), refusals():
                values, completed, full = self.worlds(len(job.queue), int(job.ends.max())).run(job)
            if not full:
                break
            if last:
                logger.warning("the card has no room for all contacts: such rollouts count as diverged")
                break
            self.room = self.room.larger()
            self._kept.clear()
        return Predicted(tuple(values), completed)

    def follow(self, other: Card) -> None:
        """Begin with what has proved right upon another model of this layout."""
        if self._kept:
            return
        self.part, self.room, self.compilers = other.part, other.room, other.compilers
        if self.blueprint.own == other.blueprint.own:
            self._bytes = other._bytes

    def narrow(self) -> None:
        """From now on half as many rollouts at once."""
        self.part *= 0.5
        self._kept.clear()

    def at_once(self, record: int) -> int:
        """How many rollouts the device holds, each with a record of so many bytes."""
        if not self.memory:
            return WITHOUT_CARD
        if self.room not in self._bytes:
            with in_use(self._device):
                self._bytes[self.room] = bytes_per_world(self.blueprint, self.room, self._device)
        return max(1, int(self.part * MEMORY_SHARE * self.memory / (self._bytes[self.room] + record)))

    def worlds(self, count: int, steps: int = 0) -> Worlds:
        """Worlds for so many queues and steps, of few different sizes, so that they are used again.

        Up to some thousand worlds a step takes as long as that of one. Larger worlds that there are serve
        until their steps have taken longer by what new ones would take: at most twice the least time.
        """
        least = FEWEST if self.memory else 16
        grain = max(least, 2 ** (max(count - 1, 1).bit_length() - 6))
        size = -(-count // grain) * grain
        larger, cost = min((kept for kept in self._kept if kept > size), default=size), self._cost
        if size not in self._kept:
            self._longer[size] += steps * (cost.on_card(larger) - cost.on_card(size))
            size = larger if self._longer[size] < NEW_WORLDS else size
        worlds = self._kept.pop(size, None)
        if worlds is None:
            while len(self._kept) >= KEPT:
                del self._kept[next(iter(self._kept))]
            worlds = Worlds(self.blueprint, size, self.room, self._device, compilers=self.compilers)
            self.compilers = self._longer[size] = 0
        self._kept[size] = worlds  # the last used is the last to go
        return worlds


def _check_supported(blueprint: Blueprint, device: str) -> None:
    """Refuse a model that mujoco-warp cannot simulate, before any work is done.

    Raises:
        SimulationError: It cannot; the text says what it lacks.
    """
    try:
        with wp.ScopedDevice(device):
            mjw.put_model(blueprint.model)
    except (NotImplementedError, ValueError) as error:
        lacks = str(error).rstrip(".")
        raise SimulationError(
            f"mujoco-warp cannot simulate this model: {lacks}; take the engine 'cpu'"
        ) from None
    if not blueprint.starts_at_rest():
        raise SimulationError("filters and slews of actuators start at rest on a card; take the engine 'cpu'")


def bytes_per_world(blueprint: Blueprint, room: Room, device: str) -> int:
    """Memory of one world [bytes]: how much two more take than one."""
    with wp.ScopedDevice(device):
        sizes = [
            _bytes(mjw.make_data(blueprint.model, count, room.contacts, njmax=room.rows)) for count in (1, 3)
        ]
        own = mjw.put_model(blueprint.model)
    model: Mapping[str, Any] = vars(own)
    return (sizes[1] - sizes[0]) // 2 + sum(model[name].capacity for name in blueprint.own)


def _bytes(owner: Any) -> int:
    """Memory of all arrays of an object."""
    total = 0
    for value in vars(owner).values():
        if isinstance(value, wp.array):
            total += value.capacity
        elif hasattr(value, "__dict__"):
            total += _bytes(value)
    return total
