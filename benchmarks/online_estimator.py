"""Accuracy and time of the online estimator after a switch: the linearised update against the paper's.

    python benchmarks/online_estimator.py --seeds 2         the table of docs/benchmarks.md
    python benchmarks/online_estimator.py --logs FOLDER     for stored logs: FOLDER/t3-0.mcap, ...

Makes logs of t3 and t4 under the true belief first, where they are missing. Errors are rms over all logs,
from 1.5 s after the switch on. Times are of this process (CPU) per update, beside its bare rollouts.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.table import Table

from amhe_cli.cli.settings import parse_set
from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.rollout import Engine, Rollouts
from amhe_cli.estimation.online.replay import Replay, open_replay
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.run import RunOptions, open_run, recorder_of
from amhe_cli.system.system import System

PROJECT = Path(__file__).resolve().parent.parent
#: What is compared: name, settings.
ROWS = (
    ("linearised, 8 x 1 (default)", ()),
    ("linearised, 16 x 1", ("mhe.samples=16",)),
    ("logrank, 32 x 1", ("mhe.method=logrank", "mhe.iterations=1")),
    ("logrank, 32 x 4", ("mhe.method=logrank",)),
    ("logrank, 8 x 1", ("mhe.method=logrank", "mhe.samples=8", "mhe.iterations=1")),
)
#: Estimates count from this time after a switch on [s].
SETTLED = 1.5


class Stopwatch:
    """Measures the CPU time that an engine spends in its rollouts, predictions included."""

    def __init__(self, engine: Engine) -> None:
        self._rollout, self.spent = engine.rollout, 0.0
        engine.rollout = self._timed  # type: ignore[method-assign]

    def _timed(self, *arguments: FloatArray) -> Rollouts:
        begun = time.process_time()
        result = self._rollout(*arguments)  # type: ignore[arg-type]
        self.spent += time.process_time() - begun
        return result


def main() -> None:
    """Make the logs, replay them, print."""
    arguments = _arguments()
    logs = [_log(arguments.logs, task, seed) for task in ("t3", "t4") for seed in range(arguments.seeds)]
    table = Table(
        "update", "rollouts", "mass %", "friction %", "mass * friction %", "held by 90 %", "ms", "/ bare"
    )
    for name, settings in ROWS[: arguments.rows]:
        found = [_replayed(log, settings) for log in logs]
        errors = np.concatenate([errors for errors, *_ in found])
        held = np.concatenate([held for _, held, *_ in found]).mean(axis=0)
        rms = 100.0 * np.sqrt((errors**2).mean(axis=0))
        rollouts, ms, ratio = np.mean([f[2:] for f in found], axis=0)
        table.add_row(
            name, f"{rollouts:.0f}", *(f"{e:.1f}" for e in rms),
            f"{100 * held[0]:.0f}, {100 * held[2]:.0f} %", f"{ms:.0f}", f"{ratio:.2f}x",
        )  # fmt: skip
        print(name, flush=True)
    Console(width=110).print(table)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--rows", type=int, default=len(ROWS), help="only the first rows")
    parser.add_argument("--logs", type=Path, default=PROJECT / "amhe-out" / "benchmarks" / "online_logs")
    return parser.parse_args()


def _log(folder: Path, task: str, seed: int) -> Path:
    path = folder / f"{task}-{seed}.mcap"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        run = open_run(RunOptions(task, "true", seed=seed))
        with recorder_of(run, path) as recorder:
            for cycle in run.episode.cycles():
                recorder.write(cycle)
    return path


def _replayed(log: Path, settings: tuple[str, ...]) -> tuple[FloatArray, FloatArray, float, float, float]:
    """Relative errors (n, 3), whether intervals held (n, 3), rollouts, CPU time [ms], that over bare."""
    system = System.load("go1_push", parse_set(settings))
    done = open_replay(system, read_log(log, system))
    watch = Stopwatch(done.engine)
    begun = time.process_time()
    estimates = done.run().estimates
    spent = time.process_time() - begun
    truth = np.array([done.truth[name] for name in done.system.space.names]).T
    late = _settled(done, truth)
    theta = np.array([e.theta for e in estimates])
    inside = np.array([(e.lower < t) & (t < e.upper) for e, t in zip(estimates, truth, strict=True)])
    ratio = theta / truth
    product = ratio[:, 0] * ratio[:, 2]
    errors = np.stack((ratio[:, 0], ratio[:, 2], product), axis=1) - 1.0
    rollouts = float(np.mean([e.rollouts for e in estimates if e.rollouts]))
    return errors[late], inside[late], rollouts, 1e3 * spent / len(estimates), spent / watch.spent


def _settled(done: Replay, truth: FloatArray) -> np.ndarray:
    """Estimates that are late enough after the switch, shape (n,)."""
    times = done.times
    switch = int(np.flatnonzero(np.any(np.diff(truth, axis=0) != 0.0, axis=1))[0])
    return times > times[switch + 1] + SETTLED


if __name__ == "__main__":
    main()
