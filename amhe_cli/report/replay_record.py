"""What a replay found as plain values: the content of result.json, and of estimates.csv."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import plain
from amhe_cli.core.statistics import quantiles
from amhe_cli.estimation.offline.identifiability import combinations
from amhe_cli.estimation.offline.result import Combination
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.report.words import MAX_COMBINATIONS, sharper

#: Settings of the estimator that the paper calls its hyper-parameters.
_SETTINGS = ("window", "update_period", "learning_rate", "prior_weight")


def replay_record(replay: Replay) -> dict[str, Any]:
    """The keys of `amhe mhe-replay`, ready for JSON; a number that does not exist is None."""
    setting, marks = replay.system.settings.mhe, replay.marks
    return plain(
        {
            "system": replay.system.name,
            "log": replay.windows[0].log.source,
            "method": setting.method,
            "settings": {name: getattr(setting, name) for name in _SETTINGS}
            | {"samples": setting.sample_count, "iterations": setting.iteration_count},
            "interrupted": replay.interrupted,
            "end_s": float(replay.times[-1]),
            "parameters": [_parameter(replay, i) for i in range(len(replay.system.space))],
            "combinations": [{"text": c.text, "sd": c.sd} for c in _together(replay)],
            "windows": len(replay.windows),
            "updated": marks["updated"] + marks["jump"],
            "jumps": marks["jump"],
            "still": marks["still"],
            "gaps": marks["gap"],
            "lost": marks["diverged"],
            "misfit": _median(replay.column("misfit")),
            "rollouts": {
                "count": int(replay.column("rollouts").sum()),
                "diverged": int(replay.column("diverged").sum()),
            },
            "update_ms": quantiles(replay.update_ms),
            "real_time_factor": round(replay.real_time_factor, 3),
        }
    )


def _parameter(replay: Replay, i: int) -> dict[str, Any]:
    parameter, last = replay.system.space.parameters[i], replay.estimates[-1]
    truth = replay.truth.get(parameter.name)
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "estimate": last.theta[i],
        "sd": last.sd[i],
        "lower": last.lower[i],
        "upper": last.upper[i],
        "start": replay.start_theta[i],
        "truth": math.nan if truth is None else truth[-1],
        "coverage": math.nan if truth is None else _coverage(replay, i, truth),
    }


def _coverage(replay: Replay, i: int, truth: FloatArray) -> float:
    """Share of the estimates whose 90 % interval holds the truth; NaN where it is never told."""
    told = np.isfinite(truth)
    inside = (replay.column("lower")[:, i] <= truth) & (truth <= replay.column("upper")[:, i])
    return float(inside[told].mean()) if told.any() else math.nan


def _together(replay: Replay) -> list[Combination]:
    """Products that the last estimate knows better than any of their factors, best first."""
    space, last = replay.system.space, replay.estimates[-1]
    in_z = last.belief.covariance / np.outer(space.prior_sd, space.prior_sd)
    relative = dict(zip(space.names, last.sd / np.abs(last.theta), strict=True))
    every = np.ones(len(space), dtype=bool)
    return sharper(combinations(space, in_z, every), relative)[:MAX_COMBINATIONS]


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def estimates_csv(replay: Replay) -> str:
    """The content of estimates.csv: a line for each window; what does not exist is empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(list(_header(replay)))
    for i in range(len(replay.estimates)):
        table.writerow(list(_row(replay, i)))
    return text.getvalue()


def _header(replay: Replay) -> Iterable[str]:
    yield "time"
    for name in replay.system.space.names:
        yield from (name, f"{name}_sd", *([f"{name}_true"] if name in replay.truth else []))
    yield from ("misfit", "updated", "update_ms", "mark", "excitation")


def _row(replay: Replay, i: int) -> Iterable[str]:
    estimate = replay.estimates[i]
    yield _cell(replay.times[i])
    for column, name in enumerate(replay.system.space.names):
        yield _cell(estimate.theta[column])
        yield _cell(estimate.sd[column])
        if name in replay.truth:
            yield _cell(replay.truth[name][i])
    yield _cell(estimate.misfit)
    yield str(int(estimate.updated))
    yield f"{estimate.update_ms:.1f}"
    yield estimate.mark
    yield _cell(estimate.excitation)


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""
