"""The files of a replay: result.json, estimates.csv, and estimates.mcap for any log viewer."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.files import plain
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Signal
from amhe_cli.core.statistics import quantiles
from amhe_cli.estimation.core.result import Combination, sharper
from amhe_cli.estimation.online import messages
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.replay import Prediction, Replay
from amhe_cli.estimation.uncertainty.derived import combinations
from amhe_cli.logs import LogWriter
from amhe_cli.logs.messages.writer import ERROR, OK, WARN, write_samples
from amhe_cli.report.identification_page import MAX_COMBINATIONS
from amhe_cli.system.provenance import attachments

#: What the mark of an estimate means.
MARKS: Mapping[str, str] = {
    "updated": "the window was used",
    "jump": "a jump was detected: the prediction missed the window by far, so the prior was widened "
    "before the update",
    "still": "the window was skipped (too little excitation)",
    "gap": "the window was skipped (a signal or an input is missing)",
    "diverged": "the window was skipped (its rollouts diverged)",
}
#: Level of each mark on /diagnostics.
_LEVELS = {"updated": OK, "jump": WARN, "still": OK, "gap": WARN, "diverged": ERROR}
_PREDICTED = "/amhe/pred"

#: Settings of the estimator that are listed in result.json.
_SETTINGS = ("window", "update_period", "learning_rate", "prior_weight")


def replay_record(replay: Replay) -> dict[str, Any]:
    """The keys of `amhe mhe-replay`, ready for JSON; numbers that do not exist are None."""
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
            "fixed": replay.system.fixed,
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
    """Share of the estimates whose 90 % interval holds the truth (n,); NaN without any true value."""
    known = np.isfinite(truth)
    inside = (replay.column("lower")[:, i] <= truth) & (truth <= replay.column("upper")[:, i])
    return float(inside[known].mean()) if known.any() else math.nan


def _together(replay: Replay) -> list[Combination]:
    """Products that the last estimate knows more precisely than any of their factors, best first."""
    space, last = replay.system.space, replay.estimates[-1]
    in_z = last.belief.covariance / np.outer(space.prior_sd, space.prior_sd)
    relative = dict(zip(space.names, np.sqrt(np.diag(last.belief.covariance)), strict=True))  # of logarithms
    every = np.ones(len(space), dtype=bool)
    return sharper(combinations(space, in_z, every), relative)[:MAX_COMBINATIONS]


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def estimates_csv(replay: Replay) -> str:
    """The content of estimates.csv: one line for each window; cells without a value are empty."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(csv_header(replay.system.space.names, replay.truth))
    for i, estimate in enumerate(replay.estimates):
        table.writerow(csv_row(estimate, {name: values[i] for name, values in replay.truth.items()}))
    return text.getvalue()


def csv_header(names: Sequence[str], truth: Collection[str] = ()) -> list[str]:
    """Columns of estimates.csv; of those parameters whose true values are known, these, too."""
    ends = [(name, end) for name in names for end in ("", "_sd", "_true") if end != "_true" or name in truth]
    values = [name + end for name, end in ends]
    return ["time", *values, "misfit", "updated", "update_ms", "mark", "excitation"]


def csv_row(one: Estimate, truth: Mapping[str, float] = MappingProxyType({})) -> list[str]:
    """Cells of one estimate."""
    values = [one.time]
    for name, value, sd in zip(one.belief.names, one.theta, one.sd, strict=True):
        values += [value, sd, *([truth[name]] if name in truth else [])]
    result = [str(int(one.updated)), f"{one.update_ms:.1f}", one.mark, _cell(one.excitation)]
    return [*map(_cell, [*values, one.misfit]), *result]


def _cell(value: float) -> str:
    return f"{value:.9g}" if math.isfinite(value) else ""


def write_log(
    path: Path, replay: Replay, predicted: Sequence[Prediction | None], metadata: Mapping[str, str]
) -> None:
    """Write estimates, true values, diagnostics and predictions, with the time stamps of the replayed log.

    Args:
        path: The .mcap file.
        predicted: For each estimate its prediction of the newest part of its window.
        metadata: The new log's metadata.
    """
    with LogWriter(path, metadata) as log:
        messages.define(log)
        for name, text in attachments(replay.system).items():
            log.attach(name, "application/yaml", text.encode())
        for i, (window, estimate) in enumerate(zip(replay.windows, replay.estimates, strict=True)):
            prediction = predicted[i]
            if prediction is not None:
                _write_prediction(log, replay, window.log, prediction)
            stamp = window.log.start_ns + round(window.stop * window.log.dt * 1e9)
            messages.write_params(log, stamp, estimate)
            messages.write_estimate(log, stamp, estimate)
            truth = {name: float(v[i]) for name, v in replay.truth.items() if np.isfinite(v[i])}
            if truth:
                log.joint_state("/amhe/truth", stamp, truth, list(truth.values()))
            write_mark(log, stamp, estimate)


def write_mark(log: LogWriter, stamp_ns: int, estimate: Estimate) -> None:
    """Write on /diagnostics what became of a window."""
    values = {"misfit": f"{estimate.misfit:.3g}", "update ms": f"{estimate.update_ms:.1f}"}
    level, text = _LEVELS[estimate.mark], f"{estimate.mark}: {MARKS[estimate.mark]}"
    log.diagnostics(stamp_ns, level, text, values, of="estimator")


def _write_prediction(file: LogWriter, replay: Replay, log: Log, prediction: Prediction) -> None:
    """Write the predictions of the measured topics, at the times of the measurements."""
    mirrored: list[Signal] = []
    samples: dict[str, tuple[FloatArray, FloatArray]] = {}
    for signal in replay.system.signals:
        predicted = tuple(q for q in signal.quantities if signal.key(q) in prediction.values)
        if not predicted:
            continue
        mirrored.append(_mirror(signal, predicted, log[signal.key(predicted[0])].columns))
        keys = [signal.key(q) for q in predicted]
        measured = np.any([log[key].sampled[prediction.rows] for key in keys], axis=0)
        times = log.dt * prediction.rows[measured].astype(np.float64)
        samples |= {key: (times, prediction.values[key][measured]) for key in keys}
    write_samples(file, mirrored, samples, lambda time: log.start_ns + round(1e9 * time))


def _mirror(signal: Signal, predicted: tuple[str, ...], columns: tuple[str, ...]) -> Signal:
    """The signal of predictions: Odometry for a body, JointState for joints, else plain numbers."""
    if {"position", "orientation"} <= set(predicted):
        kind = "nav_msgs/msg/Odometry"
    elif set(predicted) <= {"position", "velocity", "effort"}:
        kind = "sensor_msgs/msg/JointState"
    else:
        kind = "std_msgs/msg/Float64MultiArray"
    return Signal(signal.name, f"{_PREDICTED}{signal.topic}", predicted, kind, columns)
