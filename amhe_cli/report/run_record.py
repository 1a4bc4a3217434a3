"""What a run brought as plain values: the content of its result.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.live.drive import Ending
from amhe_cli.live.evaluation import Measures
from amhe_cli.live.history import History
from amhe_cli.report.record import plain


def run_record(measures: Measures, history: History, ending: Ending) -> dict[str, Any]:
    """The keys of `amhe run` that tell of the outcome, ready for JSON; what does not exist is None."""
    numbers = asdict(measures)
    terms = numbers.pop("terms")
    columns = history.columns()
    return plain(
        {
            **numbers,
            "interrupted": ending.interrupted,
            "error": None if ending.error is None else str(ending.error),
            "cost_terms": terms,
            "belief": history.belief,
            "truth": history.truth,
            "cycles": history.cycles,
            "cycle_ms": _quantiles(columns.get("plan_ms", np.empty(0))),
            "deadline_misses": history.misses,
            "rollouts": int(columns["rollouts"].sum()) if columns else 0,
            "diverged": int(columns["diverged"].sum()) if columns else 0,
        }
    )


def _quantiles(values: FloatArray) -> dict[str, float]:
    if not values.size:
        return {"p50": np.nan, "p99": np.nan}
    return {"p50": round(float(np.median(values)), 3), "p99": round(float(np.quantile(values, 0.99)), 3)}
