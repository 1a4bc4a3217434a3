"""What was measured, whoever measured it: each quantity's samples at their own times.

Logs, simulated plants, a robot's link and live topics make samples; ring buffer, estimators and recorders
take them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log

#: 'signal.quantity', such as 'box.position' -> times [s], shape (n,), and SI values, shape (n, k), with their
#: columns in the order of the signal's names. The quantities of one signal share their times.
Samples: TypeAlias = Mapping[str, tuple[FloatArray, FloatArray]]


def sampled(log: Log) -> Samples:
    """The measured rows of a log, without those that were interpolated; times count from its row 0 [s]."""
    rows = {key: np.flatnonzero(series.sampled) for key, series in log.series.items()}
    return {key: (log.dt * rows[key], log[key].values[rows[key]]) for key in rows}
