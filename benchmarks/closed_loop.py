"""Tasks by modes by seeds: one result file a cell, and the table of docs/results.md.

    python benchmarks/closed_loop.py --tasks t1,t2,t3,t4,t5,hw1,hw2 --modes true,baseline,stale --seeds 15

Cells that have a result are not run again: stop it, and go on later. `--report` only prints the table.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from amhe_cli.control.tasks import TASKS
from amhe_cli.report.record import plain
from amhe_cli.run_assembly import MODES, RunOptions, open_run

PROJECT = Path(__file__).resolve().parent.parent
MEASURES = ("success", "on_time", "fell", "goal_error_m", "speed_rmse", "cost", "time_s", "path_rmse_m")


def main() -> None:
    """Run what is missing, then print."""
    arguments = _arguments()
    cells = [
        (task, mode, seed, arguments.out, arguments.set)
        for mode in arguments.modes.split(",")
        for task in arguments.tasks.split(",")
        for seed in range(arguments.seeds)
        if mode != "stale" or TASKS[task].stale is not None
    ]
    arguments.out.mkdir(parents=True, exist_ok=True)
    missing = [cell for cell in cells if not _file(cell).exists()]
    if missing and not arguments.report:
        context = multiprocessing.get_context("spawn")
        with context.Pool(arguments.workers) as pool:
            for done, line in enumerate(pool.imap(_run, missing, chunksize=1), 1):
                print(f"{done}/{len(missing)} {line}", flush=True)
    print(table([json.loads(path.read_text()) for path in sorted(arguments.out.glob("*.json"))]))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--seeds", type=int, default=15)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--set", action="append", default=[], metavar="A.B=V")
    parser.add_argument("--out", type=Path, default=PROJECT / "amhe-out" / "benchmarks" / "closed_loop")
    parser.add_argument("--report", action="store_true")
    return parser.parse_args()


def _file(cell: tuple[str, str, int, Path, list[str]]) -> Path:
    task, mode, seed, out, _ = cell
    return out / f"{task}-{mode}-{seed:02d}.json"


def _run(cell: tuple[str, str, int, Path, list[str]]) -> str:
    task, mode, seed, _, assignments = cell
    run = open_run(RunOptions(task, mode, seed=seed, assignments=assignments))
    times = [cycle.plan_ms for cycle in run.episode.cycles()]
    measures = run.judge.measures()
    result = {"task": task, "mode": mode, "seed": seed, "belief": run.first_belief, "set": assignments}
    result |= {name: getattr(measures, name) for name in (*MEASURES, "terms")}
    result["cycle_ms"] = {"p50": float(np.median(times)), "p99": float(np.quantile(times, 0.99))}
    path = _file(cell)
    scratch = path.with_suffix(".partial")
    scratch.write_text(json.dumps(plain(result), indent=1))
    scratch.replace(path)
    return f"{path.stem}: " + ", ".join(f"{name} {result[name]}" for name in MEASURES[:7])


def table(results: list[dict]) -> str:
    """Markdown: one row for each task and mode; mean ± sd over the seeds."""
    lines = [
        "| task | mode | n | success % | on time % | falls | e_g m | RMSE m/s | J | t_exec s | path rms m |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for task in TASKS:
        for mode in MODES:
            rows = [r for r in results if (r["task"], r["mode"]) == (task, mode)]
            if rows:
                lines.append(_row(task, mode, rows))
    return "\n".join(lines)


def _row(task: str, mode: str, rows: list[dict]) -> str:
    def spread(name: str, digits: int) -> str:
        values = np.array([row[name] for row in rows if row[name] is not None], dtype=float)
        return f"{values.mean():.{digits}f} ± {values.std(ddof=1) if values.size > 1 else 0.0:.{digits}f}"

    def share(name: str) -> str:
        return f"{100.0 * np.mean([row[name] for row in rows]):.0f}"

    cells = (
        task, mode, str(len(rows)), share("success"), share("on_time"), str(sum(row["fell"] for row in rows)),
        spread("goal_error_m", 3), spread("speed_rmse", 3), spread("cost", 0), spread("time_s", 1),
        spread("path_rmse_m", 3),
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
