"""`estimates.mcap`: the estimates of a replay on the topics that a live run uses, for any viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Signal
from amhe_cli.estimation.online import messages
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.estimation.online.prediction import Prediction
from amhe_cli.estimation.online.replay import Replay
from amhe_cli.live.messages import ERROR, OK, WARN, write_diagnostics
from amhe_cli.logs import LogWriter
from amhe_cli.report.replay_words import MARKS
from amhe_cli.system.provenance import attachments

#: How much a mark matters to whoever watches /diagnostics.
_LEVELS = {"updated": OK, "jump": WARN, "still": OK, "gap": WARN, "diverged": ERROR}
_PREDICTED = "/amhe/pred"


def write_log(
    path: Path, replay: Replay, predicted: Sequence[Prediction | None], metadata: Mapping[str, str]
) -> None:
    """Write estimates, truth, marks, and what the estimates predict, on the clock of the replayed log.

    Args:
        path: The .mcap file.
        replay: What was found.
        predicted: One for each estimate.
        metadata: What the log says of itself.
    """
    with LogWriter(path, metadata) as log:
        messages.define(log)
        for name, text in attachments(replay.system).items():
            log.attach(name, "application/yaml", text.encode())
        for i, (window, estimate) in enumerate(zip(replay.windows, replay.estimates, strict=True)):
            prediction = predicted[i]
            if prediction is not None:
                _write_prediction(log, replay, window.log, prediction)
            stamp = _stamp_ns(window.log, window.stop)
            messages.write_params(log, stamp, estimate)
            messages.write_estimate(log, stamp, estimate)
            told = {name: float(v[i]) for name, v in replay.truth.items() if np.isfinite(v[i])}
            if told:
                log.joint_state("/amhe/truth", stamp, told, list(told.values()))
            _write_mark(log, stamp, estimate)


def _stamp_ns(recorded: Log, row: int) -> int:
    return recorded.start_ns + round(row * recorded.dt * 1e9)


def _write_mark(log: LogWriter, stamp_ns: int, estimate: Estimate) -> None:
    values = {"misfit": f"{estimate.misfit:.3g}", "update ms": f"{estimate.update_ms:.1f}"}
    level, text = _LEVELS[estimate.mark], f"{estimate.mark}: {MARKS[estimate.mark]}"
    write_diagnostics(log, stamp_ns, level, text, values, of="estimator")


def _write_prediction(log: LogWriter, replay: Replay, recorded: Log, prediction: Prediction) -> None:
    """Mirror the measured topics, at the times that they were measured."""
    mirrored = []
    for signal in replay.system.signals:
        keys = [signal.key(q) for q in signal.quantities if signal.key(q) in prediction.values]
        if keys:
            seen = np.any([recorded[key].sampled[prediction.rows] for key in keys], axis=0)
            mirrored += [(int(prediction.rows[k]), k, signal) for k in np.flatnonzero(seen)]
    for row, k, signal in sorted(mirrored, key=lambda entry: entry[0]):
        values = {
            q: prediction.values[signal.key(q)][k]
            for q in signal.quantities
            if signal.key(q) in prediction.values
        }
        _mirror(log, signal, _stamp_ns(recorded, row), recorded, values)


def _mirror(
    log: LogWriter, signal: Signal, stamp_ns: int, recorded: Log, values: Mapping[str, FloatArray]
) -> None:
    """One message: Odometry of a body, JointState of joints, plain numbers of anything else."""
    topic = f"{_PREDICTED}{signal.topic}"
    if "orientation" in values and "position" in values:
        still = np.zeros(3)
        log.odometry(
            topic, stamp_ns, values["position"], values["orientation"],
            values.get("linear_velocity", still), values.get("angular_velocity", still),
            child_frame=signal.name,
        )  # fmt: skip
    elif set(values) <= {"position", "velocity", "effort"}:
        names = recorded[signal.key(next(iter(values)))].columns
        log.joint_state(topic, stamp_ns, names, **values)
    else:
        log.numbers(topic, stamp_ns, np.concatenate(list(values.values())))
