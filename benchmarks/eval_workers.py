"""Cells an hour of `amhe eval` with local workers, against as many bare processes of the same episodes.

    python benchmarks/eval_workers.py --workers 1 2 --cells 3 --duration 4 --repetitions 5

Both sides of a repetition run one after the other, so that what else the machine does meets both alike;
the ratio is the median over the repetitions. Both start their processes from nothing.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from common import PROJECT, paired, show

from amhe_cli.study.cells import Cell
from amhe_cli.study.executors import pool_of
from amhe_cli.study.plan import EvalOptions, planned, study_of
from amhe_cli.study.run import run_cell
from amhe_cli.study.store import conduct, start

#: Throughput of eval over that of bare processes.
GOAL = 0.95
#: A process that does nothing but run episodes.
BARE = """
import sys
from amhe_cli.robots.go1.run import RunOptions, open_run
for seed in sys.argv[2:]:
    run = open_run(RunOptions("t1", "true", seed=int(seed), duration=float(sys.argv[1])))
    for cycle in run.episode.cycles():
        pass
"""


def main() -> None:
    """Print one table."""
    given = _arguments()
    rows = []
    for workers in given.workers:
        count = workers * given.cells
        ours, bare, ratio = paired(
            lambda w=workers: _eval(w, given.cells, given.duration),
            lambda w=workers: _bare(w, given.cells, given.duration),
            given.repetitions,
        )
        # `ratio` is of times, bare over ours: of throughputs it is ours over bare
        hours = (f"{3600.0 * count / ours:.0f}", f"{3600.0 * count / bare:.0f}")
        rows.append((str(workers), str(count), *hours, f"{ratio:.2f}x", "yes" if ratio >= GOAL else "NO"))
    show(
        f"Cells of {given.duration:g} s (goal {GOAL:g}x the bare throughput)",
        ("workers", "cells", "eval, cells/h", "bare, cells/h", "eval / bare", "in goal"),
        rows,
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--cells", type=int, default=3, help="of each worker")
    parser.add_argument("--duration", type=float, default=4.0, help="of a cell, simulated seconds")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one repetition of two short cells")
    given = parser.parse_args()
    if given.quick:
        given.cells, given.duration, given.repetitions = 2, 2.0, 1
    return given


def _eval(workers: int, cells: int, duration: float) -> None:
    options = EvalOptions(["t1"], ["true"], workers * cells, duration=duration)
    study = study_of(options, "", "", {})
    planned_cells: list[Cell] = planned(options, study)
    with TemporaryDirectory() as folder:
        store = start(Path(folder), study, resume=False, force=False)
        conduct(store, planned_cells, run_cell, pool_of(workers, None), lambda: False, lambda result: None)


def _bare(workers: int, cells: int, duration: float) -> None:
    seeds = np.array_split(np.arange(workers * cells), workers)
    running = [
        subprocess.Popen([sys.executable, "-c", BARE, str(duration), *map(str, share)], cwd=PROJECT)
        for share in seeds
    ]
    for process in running:
        if process.wait():
            sys.exit("a bare process failed")


if __name__ == "__main__":
    main()
