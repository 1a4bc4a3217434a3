"""The content of a run's result.json."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np

from amhe_cli.core.errors import Ending
from amhe_cli.core.files import plain
from amhe_cli.core.statistics import quantiles
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.judge import Measures


def run_record(measures: Measures, history: History, ending: Ending) -> dict[str, Any]:
    """Outcome of a run as plain values, ready for JSON; numbers that do not exist are None.

    Args:
        measures: Success, errors and cost of the run.
        history: Cycles and online estimates of the run.
        ending: How the loop ended.
    """
    numbers = asdict(measures)
    terms = numbers.pop("terms")
    columns = history.columns()
    return plain(
        {
            **numbers,
            "interrupted": ending.interrupted,
            "error": None if ending.error is None else str(ending.error),
            "trip": getattr(ending.error, "trip", "") or None,
            "cost_terms": terms,
            "belief": history.belief,
            "estimator": _estimator(history),
            "truth": history.truth,
            "cycles": history.cycles,
            "cycle_ms": quantiles(columns.get("plan_ms", np.empty(0))),
            "deadline_misses": history.misses,
            "rollouts": int(columns["rollouts"].sum()) if columns else 0,
            "least_rollouts": int(columns["rollouts"].min()) if columns else 0,
            "diverged": int(columns["diverged"].sum()) if columns else 0,
        }
    )


def _estimator(history: History) -> dict[str, Any] | None:
    """Updates, times and troubles of the online estimator; None if the run had none."""
    found = history.estimates
    if not found:
        return None
    last = found[-1]
    return {
        "updates": len(found),
        "marks": Counter(e.mark for e in found),
        "sd": dict(zip(last.belief.names, last.sd, strict=True)),
        "update_ms": quantiles(np.array([e.update_ms for e in found if e.rollouts])),
        "diverged": sum(e.diverged for e in found),
        "troubles": history.troubles,
    }
