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
from amhe_cli.logs import LogWriter
from amhe_cli.logs.messages.signal_writer import write_samples
from amhe_cli.logs.messages.writer import ERROR, OK, WARN
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
    log.diagnostics(stamp_ns, level, text, values, of="estimator")


def _write_prediction(file: LogWriter, replay: Replay, log: Log, prediction: Prediction) -> None:
    """Mirror the measured topics, at the times that they were measured."""
    mirrored: list[Signal] = []
    samples: dict[str, tuple[FloatArray, FloatArray]] = {}
    for signal in replay.system.signals:
        predicted = tuple(q for q in signal.quantities if signal.key(q) in prediction.values)
        if not predicted:
            continue
        mirrored.append(_mirror(signal, predicted, log[signal.key(predicted[0])].columns))
        keys = [signal.key(q) for q in predicted]
        measured = np.any([log[key].sampled[prediction.rows] for key in keys], axis=0)
        times = log.dt * prediction.rows[measured]
        samples |= {key: (times, prediction.values[key][measured]) for key in keys}
    write_samples(file, mirrored, samples, lambda time: log.start_ns + round(1e9 * time))


def _mirror(signal: Signal, predicted: tuple[str, ...], columns: tuple[str, ...]) -> Signal:
    """The signal of predictions: Odometry of a body, JointState of joints, plain numbers of anything else."""
    if {"position", "orientation"} <= set(predicted):
        kind = "nav_msgs/msg/Odometry"
    elif set(predicted) <= {"position", "velocity", "effort"}:
        kind = "sensor_msgs/msg/JointState"
    else:
        kind = "std_msgs/msg/Float64MultiArray"
    return Signal(signal.name, f"{_PREDICTED}{signal.topic}", predicted, kind, columns)
