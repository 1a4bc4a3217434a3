"""`amhe probe` against straight pushes, from a belief that is wrong by a factor of 2.

    python benchmarks/probing.py --seeds 15

A straight push has the online estimator beside the controller, as the probe has; one that is `held` keeps its
first belief. Finished parts are stored in files, so the script can be stopped and continued. `--report` only
prints the table.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from common import RESULTS

from amhe_cli.api.identify import identify
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, belief_text
from amhe_cli.core.files import plain
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.design.design import accuracy
from amhe_cli.estimation.design.information import clips_of, information_at, problem_of
from amhe_cli.estimation.design.probe import ProbeOptions, achieved
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.probing.motions import STEADY, Motion, named_motion
from amhe_cli.robots.go1.probing.probe import PushProbe
from amhe_cli.system.system import System

#: Half of the true values of T1's box, with the sd of the system's own prior.
BELIEVED = {"box_mass": 2.0, "box_inertia_scale": 1.0, "floor_friction": 0.3}
TRUTH = {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.6}
#: The products of the table: parameters to these powers.
POWERS = {name: row for name, row in zip(TRUTH, np.eye(3), strict=True)} | {
    "m mu": np.array([1.0, 0.0, 1.0]),
    "m / mu": np.array([1.0, 0.0, -1.0]),
}


#: Names of the table, and the plan's names for the same motions.
PUSHES = {"probe": "probe", "straight": "straight", "held": "straight"}


def main() -> None:
    """Run what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=15)
    parser.add_argument("--for", dest="seconds", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=RESULTS / "probing")
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    belief = arguments.out / "belief.yaml"
    belief.write_text(belief_text(off_by_two()))
    for which in () if arguments.report else PUSHES:
        for seed in range(arguments.seeds):
            run(which, seed, arguments, belief)
    print(table(arguments.out))


def run(which: str, seed: int, arguments: argparse.Namespace, belief: Path) -> None:
    """The probe or a straight push of one seed: plan, run, information, identification; a file for each."""
    threads = arguments.threads or 1
    options = ProbeOptions(seconds=arguments.seconds, belief=belief, seed=seed, threads=threads)
    probe, log = PushProbe(options), arguments.out / f"{seed}-{which}.mcap"
    motion, mode = STEADY, "baseline" if which == "held" else "adaptive"
    if which == "probe":
        motion = named_motion(kept(arguments.out / f"{seed}.plan.json", lambda: designed(probe))["motion"])
    kept(log.with_suffix(".pushed.json"), lambda: pushed(probe, motion, mode, log, options))
    kept(log.with_suffix(".truth.json"), lambda: {"known": at_the_truth(probe.system, log, options)})
    kept(log.with_suffix(".found.json"), lambda: identified(log, belief, seed, threads))


def kept(file: Path, make: Callable[[], dict]) -> dict:
    """The content of a file, which is made first if it is missing."""
    if not file.exists():
        text = json.dumps(plain(make()), indent=2)
        file.write_text(text)
        print(file.name, flush=True)
    return json.loads(file.read_text())


def designed(probe: PushProbe) -> dict[str, object]:
    """The chosen motion, and the expected covariances of it and of the straight push."""
    plan = probe.design(lambda text: None)
    assert plan.plain is not None
    return {
        "motion": plan.parts[-1].name,
        "probe": plan.expected.covariance,
        "straight": plan.plain.covariance,
    }


def pushed(
    probe: PushProbe, motion: Motion, mode: str, log: Path, options: ProbeOptions
) -> dict[str, object]:
    """Push; the posterior covariance from the log, at the parameters to which it leads."""
    ending = probe.push(motion, options.seconds, log, mode=mode)
    known = achieved(probe.system, log, options)
    return {
        "error": ending.error and str(ending.error),
        "achieved": None if known is None else known.covariance,
    }


def at_the_truth(system: System, log: Path, options: ProbeOptions) -> FloatArray:
    """The posterior covariance from a log at the true parameters, independent of its own estimate."""
    windows, truth = (
        clips_of(system, read_log(log, system)),
        system.space.z_of(np.array(list(TRUTH.values()))),
    )
    problem = problem_of(system, windows, open_engine(system, threads=options.threads))
    found = information_at(problem, truth, options.rng(9))
    return accuracy(system.space, found.matrix.sum(axis=0)[None]).covariance


