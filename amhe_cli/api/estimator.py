"""The online estimator in one's own loop."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.api.arguments import checked
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief_file import belief_for
from amhe_cli.core.errors import EstimationError, LogError, one_of
from amhe_cli.core.parameters import Belief
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import Estimate, MovingHorizon, check_window
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.workers import InStep
from amhe_cli.system.system import System


class Estimator:
    """Estimates a system's parameters while samples come in; window and update period are in its settings.

    Args:
        system: Model, parameters, signals and settings.
        belief: A belief, or the path of a belief.yaml, to start from; None: the system's own prior.
        seed: Seed of the random numbers.
        threads: CPU threads; results do not depend on it.

    Raises:
        ConfigError: An argument is wrong, the belief does not suit the system, or the window is too short.
    """

    def __init__(
        self,
        system: System,
        belief: Belief | str | Path | None = None,
        *,
        seed: int = 0,
        threads: int = 1,
    ) -> None:
        hush_mujoco()
        seed, threads = checked(seed, threads)
        check_window(system.settings.mhe, system.dt)
        start = None if belief is None else belief_for(system, belief)
        engine = open_engine(system, threads=threads)

        def horizon(again: Belief | None) -> MovingHorizon:
            return MovingHorizon(system, engine, np.random.default_rng(seed), again or start)

        self._tracker = Tracker(system, InStep(horizon, latency=0.0))
        self._keys = {signal.key(quantity) for signal in system.signals for quantity in signal.quantities}

    def update(self, samples: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> Estimate | None:
        """Take in what was measured since the last call; update the estimate where an update is due.

        Args:
            samples: 'signal.quantity' -> times [s], shape (n,), and values in SI units, shape (n, k), or (n,)
                for a single column; one sample may be a number or a vector (k,). All quantities of a signal,
                velocities too, have the same times.

        Returns:
            The new estimate; None where no update was due, or the first window is not full yet.

        Raises:
            LogError: A name or a shape is wrong.
            EstimationError: The update failed.
        """
        news = self._tracker.feed({key: self._checked(key, *pair) for key, pair in samples.items()})
        news += self._tracker.feed({})  # what was computed just now
        for one in news:
            if not isinstance(one, Estimate):
                raise EstimationError(one.text)
        return next((one for one in reversed(news) if isinstance(one, Estimate)), None)

    def _checked(self, key: str, times: ArrayLike, values: ArrayLike) -> tuple[FloatArray, FloatArray]:
        if key not in self._keys:
            raise LogError(f"samples: {one_of('series', key, self._keys)}")
        stamps = np.atleast_1d(np.asarray(times, dtype=np.float64))
        array = np.asarray(values, dtype=np.float64)
        rows = len(array) if array.ndim == 2 else stamps.size
        if stamps.ndim != 1 or rows != stamps.size or array.size % max(rows, 1):
            raise LogError(f"samples: {key}: values of shape {array.shape} for times of shape {stamps.shape}")
        return stamps, array.reshape(stamps.size, -1)
