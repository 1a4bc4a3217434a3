"""How evenly packets go out."""

from __future__ import annotations

import math

import numpy as np

_BIN, _BINS = 1e-5, 10_000


class Intervals:
    """A histogram of the time between packets, fine enough for quantiles and of one size for ever."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BINS, dtype=np.int64)
        self._last = math.nan
        self._longest = 0.0

    def see(self, time: float) -> None:
        """A packet at a time [s]."""
        interval = time - self._last
        self._last = time
        if interval >= 0.0:
            self._counts[min(int(interval / _BIN), _BINS - 1)] += 1
            self._longest = max(self._longest, interval)

    def summary(self) -> dict[str, float]:
        """Number of packets, and quantiles of the time between them [ms]."""
        total = int(self._counts.sum())
        if not total:
            return {"packets": 0}
        upto = np.cumsum(self._counts) / total
        quantiles = {
            name: round(1e3 * _BIN * (int(np.searchsorted(upto, share)) + 1), 2)
            for name, share in (("p50_ms", 0.5), ("p99_ms", 0.99), ("p999_ms", 0.999))
        }
        return {"packets": total + 1, **quantiles, "max_ms": round(1e3 * self._longest, 2)}
