"""The quicker engine: the processor for calls of few rollouts, the graphics cards for those of many."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import NOTE, ConfigError
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.rollout import Engine, Predicted, Rollouts, Starts, Wanted
from amhe_cli.engine.states import collides
from amhe_cli.system.edits import ModelEdits

logger = logging.getLogger(__name__)

#: Loading the libraries of the cards and capturing the first graphs takes so long [s].
START = 7.0
#: Calls like the first large one that a command is expected to make.
FOLLOWING = 10


@dataclass(frozen=True, slots=True)
class StepCost:
    """What a step of a model takes (docs/gpu.md): one H100, and the cores beside it.

    Args:
        contacts: Whether it can collide.
        dofs: Its degrees of freedom.
        core: Time of one step on one core [s].
        card: Time of one step of up to a thousand worlds on a card [s].
        world: Time that each world more takes there [s].
    """

    contacts: bool
    dofs: int
    core: float
    card: float
    world: float


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


class AutoEngine:
    """The processor's engine, and that of the cards for calls that are large enough.

    Which of them computes a call follows from its size and the table alone, so that results repeat on a
    computer. The cards are opened by the first call that is worth it.

    Args:
        cpu: The engine of the processor.
        cards: Opens the engine of the cards.
        model: Model of both.
        threads: Threads of the processor's engine.
    """

    precision = float(np.finfo(np.float32).eps)

    def __init__(
        self, cpu: CpuEngine, cards: Callable[[], Engine], model: mujoco.MjModel, threads: int
    ) -> None:
        self._cpu, self._open, self._threads = cpu, cards, threads
        self._line, self._cards, self._saved = step_cost(model), None, 0.0

    @property
    def fewest(self) -> float:
        """Number of rollouts at once from which the cards are quicker; inf if they never are."""
        each = self._line.core / self._threads - self._line.world
        return self._line.card / each if each > 0.0 else np.inf

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `Engine.rollout`."""
        return self._quicker(len(lengths), int(lengths.max())).rollout(theta, qpos, qvel, inputs, lengths)

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`."""
        engine = self._quicker(len(theta) * len(starts.lengths), int(starts.lengths.max()))
        return engine.predict(theta, starts, errors, wanted)

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> AutoEngine:
        """See `Engine.upon`."""
        cpu, cards = self._cpu.upon(model, edits), lambda: self._opened().upon(model, edits)
        return AutoEngine(cpu, cards, model, self._threads)

    def _quicker(self, count: int, steps: int) -> Engine:
        """The engine for a call of so many rollouts of so many steps."""
        if count < self.fewest:
            return self._cpu
        if self._cards is None:
            gained = steps * self._line.card * (count / self.fewest - 1.0)
            self._saved += gained
            if self._saved + FOLLOWING * gained < START:
                return self._cpu
        return self._opened()

    def _opened(self) -> Engine:
        if self._cards is None:
            try:
                self._cards = self._open()
            except ConfigError as error:
                logger.log(NOTE, "the CPU computes all rollouts: %s", error)
                self._cards = self._cpu
        return self._cards
