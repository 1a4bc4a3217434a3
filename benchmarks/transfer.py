"""Tasks on Go1s that the planner does not know, as they come and after `amhe identify --unknowns robot`.

    python benchmarks/transfer.py --workers 16 --seeds 5 > found.txt
    python benchmarks/transfer.py --done found.txt --workers 0    # the tables of what there is

For each plant free walking is recorded and the robot identified; then each task runs, without and with that
robot. `--strangers N` adds robots that are drawn at random, with several differences at once, some of them
no unknowns (feet that sink, heavier legs, soles): `s0`, `s1`, ... `--try JSON` makes all runs under other
settings (repeat it for more; '' for none), such as '{"control": {"samples": 5}}'.
Each result is a line of JSON on the standard output, so that a run that was cut can go on from what it
printed; seeds come one after the other, so that it has the first ones whole. Tables follow.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import suppress
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from amhe_cli.api.identify import identify
from amhe_cli.core.belief import held_by
from amhe_cli.core.errors import AmheError, Ending
from amhe_cli.core.yaml_file import merged
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.estimation.design.probe import ProbeOptions
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.judge import History, run_record
from amhe_cli.robots.go1.kinematics import KINDS
from amhe_cli.robots.go1.model import FOOT_FRICTION
from amhe_cli.robots.go1.plant import PLANTS, PlantShape
from amhe_cli.robots.go1.probing.motions import WALK
from amhe_cli.robots.go1.probing.probe import PushProbe
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.system.system import System

#: One run: plant, task, mode, what is known of the robot (one of `KNOWN`), seed, other settings as JSON.
Cell = tuple[str, str, str, str, int, str]
#: Nothing; what its walk tells; and what that tells of a robot that was weighed, to 0.1 kg.
KNOWN = ("unknown", "walk", "weighed")
_MOST_STRANGERS, _SCALES = 100, 0.1


def stranger(number: int) -> PlantShape:
    """A Go1 with many differences at once."""
    rng = np.random.default_rng([39, number])

    def about(middle: float, factor: float) -> float:
        return float(middle * np.exp(rng.uniform(-1.0, 1.0) * np.log(factor)))

    def kinds(middle: float, factor: float) -> tuple[float, float, float]:
        return about(middle, factor), about(middle, factor), about(middle, factor)

    x, y, z = rng.uniform(-0.02, 0.02, 3).tolist()
    return PlantShape(
        f"stranger {number}", kinds(0.25, 3.0), kinds(1.0, 2.5), about(0.008, 1.6), gain=about(1.0, 1.12),
        load=float(rng.uniform(0.0, 1.5)), centre=(x, y, z), foot_friction=about(0.75, 1.4),
        soft_feet=bool(rng.random() < 0.5), sole=float(rng.uniform(-0.002, 0.002)),
        latency=float(rng.uniform(0.0, 0.03)), zeros=tuple(rng.normal(0.0, 0.012, 12).tolist()),
        legs=about(1.0, 1.06),
    )  # fmt: skip


PLANTS |= {f"s{number}": stranger(number) for number in range(_MOST_STRANGERS)}


def truth_of(shape: PlantShape) -> dict[str, float]:
    """The true values of the robot's unknowns, where the plant has such a number at all."""
    own = System.load("go1_push", {"unknowns": ["robot"]}).space
    truth = dict(zip(own.names, own.nominal.tolist(), strict=True))
    for name, values in (("friction", shape.friction), ("damping", shape.damping)):
        truth |= zip((f"joint_{name}_{kind}" for kind in KINDS), values, strict=True) if values else ()
    truth |= zip((name for name in own.names if name.startswith("zero_")), shape.zeros, strict=True)
    truth |= {f"trunk_centre_{axis}": at for axis, at in zip("xyz", shape.centre, strict=True)}
    truth |= {
        "joint_armature": shape.armature or truth["joint_armature"], "motor_gain": shape.gain,
        "command_latency": shape.latency, "foot_friction": shape.foot_friction or FOOT_FRICTION,
        "trunk_load": shape.load, "foot_overlap": -shape.sole,
    }  # fmt: skip
    lacks = [f"joint_friction_{kind}" for kind in KINDS] if shape.load_friction else []
    lacks += ["foot_overlap", "foot_softness"] if shape.soft_feet else []
    return {name: value for name, value in truth.items() if name not in lacks}


