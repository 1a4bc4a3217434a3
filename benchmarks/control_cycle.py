"""Time of one control cycle, against the bare rollouts of the same steps, side by side in one run.

    python benchmarks/control_cycle.py            the table of docs/benchmarks.md
    python benchmarks/control_cycle.py --realtime --seconds 20    cycle times against the wall clock

Every row is an episode of T1, pushing; each cycle is timed, and right after it the bare rollouts of the same
simulations and steps by the same engine.
"""

from __future__ import annotations

import argparse
import os
import time
from itertools import islice

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.rollout import Engine, Rollouts
from amhe_cli.robots.go1.run import Run, RunOptions, open_run

DEFAULTS = {"samples": 8, "horizon": 16, "knots": 4, "loops": 3}
#: Each row changes one number.
ROWS = (
    {}, {"samples": 16}, {"samples": 32}, {"horizon": 10}, {"horizon": 24}, {"knots": 3}, {"knots": 8},
    {"loops": 1}, {"loops": 6},
)  # fmt: skip
#: Cycles before the robot pushes, and cycles that are measured.
SKIPPED, MEASURED = 100, 60


class Spy:
    """An engine that stores a cycle's calls (prediction and samples), to repeat them without the rest."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._calls: list[tuple[FloatArray, ...]] = []

    def rollout(self, *arguments: FloatArray) -> Rollouts:
        """See `Engine.rollout`."""
        self._calls.append(arguments)
        return self._engine.rollout(*arguments)  # type: ignore[arg-type]

    def bare(self) -> float:
        """Time of the rollouts alone [ms], of the cycle that has just ended."""
        batch = self._engine._batch  # type: ignore[attr-defined]
        begun = time.perf_counter()
        for _, qpos, qvel, inputs, _ in self._calls:
            ids = np.arange(len(inputs))
            batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
            batch.bind("qpos")[ids], batch.bind("qvel")[ids] = qpos, qvel
            batch.rollout(inputs.shape[1], control=inputs, record=["qpos", "qvel"], ids=ids)
        self._calls.clear()
        return 1e3 * (time.perf_counter() - begun)


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--realtime", action="store_true")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    given = parser.parse_args()
    table = _realtime(given) if given.realtime else _costs(given)
    Console(width=110).print(table)


def _costs(given: argparse.Namespace) -> Table:
    table = Table("N", "H", "K", "L", "threads", "cycle ms", "p99", "bare rollouts ms", "cycle / bare")
    for threads in given.threads:
        for row in ROWS:
            values = DEFAULTS | row
            table.add_row(*(str(v) for v in values.values()), str(threads), *_measured(values, threads))
    return table


def _measured(values: dict[str, int], threads: int) -> list[str]:
    run = _open(values, threads)
    controller = run.episode.controller
    spy = controller._engine = Spy(controller._engine)  # type: ignore[assignment]
    cycles, bare = [], []
    for cycle in islice(run.episode.cycles(), SKIPPED + MEASURED):
        cycles.append(cycle.plan_ms)
        bare.append(spy.bare())
    cycles, bare = np.array(cycles[SKIPPED:]), np.array(bare[SKIPPED:])
    return [
        f"{np.median(cycles):.1f}", f"{np.quantile(cycles, 0.99):.1f}", f"{np.median(bare):.1f}",
        f"{np.median(cycles / bare):.2f}",
    ]  # fmt: skip


def _realtime(given: argparse.Namespace) -> Table:
    table = Table("threads", "cycles", "p50 ms", "p99 ms", "misses")
    for threads in given.threads:
        run = _open({}, threads, realtime=True)
        times = [cycle.plan_ms for cycle in islice(run.episode.cycles(), int(given.seconds / 0.02))]
        p50, p99 = np.quantile(times, [0.5, 0.99])
        table.add_row(str(threads), str(len(times)), f"{p50:.1f}", f"{p99:.1f}", str(run.target.misses))
    return table


def _open(values: dict[str, int], threads: int, realtime: bool = False) -> Run:
    return open_run(
        RunOptions("t1", seed=0, threads=threads, settings={"control": {"realtime": realtime, **values}})
    )


if __name__ == "__main__":
    main()
