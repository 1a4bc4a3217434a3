"""Rollouts spread over an executor's workers: the same numbers, to the bit, as the engine of one process.

Rollouts do not see each other, so rows can be computed anywhere. What travels is states in and states out.
"""

from __future__ import annotations

import pickle
import zlib
from concurrent.futures import BrokenExecutor, CancelledError, Executor
from functools import lru_cache

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import AmheError
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.quiet import hush_mujoco
from amhe_cli.engine.rollout import Rollouts
from amhe_cli.system.edits import ModelEdits

#: A part of a call has at least so many rollouts, and a call at most so many parts.
_LEAST, _MOST = 8, 64


class SpreadEngine:
    """A rollout engine whose rollouts are done by others.

    Args:
        executor: Open as long as the engine is used.
        model, edits, input_spec, sensors: As of `CpuEngine`.
    """

    def __init__(
        self, executor: Executor, model: mujoco.MjModel, edits: ModelEdits, input_spec: int, sensors: bool
    ) -> None:
        self._executor = executor
        # a model is megabytes, nearly all of it zeros; it goes with each part, since workers come and go
        self._blueprint = zlib.compress(pickle.dumps((model, edits, input_spec, sensors)), 1)

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `RolloutEngine.rollout`.

        Raises:
            AmheError: The workers are gone.
        """
        parts = np.array_split(np.arange(len(theta)), max(1, min(_MOST, len(theta) // _LEAST)))
        try:
            futures = [
                self._executor.submit(
                    _rollout,
                    self._blueprint,
                    theta[rows],
                    qpos[rows],
                    qvel[rows],
                    inputs[rows],
                    lengths[rows],
                )
                for rows in parts
            ]
            return _joined([future.result() for future in futures])
        except (BrokenExecutor, CancelledError):
            raise AmheError(
                "the workers are gone; with --checkpoint FILE a search goes on where it was"
            ) from None


def _rollout(
    blueprint: bytes,
    theta: FloatArray,
    qpos: FloatArray,
    qvel: FloatArray,
    inputs: FloatArray,
    lengths: IntArray,
) -> Rollouts:
    return _engine(blueprint).rollout(theta, qpos, qvel, inputs, lengths)


@lru_cache(maxsize=2)
def _engine(blueprint: bytes) -> CpuEngine:
    """A worker's own, kept from call to call."""
    hush_mujoco()
    model, edits, input_spec, sensors = pickle.loads(zlib.decompress(blueprint))
    return CpuEngine(model, edits, input_spec, 1, sensors)


def _joined(parts: list[Rollouts]) -> Rollouts:
    sensors = [part.sensordata for part in parts if part.sensordata is not None]
    return Rollouts(
        np.concatenate([part.qpos for part in parts]),
        np.concatenate([part.qvel for part in parts]),
        np.concatenate(sensors) if sensors else None,
        np.concatenate([part.completed for part in parts]),
    )
