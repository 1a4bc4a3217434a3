"""Tasks on Go1s that the planner does not know, as they come and after `amhe identify --unknowns robot`.

    python benchmarks/transfer.py --workers 16 --tasks t1,t2,t4 --seeds 2 --out transfer/

For each plant free walking is recorded and the robot identified; then each task runs in modes true and
adaptive, without and with that robot. Results are kept in OUT, so that the script can be stopped and go on;
`--report` only prints the table.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from amhe_cli.api.identify import identify
from amhe_cli.core.belief import Belief, belief_text, held_by
from amhe_cli.core.errors import AmheError, Ending
from amhe_cli.core.statistics import Z90
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.estimation.design.probe import ProbeOptions
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.judge import History, run_record
from amhe_cli.robots.go1.plant import PLANTS
from amhe_cli.robots.go1.probing.motions import WALK
from amhe_cli.robots.go1.probing.probe import PushProbe
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.system.system import System

#: One run: plant, task, mode, whether the robot was identified first, seed.
Cell = tuple[str, str, str, bool, int]


def main() -> None:
    """Run what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--plants", default=",".join(PLANTS))
    parser.add_argument("--tasks", default="t1,t2,t4")
    parser.add_argument("--modes", default="true,adaptive")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    plants, tasks, modes = (getattr(arguments, name).split(",") for name in ("plants", "tasks", "modes"))
    if not arguments.report:
        _run(arguments.out, plants, tasks, modes, arguments.seeds, arguments.workers)
    _print(arguments.out, plants, modes)


def _run(out: Path, plants: list[str], tasks: list[str], modes: list[str], seeds: int, workers: int) -> None:
    with ProcessPoolExecutor(workers) as pool:
        waiting = {pool.submit(robot_of, out, plant): plant for plant in plants}
        for known in (False, True):
            if known:  # the robots are known by then
                for future in as_completed(waiting):
                    print(f"{waiting[future]}: {future.result()}", flush=True)
            cells = product(plants, tasks, modes, [known], range(seeds))
            running = [pool.submit(run_cell, out, cell) for cell in cells]
            if known:
                for number, future in enumerate(as_completed(running), start=1):
                    print(f"{number}/{len(running)} {future.result()}", flush=True)


def robot_of(out: Path, plant: str) -> str:
    """Let a plant walk for ten seconds, and identify it."""
    hush_mujoco()
    path, log = out / f"{plant}-robot.yaml", out / f"{plant}-walk.mcap"
    if path.exists():
        return "known"
    probe = PushProbe(ProbeOptions(task="walk", plant=plant))
    log.unlink(missing_ok=True)
    ending = probe.push(WALK.motion, 10.0, log)
    if ending.error is not None:
        return f"does not walk: {ending.error}"
    system = System.load("go1_push", {"unknowns": ["robot"]})
    try:
        result = identify(system, [read_log(log, system)], seed=0, threads=1)
    except AmheError as error:
        return f"cannot be identified: {error}"
    path.write_text(belief_text(result.belief), encoding="utf-8")
    return "identified: " + ", ".join(
        f"{p.name} {p.estimate:.3g} ± {p.sd:.2g}" for p in result.parameters.values()
    )


def run_cell(out: Path, cell: Cell) -> str:
    """Run a task once, and keep the outcome."""
    hush_mujoco()
    plant, task, mode, known, seed = cell
    path = out / f"{plant}-{task}-{mode}-{'known' if known else 'unknown'}-{seed}.json"
    robot = out / f"{plant}-robot.yaml"
    if path.exists() or (known and not robot.exists()):
        return f"{path.stem}: left out"
    settings: dict[str, Any] = {}
    if known:
        settings = {"parameters": held_by(Belief.load(robot))}
    run = open_run(RunOptions(task, mode, seed=seed, plant=plant, settings=settings))
    history, ending = History(run.task), Ending()
    try:
        for cycle in run.episode.cycles():
            history.add(cycle)
    except AmheError as error:
        ending = Ending(error=error)
    record = run_record(run.judge.measures(), history, ending) | {"cell": cell, "inside": _inside(history)}
    path.write_text(json.dumps(record), encoding="utf-8")
    return f"{path.stem}: {record['time_s']:.1f} s, {record['goal_error_m']:.3f} m"


def _inside(history: History) -> dict[str, bool]:
    """Whether the last 90 % interval of each parameter holds the truth; {} without an estimate."""
    if not history.estimates:
        return {}
    belief = history.estimates[-1].belief
    phi = np.where(belief.log, np.log(belief.estimate), belief.estimate)
    true = np.array([history.truth[name] for name in belief.names])
    far = np.abs(np.where(belief.log, np.log(true), true) - phi) <= Z90 * np.sqrt(np.diag(belief.covariance))
    return dict(zip(belief.names, map(bool, far), strict=True))


def _print(out: Path, plants: list[str], modes: list[str]) -> None:
    """One line for each plant, mode and state of knowledge, over tasks and seeds."""
    records = [json.loads(path.read_text()) for path in sorted(out.glob("*-[0-9]*.json"))]
    print("plant robot mode | runs goal on_time fell | rmse m/s, mu m error rms %, m and mu inside")
    for plant, known, mode in product(plants, (False, True), modes):
        some = [r for r in records if r["cell"][0] == plant and r["cell"][2:4] == [mode, known]]
        if some:
            print(plant, "known" if known else "unknown", mode, "|", *_line(some))


def _line(some: list[dict[str, Any]]) -> Iterator[str]:
    yield f"{len(some)} {sum(r['success'] for r in some)} {sum(r['on_time'] for r in some)}"
    yield f"{sum(r['fell'] for r in some)} |"
    speeds = [r["speed_rmse"] for r in some if r["speed_rmse"] is not None]
    yield f"{np.mean(speeds):.4f}"
    products = [
        r[of]["box_mass"] * r[of]["floor_friction"] for r in some if r["truth"] for of in ("belief", "truth")
    ]
    errors = np.array(products[::2]) / np.array(products[1::2]) - 1.0
    yield f"{100.0 * float(np.sqrt((errors**2).mean())):.1f} (mean {100.0 * float(errors.mean()):+.1f})"
    inside = [r["inside"][name] for r in some if r["inside"] for name in ("box_mass", "floor_friction")]
    yield f"{sum(inside)} of {len(inside)}" if inside else "-"


if __name__ == "__main__":
    main()
