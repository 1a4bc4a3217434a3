"""What a card is asked: rollouts of many candidates on many clips, those of several askers side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as dataclass_fields
from heapq import heapreplace
from typing import Any

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

    @property
    def picks(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """From where it picks numbers: jobs that pick from the same can be one."""
        return tuple((wanted.source, wanted.columns) for wanted in self.wanted)


def joined(jobs: Sequence[Job]) -> Job:
    """Jobs upon one model, that pick from the same arrays, as one; its rollouts are theirs in their order."""
    if len(jobs) == 1:
        return jobs[0]
    history, steps = max(job.history for job in jobs), max(int(job.lengths.max()) for job in jobs)
    longest, width = max(job.queue.shape[1] for job in jobs), max(job.delays.shape[1] for job in jobs)
    parts: dict[str, list[Any]] = {each.name: [] for each in dataclass_fields(Job)}
    candidates = clips = rollouts = 0
    for job in jobs:
        before, own = history - job.history, job.inputs[:, : job.history + int(job.lengths.max())]
        # beyond its ends a history holds its first and last input
        ends = (0, 0), (before, history + steps - own.shape[1] - before), (0, 0)
        queue = np.full((len(job.queue), longest), -1)
        queue[:, : job.queue.shape[1]] = np.where(job.queue < 0, -1, rollouts + job.queue)
        moved = {
            "delays": np.broadcast_to(job.delays, (len(job.delays), width)),
            "inputs": np.pad(own, ends, mode="edge"),
            "candidate": candidates + job.candidate,
            "clip": clips + job.clip,
            "queue": queue,
        }
        for name, values in parts.items():
            values.append(moved.get(name, getattr(job, name)))
        candidates, clips = candidates + len(job.delays), clips + len(job.lengths)
        rollouts += len(job.clip)
    fields, wanted = parts.pop("fields"), zip(*parts.pop("wanted"), strict=True)
    del parts["history"]
    return Job(
        fields={name: np.concatenate([each[name] for each in fields]) for name in fields[0]},
        history=history,
        wanted=[_beside(each, steps) for each in wanted],
        **{name: np.concatenate(values) for name, values in parts.items()},
    )


def _beside(wanted: Sequence[Wanted], steps: int) -> Wanted:
    """What is wanted of some clips and of others; no row is wanted past the last step."""
    rows = np.full((sum(len(one.rows) for one in wanted), max(one.rows.shape[1] for one in wanted)), steps)
    at = 0
    for one in wanted:
        rows[at : at + len(one.rows), : one.rows.shape[1]] = one.rows
        at += len(one.rows)
    return replace(wanted[0], rows=rows)


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
    for worlds in dict.fromkeys(-(-clips // each) for each in range(1, clips + 1)):
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