def identified(log: Path, belief: Path, seed: int, threads: int) -> dict[str, object]:
    """Estimate, 90 % interval and covariance of log(parameters)."""
    system = System.load("go1_push")
    result = identify(system, read_log(log, system), prior=belief, seed=seed, threads=threads)
    rows = {
        p.name: {"estimate": p.estimate, "sd": p.sd, "lower": p.lower, "upper": p.upper}
        for p in result.parameters.values()
    }
    return {"parameters": rows, "covariance": result.belief.covariance}


def off_by_two() -> Belief:
    """A belief at half of the truth, with the sd of the system's own prior."""
    names = tuple(BELIEVED)
    sd = np.array([0.5, 0.2, 0.5])
    estimate = np.array(list(BELIEVED.values()))
    return Belief("go1_push", names, ("kg", "-", "-"), (True,) * 3, estimate, np.diag(sd**2))


def table(out: Path) -> str:
    """Medians over the stored seeds: sd, errors, how often 90 % intervals hold; in Markdown."""
    lines = [
        "| motion | seeds | known | expected | achieved | at the truth | identify | error | 90 % holds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    plans = _all(out, "*.plan.json")
    for which, planned in PUSHES.items():
        pushed, true, found = (_all(out, f"*-{which}.{end}.json") for end in ("pushed", "truth", "found"))
        for name, powers in POWERS.items():
            columns = (plans, planned), (pushed, "achieved"), (true, "known"), (found, "covariance")
            sds = [_sd([one[key] for one in many], powers) for many, key in columns]
            lines.append(f"| {which} | {len(found)} | {name} | {' | '.join(sds)} | {_errors(found, name)} |")
    motions = [plan["motion"] for plan in plans]
    lines += [
        "",
        "Sd of m / mu of a straight push over that of the probe of the same seed, median: "
        + "; ".join(f"{which} {_gains(out, which)}" for which in PUSHES if which != "probe")
        + ".",
        "Chosen: " + ", ".join(f"{name} {motions.count(name)}" for name in dict.fromkeys(motions)) + ".",
    ]
    return "\n".join(lines)


def _gains(out: Path, which: str) -> str:
    compared = {
        "achieved": ("pushed", "achieved"),
        "at the truth": ("truth", "known"),
        "identify": ("found", "covariance"),
    }
    return ", ".join(f"{what} {_gain(out, which, *where):.2f}" for what, where in compared.items())


def _gain(out: Path, which: str, end: str, key: str) -> float:
    """How much smaller the sd of m / mu is after the probe than after a straight push."""
    pairs = []
    for path in sorted(out.glob(f"*-probe.{end}.json")):
        both = [path, path.with_name(path.name.replace("probe", which))]
        known = [json.loads(file.read_text())[key] for file in both if file.exists()]
        if len(known) == 2 and None not in known:
            ours, other = (along(one, POWERS["m / mu"]) for one in known)
            pairs.append(other / ours)
    return float(np.median(pairs)) if pairs else float("nan")


def _all(out: Path, pattern: str) -> list[dict]:
    return [json.loads(path.read_text()) for path in sorted(out.glob(pattern))]


def _sd(covariances: list, powers: np.ndarray) -> str:
    """Median over the seeds of the sd of log of a product of parameters to these powers."""
    sds = [along(one, powers) for one in covariances if one is not None]
    return f"{np.median(sds):.1%}" if sds else "-"


def along(covariance: list, powers: np.ndarray) -> float:
    """Sd of the log of a product of parameters to these powers."""
    return float(np.sqrt(powers @ np.array(covariance) @ powers))


def _errors(found: list, name: str) -> str:
    if name not in TRUTH or not found:
        return "- | -"
    rows, truth = [one["parameters"][name] for one in found], TRUTH[name]
    error = np.median([abs(row["estimate"] / truth - 1.0) for row in rows])
    held = sum(row["lower"] <= truth <= row["upper"] for row in rows)
    return f"{error:.1%} | {held} of {len(rows)}"


if __name__ == "__main__":
    main()
