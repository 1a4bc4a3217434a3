"""True parameters that the log of a simulation may contain; nothing is ever fitted to them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray, IntArray
from amhe_cli.core.errors import LogError
from amhe_cli.core.log import Log
from amhe_cli.core.settings import LogSettings
from amhe_cli.core.signals import Signal
from amhe_cli.logs.read import read_signals

#: A JointState whose names are the parameters, and whose positions are their values.
TOPIC = "/amhe/truth"
#: Resolution in time [s]; and no silence is too long for a truth to hold.
_STEP, _FOREVER = 0.01, 1e9


def read_truth(path: Path, stamps_ns: IntArray, settings: LogSettings) -> dict[str, FloatArray]:
    """Values on `/amhe/truth` at some instants; {} where the log has no such topic.

    Args:
        path: The log.
        stamps_ns: The instants [ns] on the log's clock, shape (n,).
        settings: Clock settings.

    Returns:
        Parameter -> values, shape (n,). Each holds until the next; NaN before the first.
    """
    lasting = settings.model_copy(update={"max_gap": _FOREVER})
    try:
        log = read_signals(path, [Signal("truth", TOPIC, ("position",), is_input=True)], _STEP, lasting)
    except LogError:
        return {}
    series = log["truth.position"]
    row = np.floor((stamps_ns - log.start_ns) / (1e9 * _STEP) + 1e-6).astype(int)
    held = np.clip(row, 0, log.steps - 1)
    known = (row >= 0) & series.valid[held]
    return {
        name: np.where(known, series.values[held, column], np.nan)
        for column, name in enumerate(series.columns)
    }


def truth_in_metadata(logs: Sequence[Log]) -> dict[str, float]:
    """True parameters in the logs' metadata, as simulations write them; {} if they differ or are none."""
    texts = {log.metadata.get("truth") for log in logs}
    try:
        truth = json.loads(texts.pop() or "{}") if len(texts) == 1 else {}
        return {str(name): float(value) for name, value in truth.items()}
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}  # somebody else's use of the key
