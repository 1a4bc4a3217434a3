"""A log and options become an estimator and the windows that it is to see."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from amhe_cli.assembly import LogSource, open_system, told_truth, understood
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief_file import read_belief
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.estimation.online.prior import prior_of
from amhe_cli.estimation.online.replay import ReplayProblem, paced, windows
from amhe_cli.logs import read_truth
from amhe_cli.system import overrides
from amhe_cli.system.load import bundled_root
from amhe_cli.system.system import System


def bundled_log() -> Path:
    """The log that is replayed where none is given: a Go1 pushes a box onto another floor."""
    return bundled_root() / "examples" / "logs" / "t4.mcap"


def open_replay(
    source: LogSource,
    system: str | None,
    belief: Path | None,
    seed: int,
    threads: int,
    assignments: Sequence[str],
    config: Path | None,
) -> ReplayProblem:
    """Read everything that `amhe mhe-replay` needs.

    Raises:
        ConfigError: A setting, the system folder or the belief is wrong.
        LogError: The log cannot be read, or lacks what the system needs.
        EstimationError: It is too short for any window.
    """
    opened = open_system(system, source, assignments, config)
    chosen = overrides.gathered(config, os.environ, assignments).get("mhe") or {}
    follows = "window" in chosen and "update_period" not in chosen
    if follows and opened.folder is not None:
        opened = paced(opened, System.load(opened.folder, warn=False).settings.mhe)
    known = read_belief(belief, opened) if belief else None
    (log,) = understood(opened, source, system)
    steps = windows(opened, log)
    engine = open_engine(opened, threads=threads)
    return ReplayProblem(
        system=opened,
        engine=engine,
        estimator=MovingHorizon(opened, engine, np.random.default_rng(seed), known),
        start=prior_of(opened.space, known, opened.settings.mhe.start_sd),
        windows=steps,
        truth=_truth(source.paths[0], opened, log, steps),
        begun=np.ceil((source.start or 0.0) / log.dt - 1e-6) * log.dt,  # as the log is read
        paced=follows,
    )


def _truth(path: Path, system: System, log: Log, steps: Sequence[Window]) -> dict[str, FloatArray]:
    """What the log tells over time, or else once for all of it, of the system's parameters."""
    ends = np.array([step.stop for step in steps])
    stamps_ns = log.start_ns + np.round(ends * log.dt * 1e9).astype(np.int64)
    over_time = read_truth(path, stamps_ns, system.settings.logs)
    once = {name: np.full(ends.size, value) for name, value in told_truth([log]).items()}
    return {name: values for name, values in (once | over_time).items() if name in system.space.names}
