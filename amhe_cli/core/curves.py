"""Numbers over time that are shown beside a log: estimates with their bands, cost, speed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from amhe_cli.core.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TimeCurve:
    """One number over time.

    Args:
        name: What it is.
        group: Those of one group are shown together.
        unit: Its unit; empty: it has none.
        times: Times from the log's start [s], shape (n,).
        values: The number, shape (n,).
        band: Lower and upper end of its 90 % interval, shape (2, n); None: it has none.
    """

    name: str
    group: str
    unit: str = ""
    times: FloatArray = field(default_factory=lambda: np.empty(0))
    values: FloatArray = field(default_factory=lambda: np.empty(0))
    band: FloatArray | None = None
