"""What a card is asked: rollouts of many candidates on many clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from heapq import heapreplace

import numpy as np
from numpy.typing import NDArray

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import SimulationError
from amhe_cli.engine.auto import StepCost
from amhe_cli.engine.rollout import Wanted


class NoRoomError(SimulationError):
    """The card has too little free memory; fewer rollouts at once need less."""


@dataclass(frozen=True, eq=False)
class Job:
    """n rollouts, each of one candidate on one clip.

    Args:
        fields: Numbers of the model that parameters set, by their field, shape (p, ...) each.
        delays: Delays of each candidate's inputs [steps], shape (p, nu), or (p, 1) where all are alike.
        inputs: Inputs of each clip, single precision, shape (c, history + H, nu).
        history: Steps that they reach back before the start.
        lengths: Steps of each clip, shape (c,).
        candidate, clip: Candidate and clip of each rollout, shape (n,).
        queue: Rollouts of each world, one after the other and all of one candidate; -1 where there is none,
            but the first. Shape (w, l).
        qpos, qvel: First states, shape (n, nq) and (n, nv).
        wanted: The numbers to pick.
    """

    fields: Mapping[str, FloatArray]
    delays: FloatArray
    inputs: NDArray[np.float32]
    history: int
    lengths: IntArray
    candidate: IntArray
    clip: IntArray
    queue: IntArray
    qpos: FloatArray
    qvel: FloatArray
    wanted: Sequence[Wanted]

    @property
    def lag(self) -> int:
        """Steps after a clip's last that its samples need: sensors describe the state before a step."""
        return int(any(wanted.source == "sensordata" for wanted in self.wanted))

    @property
    def ends(self) -> IntArray:
        """Steps after which each rollout of the queues is over, shape (w, l)."""
        steps = np.where(self.queue < 0, 0, (self.lengths + self.lag)[self.clip[self.queue]])
        return steps.cumsum(axis=1)


def queues(lengths: IntArray, count: int, cost: StepCost) -> IntArray:
    """Which clips the worlds of each candidate roll out, one after the other, -1 where there is no more.

    All worlds step until the longest queue is done. With one clip each, most of them would wait for the
    longest clip; with several, there are fewer worlds, of which a step takes longer for each.

    Args:
        lengths: Steps of c clips, shape (c,).
        count: Number of candidates.
        cost: What a step takes.

    Returns:
        Clips of m worlds, shape (m, l): the least m of the least time.
    """
    clips, best, least = len(lengths), [], np.inf
    for worlds in range(clips, 0, -1):
        free = [(0, world) for world in range(worlds)]
        dealt: list[list[int]] = [[] for _ in free]
        for clip in np.argsort(-lengths, kind="stable"):  # the longest first, to the world that is free first
            end, world = free[0]
            dealt[world].append(int(clip))
            heapreplace(free, (end + int(lengths[clip]), world))
        if (time := max(free)[0] * cost.on_card(count * worlds)) <= least:
            best, least = dealt, time
    longest = max(map(len, best))
    return np.array([row + (longest - len(row)) * [-1] for row in best])
