"""Rollouts spread over an executor's workers: the same numbers, to the bit, as the engine of one process.

Rollouts do not depend on each other, so they can be computed anywhere. A prediction is cut by candidates,
and by clips too where there are few candidates; only the wanted numbers come back.
"""

from __future__ import annotations

import logging
import pickle
import time
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from functools import lru_cache
from typing import Any, TypeVar

import mujoco
import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.engine.cpu import CpuEngine, hush_mujoco
from amhe_cli.engine.rollout import (
    Predicted,
    Rollouts,
    Starts,
    Wanted,
    candidates_last,
    cut,
    joined,
    predicted_in_parts,
)
from amhe_cli.system.parameters.model_edits import ModelEdits
from amhe_cli.system.provenance import versions

logger = logging.getLogger(__name__)

#: A part of a call has at least so many rollouts.
_LEAST = 8
#: A call has at most so many parts.
_MOST = 64
#: Silence of all workers after which Ctrl-C ends a call at once [s].
_QUIET = 5.0
#: Silence of all workers that is warned of [s].
_DOUBTED = 60.0
#: Silence of all workers after which they are given up [s]; dask gives work of one that hangs to another
#: after 300 s.
_LOST = 600.0

T = TypeVar("T")


class SpreadEngine:
    """An engine whose rollouts are computed by the workers of an executor, one thread each.

    Args:
        executor: Executor of the rollouts; open as long as the engine is used.
        model: The model to roll out.
        edits: How parameters are written into it.
        input_spec: mjtState bits of the input vector.
        sensors: Whether rollouts record sensors.
    """

    def __init__(
        self, executor: Executor, model: mujoco.MjModel, edits: ModelEdits, input_spec: int, sensors: bool
    ) -> None:
        self._executor, self._edits, self._input_spec, self._sensors = executor, edits, input_spec, sensors
        # a model is megabytes, nearly all of it zeros; it goes with each part, since workers come and go
        packed = zlib.compress(pickle.dumps((model, edits, input_spec, sensors)), 1)
        self._blueprint = pickle.dumps((versions(), packed))

    precision, device_bytes = float(np.finfo(np.float64).eps), 0

    def rollout(
        self, theta: FloatArray, qpos: FloatArray, qvel: FloatArray, inputs: FloatArray, lengths: IntArray
    ) -> Rollouts:
        """See `Engine.rollout`.

        Raises:
            AmheError: The workers are gone.
        """
        each = [
            (theta[rows], qpos[rows], qvel[rows], inputs[rows], lengths[rows])
            for rows in cut(len(theta), min(_MOST, len(theta) // _LEAST))
        ]
        return joined(self._gathered(_rollout, each))

    def predict(
        self, theta: FloatArray, starts: Starts, errors: FloatArray | None, wanted: Sequence[Wanted]
    ) -> Predicted:
        """See `Engine.predict`.

        Raises:
            AmheError: The workers are gone.
        """
        count, clips = len(theta), len(starts.lengths)
        most = max(1, min(_MOST, count * clips // _LEAST))
        parts = min(count, most), most // min(count, most)
        return predicted_in_parts(
            parts, theta, starts, errors, wanted, lambda each: self._gathered(_predict, each)
        )

    def upon(self, model: mujoco.MjModel, edits: ModelEdits | None = None) -> SpreadEngine:
        """See `Engine.upon`."""
        edits = edits or self._edits.upon(model)
        return SpreadEngine(self._executor, model, edits, self._input_spec, self._sensors)

    def _gathered(self, function: Callable[..., T], parts: Sequence[tuple[Any, ...]]) -> list[T]:
        """Results of all parts, in their order."""
        try:
            futures = [self._executor.submit(function, self._blueprint, *part) for part in parts]
            _wait(futures)
            return [future.result() for future in futures]
        except (BrokenExecutor, CancelledError):
            raise AmheError(
                "the workers are gone: start them again; a search with a checkpoint goes on where it was"
            ) from None


def _wait(futures: Sequence[Future[Any]]) -> None:
    """Wait for all, as long as one or other is answered.

    Raises:
        AmheError: No worker has answered for long, or for some seconds when Ctrl-C came.
        Exception: What a worker raised.
    """
    waiting, last, doubted = set(futures), time.monotonic(), False
    silence = 0.0
    try:
        while waiting:
            ended, waiting = wait(waiting, 1.0, FIRST_COMPLETED)
            for future in ended:
                future.result()
            last = time.monotonic() if ended else last
            silence = time.monotonic() - last
            if silence > _LOST:
                raise AmheError(f"no worker has answered for {silence:.0f} s: start them again")
            if silence > _DOUBTED and not doubted:
                logger.warning("no worker has answered for %.0f s: one may hang; Ctrl-C gives up", silence)
                doubted = True
    except KeyboardInterrupt:
        if silence > _QUIET:  # what is found is no result yet, and to conclude takes workers
            raise AmheError(f"interrupted while no worker had answered for {silence:.0f} s") from None
        raise


def _rollout(blueprint: bytes, *arguments: Any) -> Rollouts:
    return _engine(blueprint).rollout(*arguments)


def _predict(blueprint: bytes, *arguments: Any) -> Predicted:
    return candidates_last(_engine(blueprint).predict(*arguments))


@lru_cache(maxsize=2)
def _engine(blueprint: bytes) -> CpuEngine:
    """The engine of a worker, kept from call to call.

    Raises:
        ConfigError: The worker has other versions than the process that asks: results would be mixed.
    """
    hush_mujoco()
    wanted, packed = pickle.loads(blueprint)
    for name, there in versions().items():
        if name != "python" and there != wanted[name]:
            raise ConfigError(
                f"a worker runs {name} {there}, and this command {wanted[name]}: install the same everywhere"
            )
    model, edits, input_spec, sensors = pickle.loads(zlib.decompress(packed))
    return CpuEngine(model, edits, input_spec, 1, sensors)
