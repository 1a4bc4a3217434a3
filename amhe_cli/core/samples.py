"""Measurements from any source: each quantity's samples at their own times.

Logs, simulated plants, a robot's link and live topics make samples; ring buffer, estimators and recorders
take them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log

#: 'signal.quantity', such as 'box.position' -> times [s], shape (n,), and SI values, shape (n, k), with their
#: columns in the order of the signal's names. The quantities of one signal share their times.
Samples: TypeAlias = Mapping[str, tuple[FloatArray, FloatArray]]


def sampled(log: Log) -> Samples:
    """The measured rows of a log, without those that were interpolated; times count from its row 0 [s]."""
    times = log.dt * np.arange(log.steps, dtype=np.float64)
    return {key: (times[series.sampled], series.values[series.sampled]) for key, series in log.series.items()}


def merged(parts: Sequence[Samples]) -> Samples:
    """All samples of several parts, each quantity in the order of time."""
    if len(parts) == 1:
        return parts[0]
    return {key: _joined([part[key] for part in parts if key in part]) for key in _keys(parts)}


def since(samples: Samples, time: float) -> Samples:
    """The samples that were taken at a time [s] or later."""
    return {key: (times[times >= time], values[times >= time]) for key, (times, values) in samples.items()}


class Thinner:
    """Keeps the first sample of each period, whatever jitters or is lost.

    It takes samples in the order of time.

    Args:
        period: Time between two samples that are kept [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._reached: dict[str, float] = {}

    def thinned(self, samples: Samples) -> Samples:
        """The next samples, without those that are left out."""
        return {key: self._kept(key, *series) for key, series in samples.items()}

    def _kept(self, key: str, times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        number = np.floor(times / self._period + 1e-6)
        reached = np.maximum.accumulate(np.append(self._reached.get(key, -np.inf), number))
        self._reached[key] = float(reached[-1])
        rows = np.flatnonzero(number > reached[:-1])
        return times[rows], values[rows]


def _keys(parts: Sequence[Samples]) -> list[str]:
    return list(dict.fromkeys(key for part in parts for key in part))


def _joined(series: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    times, values = (np.concatenate(arrays) for arrays in zip(*series, strict=True))
    order = np.argsort(times, kind="stable")
    return times[order], values[order]
