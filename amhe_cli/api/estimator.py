"""The online estimator in one's own loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from amhe_cli.api.arguments import checked
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief
from amhe_cli.core.errors import EstimationError, LogError, one_of
from amhe_cli.core.from_arrays import check_times, floats, unit_quaternions
from amhe_cli.core.log import Samples
from amhe_cli.core.signals import DERIVED
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
        belief_anyway, fix, only, seed, threads, engine: As in `identify`; `threads` is one unless given.

    Raises:
        ConfigError: An argument is wrong, the belief does not suit the system, or the window is too short.
    """

    def __init__(
        self,
        system: System,
        belief: Belief | str | Path | None = None,
        *,
        belief_anyway: bool = False,
        fix: Mapping[str, float] | None = None,
        only: Sequence[str] | None = None,
        seed: int = 0,
        threads: int = 1,
        engine: str = "cpu",
    ) -> None:
        hush_mujoco()
        seed, threads = checked(seed, threads)
        check_window(system.settings.mhe, system.dt)
        system, start = system.starting_from(belief, fix=fix, only=only, belief_anyway=belief_anyway)
        opened = open_engine(system, threads=threads, kind=engine)

        def horizon(again: Belief | None) -> MovingHorizon:
            return MovingHorizon(system, opened, np.random.default_rng(seed), again or start)

        self._tracker = Tracker(system, InStep(horizon, latency=0.0))
        self._offsets = {signal.key(q): signal.offset for signal in system.signals for q in signal.quantities}
        self._keys = [[signal.key(quantity) for quantity in signal.quantities] for signal in system.signals]
        self._widths = dict(system.widths)
        self._newest: dict[str, float] = {}

    def update(self, samples: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> Estimate | None:
        """Take in what was measured since the last call; update the estimate where an update is due.

        Args:
            samples: 'signal.quantity' -> times [s], shape (n,), and values in SI units, shape (n, k), or (n,)
                for a single column; one sample may be a number or a vector (k,). All quantities of a signal
                have the same times, which increase within a call and from call to call. Velocities that are
                never given, as of encoders, are differentiated. A value that is NaN was not measured.

        Returns:
            The new estimate; None where no update was due, or the first window is not full yet.

        Raises:
            LogError: A name, a shape or a time is wrong, or a quantity is missing; no sample was taken in.
            EstimationError: The update failed.
        """
        news = self._tracker.feed(self._checked(samples))
        news += self._tracker.feed({})  # what was computed just now
        for one in news:
            if not isinstance(one, Estimate):
                raise EstimationError(one.text)
        return next((one for one in reversed(news) if isinstance(one, Estimate)), None)

    def _checked(self, samples: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> Samples:
        """The samples as arrays; they are remembered once all of them are right."""
        known = [key for keys in self._keys for key in keys]
        for key in samples:
            if key not in known:
                raise LogError(f"samples: {one_of('series', key, known)}")
        given = {key: self._series(key, pair) for key, pair in samples.items()}
        given = {key: series for key, series in given.items() if series[0].size}
        for keys in self._keys:
            first, *others = [key for key in keys if key in given] or [""]
            for key in keys if first else ():
                if key not in given and not self._derived(key, given):
                    raise LogError(f"samples: {key} is missing; give {' and '.join(keys)} together")
            for key in others:
                if not np.array_equal(given[key][0], given[first][0]):
                    raise LogError(f"samples: {key}: its times differ from those of {first}; give the same")
        self._widths |= {key: values.shape[1] for key, (_, values) in given.items()}
        self._newest |= {key: float(times[-1]) for key, (times, _) in given.items()}
        return given

    def _derived(self, key: str, given: Samples) -> bool:
        """Whether a velocity was never given, and can be had from its positions."""
        name, _, quantity = key.rpartition(".")
        return key not in self._newest and f"{name}.{DERIVED.get(quantity)}" in given

    def _series(self, key: str, pair: tuple[ArrayLike, ArrayLike]) -> tuple[FloatArray, FloatArray]:
        """Times (n,) and values (n, k) of one quantity, checked."""
        where = f"samples: {key}"
        try:
            times, values = pair
        except (TypeError, ValueError):
            raise LogError(f"{where}: give a pair of times and values") from None
        # copies, since a loop may fill the same arrays again
        stamps = np.atleast_1d(floats(times, f"{where}: time")) + self._offsets[key]
        array = floats(values, f"{where}: values").copy()
        rows = array if array.ndim > 1 else array.reshape((1, -1) if stamps.size == 1 else (-1, 1))
        width = self._widths.get(key) or (4 if key.endswith(".orientation") else max(rows.shape[-1], 1))
        if (
            stamps.ndim != 1
            or rows.shape[0] != stamps.size
            or (stamps.size and rows.shape != (stamps.size, width))
        ):
            raise LogError(
                f"{where}: values of shape {array.shape} for times of shape {stamps.shape}; give a row "
                f"for each time, shape (n, {width})"
            )
        check_times(stamps, where)
        newest = self._newest.get(key, -np.inf)
        if stamps.size and stamps[0] <= newest:
            raise LogError(
                f"{where}: time goes from {newest:g} to {stamps[0]:g} s; give samples in order, each once, "
                f"and make a new Estimator where the clock starts again"
            )
        return stamps, unit_quaternions(rows, where) if key.endswith(".orientation") and stamps.size else rows
