"""Tasks on Go1s that the planner does not know, as they come and after `amhe identify --unknowns robot`.

    python benchmarks/transfer.py --workers 16 --tasks t1,t2,t4 --seeds 2 > found.txt
    python benchmarks/transfer.py --done found.txt --tasks hw1,hw2 > more.txt

For each plant free walking is recorded and the robot identified; then each task runs, without and with that
robot. `--strangers N` adds robots that are drawn at random, with several differences at once, some of them
no unknowns (feet that sink, heavier legs, soles): `s0`, `s1`, ... `--try JSON` repeats all runs under other
settings, such as '{"control": {"samples": 5}}'.
Each result is a line of JSON on the standard output, so that a run that was cut can go on from what it
printed; a table follows them.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
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
from amhe_cli.core.statistics import Z90
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
    parser.add_argument("--plants", default=",".join(p for p in PLANTS if p[1:].isalpha()))
    parser.add_argument("--strangers", default="0", help="how many, or from A to below B: A:B")
    parser.add_argument("--tasks", default="t1,t2,t4", help="'' for none")
    parser.add_argument(
        "--modes", default="true-weighed,adaptive-weighed,adaptive-unknown", help="each with what is known"
    )
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--try", dest="tried", action="append", default=[], metavar="JSON")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--done", type=Path, nargs="*", default=[], help="what earlier runs printed")
    given = parser.parse_args()
    first, _, last = given.strangers.rpartition(":")
    strangers = [f"s{number}" for number in range(int(first or 0), int(last))]
    plants, tasks, modes = (
        [word for word in text.split(",") if word] for text in (given.plants, given.tasks, given.modes)
    )
    done = list(read(given.done))
    for record in done:
        print(json.dumps(record))
    cells: list[Cell] = [  # a run that is cut has a seed of everything first
        (plant, task, *mode.split("-"), seed, tried)
        for seed, tried, mode, task, plant in product(
            range(given.seeds), ["", *given.tried], modes, tasks, [*plants, *strangers]
        )
    ]
    for record in made(done, [*plants, *strangers], cells, given.workers):
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
    done: list[dict[str, Any]], plants: list[str], cells: list[Cell], workers: int
) -> Iterator[dict[str, Any]]:
    """What is missing of robots and runs; runs with a robot begin when it is known."""
    robots = {record["robot"]: record["held"] for record in done if "held" in record}
    cells = [cell for cell in cells if list(cell) not in [record.get("cell") for record in done]]
    with ProcessPoolExecutor(workers) as pool:
        running = {pool.submit(robot_of, plant) for plant in plants if plant not in robots}
        running |= {
            pool.submit(run_cell, c, robots.get(c[0])) for c in cells if c[3] == "unknown" or c[0] in robots
        }
        waiting = [cell for cell in cells if cell[3] != "unknown" and cell[0] not in robots]
        while running:
            ended = next(as_completed(running))
            running.remove(ended)
            record = ended.result()
            yield record
            if "held" in record:
                mine = [cell for cell in waiting if cell[0] == record["robot"]]
                running |= {pool.submit(run_cell, cell, record["held"]) for cell in mine}


def robot_of(plant: str) -> dict[str, Any]:
    """Let a plant walk for ten seconds, and identify it."""
    hush_mujoco()
    with TemporaryDirectory() as folder:
        log = Path(folder) / "walk.mcap"
        ending = PushProbe(ProbeOptions(task="walk", plant=plant)).push(WALK.motion, 10.0, log)
        if ending.error is not None:
            return {"robot": plant, "error": str(ending.error)}
        system = System.load("go1_push", {"unknowns": ["robot"]})
        try:
            result = identify(system, [read_log(log, system)], seed=0, threads=1)
        except AmheError as error:
            return {"robot": plant, "error": str(error)}
    truth, space = truth_of(PLANTS[plant]), system.space
    weight = float(
        truth["trunk_load"] + _SCALES * np.random.default_rng([40, sum(plant.encode())]).standard_normal()
    )
    away = space.z_of(np.array([truth.get(name, np.nan) for name in space.names]))
    found, sd = space.z_of(result.belief.estimate), np.sqrt(np.diag(result.belief.covariance))
    return {
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


def run_cell(cell: Cell, robot: dict[str, Any] | None) -> dict[str, Any]:
    """Run a task once, with what is known of the robot."""
    hush_mujoco()
    plant, task, mode, known, seed, tried = cell
    settings: dict[str, Any] = {"parameters": robot[known]} if robot and known != "unknown" else {}
    if PLANTS[plant].box != PLANTS["ours"].box:  # only there: two unknowns more are dearer
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
    kept = (
        "success",
        "on_time",
        "fell",
        "time_s",
        "goal_error_m",
        "speed_rmse",
        "cost",
        "belief",
        "truth",
        "error",
    )
    inside = _inside(history)
    return {
        "cell": cell,
        **{key: record[key] for key in kept},
        "miss": history.miss,
        "inside": inside,
        "push_error": _push_error(history),
    }


def _push_error(history: History) -> float:
    """Rms relative error of mu m from 3 s on, but in the 1.5 s after a change."""
    true, found = (
        history.column(f"{of}/box_mass") * history.column(f"{of}/floor_friction")
        for of in ("truth", "belief")
    )
    times = history.column("time")
    changed = [time for time, one, next in zip(times[1:], true, true[1:], strict=False) if one != next]
    counts = (times > 3.0) & ~np.any([(times >= t) & (times < t + 1.5) for t in (-9.0, *changed)], axis=0)
    return float(np.sqrt(np.mean((found[counts] / true[counts] - 1.0) ** 2)))


def _inside(history: History) -> dict[str, bool]:
    """Whether the last 90 % interval of each parameter holds the truth; {} without an estimate."""
    if not history.estimates:
        return {}
    belief = history.estimates[-1].belief
    sd = np.sqrt(np.diag(belief.covariance))
    rows = zip(belief.names, belief.log, belief.estimate, sd, strict=True)
    shown = ((name, (np.log if log else float), value, one) for name, log, value, one in rows)
    return {
        name: bool(abs(of(history.truth[name]) - of(value)) <= Z90 * one) for name, of, value, one in shown
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
    """One line for each plant, mode and state of knowledge, over tasks and seeds."""
    print(
        "plant robot mode | runs goal on_time fell | rmse m/s, J, error of mu m % (rms over time; at end, "
        "mean), m and mu inside, joints off by (sd)"
    )
    groups = {(r["cell"][0], *r["cell"][2:4], *r["cell"][5:]) for r in runs}
    for group in (*sorted(groups), *sorted({("all", *rest) for _, *rest in groups})):
        plant, *rest = group
        some = [
            r for r in runs if [*r["cell"][2:4], *r["cell"][5:]] == rest and plant in ("all", r["cell"][0])
        ]
        mode, known, *tried = rest
        print(plant, known, mode, *tried, "|", *_line(some))


def _line(some: list[dict[str, Any]]) -> Iterator[str]:
    yield f"{len(some)} {sum(r['success'] for r in some)} {sum(r['on_time'] for r in some)}"
    yield f"{sum(r['fell'] for r in some)} |"
    yield f"{np.mean([r['speed_rmse'] for r in some if r['speed_rmse'] is not None]):.4f}"
    yield f"{np.mean([r['cost'] for r in some]):.0f}"
    products = [
        r[of]["box_mass"] * r[of]["floor_friction"] for r in some if r["truth"] for of in ("belief", "truth")
    ]
    errors = np.array(products[::2]) / np.array(products[1::2]) - 1.0
    lasting = [r["push_error"] for r in some if np.isfinite(r.get("push_error", np.nan))]
    yield f"{100.0 * float(np.sqrt(np.square(lasting).mean())) if lasting else np.nan:.1f}"
    yield f"({100.0 * float(np.sqrt((errors**2).mean())):.1f}, {100.0 * float(errors.mean()):+.1f})"
    inside = [r["inside"][name] for r in some if r["inside"] for name in ("box_mass", "floor_friction")]
    yield f"{sum(inside)} of {len(inside)}" if inside else "-"
    yield f"{np.nanmean([r['miss'] for r in some]):.1f}"


if __name__ == "__main__":
    main()