def main() -> None:
    """Run what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--plants", default=",".join(p for p in PLANTS if p[1:].isalpha() and p != "ours"))
    parser.add_argument("--strangers", default="0", help="how many, or from A to below B: A:B")
    parser.add_argument("--tasks", default="t1,t2,t3,t4,hw1,hw2", help="'' for none")
    parser.add_argument(
        "--modes", default="adaptive-weighed,true-weighed,adaptive-unknown,baseline-weighed",
        help="each with what is known of the robot: unknown, walk or weighed",
    )  # fmt: skip
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--try", dest="tried", action="append", default=[], metavar="JSON")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="0: print what there is")
    parser.add_argument(
        "--threads", type=int, default=1, help="of the workers, for each robot's identification"
    )
    parser.add_argument("--done", type=Path, nargs="*", default=[], help="what earlier runs printed")
    given = parser.parse_args()
    first, _, last = given.strangers.rpartition(":")
    plants, tasks, modes = (
        [word for word in text.split(",") if word] for text in (given.plants, given.tasks, given.modes)
    )
    plants += [f"s{number}" for number in range(int(first or 0), int(last))]
    done = list(read(given.done))
    cells: list[Cell] = [  # a run that is cut has a seed of everything first
        (plant, task, *mode.split("-"), seed, tried)
        for seed, tried, mode, task, plant in product(
            range(given.seeds), given.tried or [""], modes, tasks, plants
        )
    ]
    if given.workers:
        for record in done:
            print(json.dumps(record))
        for record in made(done, plants, cells, given.workers, min(given.threads, given.workers)):
            print(json.dumps(record), flush=True)
            done.append(record)
    show_robots([record for record in done if "robot" in record])
    show_runs([record for record in done if "cell" in record])


def read(files: list[Path]) -> Iterator[dict[str, Any]]:
    """Results among the lines of some files."""
    for line in (line for file in files for line in file.read_text(encoding="utf-8").splitlines()):
        if line.startswith("{"):
            with suppress(ValueError):  # the last line of a run that was cut
                yield json.loads(line)


def made(
    done: list[dict[str, Any]], plants: list[str], cells: list[Cell], workers: int, threads: int
) -> Iterator[dict[str, Any]]:
    """What is missing of robots and runs: always the first that is ready, a run once its robot is known.

    A robot's identification takes as many of the workers as it has threads.
    """
    robots = {record["robot"]: record.get("held") for record in done if "robot" in record}
    ran = [record.get("cell") for record in done]
    unknown = [plant for plant in plants if plant not in robots]
    waiting = [cell for cell in cells if list(cell) not in ran]
    running: dict[Future[dict[str, Any]], int] = {}
    with ProcessPoolExecutor(workers) as pool:
        while True:
            while unknown and sum(running.values()) + threads <= workers:
                running[pool.submit(robot_of, unknown.pop(0), threads)] = threads
            while sum(running.values()) < workers and (
                ready := next((c for c in waiting if c[3] == "unknown" or robots.get(c[0])), None)
            ):
                waiting.remove(ready)
                running[pool.submit(run_cell, ready, robots.get(ready[0]))] = 1
            if not running:
                return
            for one in wait(running, return_when=FIRST_COMPLETED).done:
                del running[one]
                record = one.result()
                if "robot" in record:
                    robots[record["robot"]] = record.get("held")
                yield record


def robot_of(plant: str, threads: int) -> dict[str, Any]:
    """Let a plant walk for ten seconds, and identify it."""
    hush_mujoco()
    with TemporaryDirectory() as folder:
        log = Path(folder) / "walk.mcap"
        ending = PushProbe(ProbeOptions(task="walk", plant=plant)).push(WALK.motion, 10.0, log)
        if ending.error is not None:
            return {"robot": plant, "error": str(ending.error)}
        system = System.load("go1_push", {"unknowns": ["robot"]})
        try:
            result = identify(system, [read_log(log, system)], seed=0, threads=threads)
        except AmheError as error:
            return {"robot": plant, "error": str(error)}
    truth, space = truth_of(PLANTS[plant]), system.space
    weight = float(
        truth["trunk_load"] + _SCALES * np.random.default_rng([40, sum(plant.encode())]).standard_normal()
    )
    away = space.z_of(np.array([truth.get(name, np.nan) for name in space.names]))
    found, sd = space.z_of(result.belief.estimate), np.sqrt(np.diag(result.belief.covariance))
    record = {
        "robot": plant,
        "held": {
            "walk": held_by(result.belief),
            "weighed": held_by(result.belief.given({"trunk_load": weight}))
            | {"trunk_load": {"held": weight, "held_sd": _SCALES}},
        },
        "truth": truth,
        "found": {p.name: [p.estimate, p.lower, p.upper] for p in result.parameters.values()},
        # errors and sds in units of the prior's sd
        "error": dict(zip(space.names, (found - away).tolist(), strict=True)),
        "sd": dict(zip(space.names, (sd / space.prior_sd).tolist(), strict=True)),
    }
    return _short(record)


def run_cell(cell: Cell, robot: dict[str, Any] | None) -> dict[str, Any]:
    """Run a task once, with what is known of the robot."""
    hush_mujoco()
    begun = time.process_time()
    plant, task, mode, known, seed, tried = cell
    settings: dict[str, Any] = {"parameters": robot[known]} if robot and known != "unknown" else {}
    if known != "unknown" and PLANTS[plant].box != PLANTS["ours"].box:  # only there: it is dearer
        settings["unknowns"] = ["box", "box_size"]
    settings = merged(settings, json.loads(tried or "{}"))
    run = open_run(RunOptions(task, mode, seed=seed, plant=plant, settings=settings))
    history, ending = History(run.task), Ending()
    try:
        for cycle in run.episode.cycles():
            history.add(cycle)
    except AmheError as error:
        ending = Ending(error=error)
    record = run_record(run.judge.measures(), history, ending)
    kept = ("success", "on_time", "fell", "time_s", "goal_error_m", "speed_rmse", "cost", "error")
    return {
        "cell": cell,
        **_short({key: record[key] for key in kept} | _learnt(history) | {"miss": history.miss}),
        "warned": any("docs/tasks.md" in trouble for trouble in history.troubles),
        "cpu_s": round(time.process_time() - begun, 1),
    }


def _short(value: Any) -> Any:
    """Plain values whose numbers have four digits."""
    if isinstance(value, dict):
        return {key: _short(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_short(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _learnt(history: History) -> dict[str, Any]:
    """Relative errors and sd of the belief at the end, errors of mu m over time; if intervals hold the truth.

    Over time: from 3 s on, but not in the 1.5 s after a change; rms, and shares of the time.
    """
    true, found = (
        {name: history.column(f"{of}/{name}") for name in ("box_mass", "floor_friction")}
        for of in ("truth", "belief")
    )
    for one in (true, found):
        one["push"] = one["box_mass"] * one["floor_friction"]
    times = history.column("time")
    changed = times[1:][np.diff(true["push"]) != 0.0]
    counts = (times > 3.0) & ~np.any([(times >= t) & (times < t + 1.5) for t in (-9.0, *changed)], axis=0)
    off = {name: found[name] / true[name] - 1.0 for name in true}
    inside = {
        name: (history.column(f"lower/{name}") <= true[name])
        & (true[name] <= history.column(f"upper/{name}"))
        for name in ("box_mass", "floor_friction")
    }
    return {
        "off": {name: float(error[-1]) for name, error in off.items()},
        "sd": {
            name: float(sd / at)
            for last in history.estimates[-1:]
            for name, sd, at in zip(last.belief.names, last.sd, last.theta, strict=True)
        },
        "push_rms": float(np.sqrt(np.mean(off["push"][counts] ** 2))) if counts.any() else None,
        "inside": {name: bool(held[-1]) for name, held in inside.items()} if history.estimates else {},
        "held": {name: float(held[counts].mean()) for name, held in inside.items()}
        if history.estimates and counts.any()
        else {},
    }


def show_robots(robots: list[dict[str, Any]]) -> None:
    """How well the robots' own numbers were found."""
    found = [record for record in robots if "held" in record]
    for record in robots:
        if record not in found:
            print(record["robot"], record["error"])
    print("number of the robot | robots, inside 90 %, rms error, rms sd (in prior sds), error / sd")
    names = found[0]["sd"] if found else ()
    for name in names:
        some = [record for record in found if name in record["truth"]]
        if some:
            error, sd = (np.array([record[key][name] for record in some]) for key in ("error", "sd"))
            held = sum(r["found"][name][1] <= r["truth"][name] <= r["found"][name][2] for r in some)
            sizes = " ".join(f"{np.sqrt((v**2).mean()):.2f}" for v in (error, sd, error / sd))
            print(f"{name} | {len(some)} {held} {sizes} (mean error {error.mean():+.2f})")


def show_runs(runs: list[dict[str, Any]]) -> None:
    """A line of Markdown for each plant, mode and state of knowledge, over tasks and seeds."""
    print(
        "| mode, robot | plant | runs | S_R | S_T | falls | J | RMSE m/s | mu m, rms % | at the end, mean % "
        "| inside at the end | over time % | warned | joints off by, sd |\n" + 14 * "|---" + "|"
    )
    groups = list(dict.fromkeys((*r["cell"][2:4], r["cell"][5]) for r in runs))
    for group in groups:
        mine = [r for r in runs if (*r["cell"][2:4], r["cell"][5]) == group]
        for plant in (*dict.fromkeys(r["cell"][0] for r in mine), "all"):
            some = [r for r in mine if plant in ("all", r["cell"][0])]
            print("| " + " | ".join([", ".join(filter(None, group)), plant, *_line(some)]) + " |")


def _line(some: list[dict[str, Any]]) -> Iterator[str]:
    def mean(values: list[Any], digits: int) -> str:
        numbers = [value for value in values if value is not None]
        return f"{np.mean(numbers):.{digits}f}" if numbers else "-"

    yield str(len(some))
    yield from (str(sum(r[key] for r in some)) for key in ("success", "on_time", "fell"))
    yield mean([r["cost"] for r in some], 0)
    yield mean([r["speed_rmse"] for r in some], 4)
    learnt = [r for r in some if r["held"]]
    if learnt:
        yield f"{100.0 * float(np.sqrt(np.mean([r['push_rms'] ** 2 for r in learnt]))):.1f}"
        yield f"{100.0 * float(np.mean([r['off']['push'] for r in learnt])):+.1f}"
        inside = [one for r in learnt for one in r["inside"].values()]
        yield f"{sum(inside)} of {len(inside)}"
        yield mean([100.0 * one for r in learnt for one in r["held"].values()], 0)
    else:
        yield from 4 * "-"
    yield str(sum(r["warned"] for r in some))
    yield mean([r["miss"] for r in some], 1)


if __name__ == "__main__":
    main()
