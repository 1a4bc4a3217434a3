"""From a belief off by 2x: `amhe probe` against a straight push, and what is identified from each.

    python benchmarks/probing.py --seeds 15

What has a file is not done again: stop it, and go on later. `--report` only prints the table.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from amhe_cli.assembly import LogSource, identify_problem
from amhe_cli.core.parameters import Belief
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.probing.motions import APPROACH, STEADY
from amhe_cli.probing.plan import Plan, parts_of
from amhe_cli.probing.probe import ProbeOptions, achieved
from amhe_cli.probing.push import PushProbe
from amhe_cli.report.belief_file import belief_text
from amhe_cli.report.record import plain

PROJECT = Path(__file__).resolve().parent.parent
#: Half of what is true of T1's box, with the spread of the system's own prior.
BELIEVED = {"box_mass": 2.0, "box_inertia_scale": 1.0, "floor_friction": 0.3}
TRUTH = {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.6}
#: What is looked at: products of parameters to these powers.
POWERS = {name: row for name, row in zip(TRUTH, np.eye(3), strict=True)} | {
    "m mu": np.array([1.0, 0.0, 1.0]),
    "m / mu": np.array([1.0, 0.0, -1.0]),
}


def main() -> None:
    """Run what is missing, then print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=15)
    parser.add_argument("--for", dest="seconds", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=PROJECT / "amhe-out" / "benchmarks" / "probing")
    parser.add_argument("--report", action="store_true")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    belief = arguments.out / "belief.yaml"
    belief.write_text(belief_text(_belief()))
    for seed in range(0 if arguments.report else arguments.seeds):
        run(seed, arguments, belief)
    print(table(arguments.out))


def run(seed: int, arguments: argparse.Namespace, belief: Path) -> None:
    """One seed: the probe and the straight push, each run, asked, and identified from."""
    threads = arguments.threads or 1
    options = ProbeOptions(seconds=arguments.seconds, belief=belief, seed=seed, threads=threads)
    probe = PushProbe(options)
    plan: Plan | None = None
    for motion in ("probe", "straight"):
        log, told, found = (
            arguments.out / f"{seed}-{motion}.{end}" for end in ("mcap", "json", "found.json")
        )
        if not told.exists():
            plan = plan or probe.design(lambda text: None)
            own = plan if motion == "probe" else straight(plan)
            ending = probe.run(own, log, lambda: False, lambda text: None)
            known = achieved(probe.system, log, options)
            expected = plan.expected if motion == "probe" else plan.plain
            record = {
                "motion": own.parts[-1].name,
                "error": ending.error and str(ending.error),
                "expected": expected.covariance,
                "achieved": None if known is None else known.covariance,
            }
            told.write_text(json.dumps(plain(record), indent=2))
            print(f"seed {seed}, {motion}: run", flush=True)
        if not found.exists():
            found.write_text(json.dumps(identified(log, belief, seed, threads), indent=2))
            print(f"seed {seed}, {motion}: identified", flush=True)


def straight(plan: Plan) -> Plan:
    """An equally long push at one speed."""
    room = plan.seconds - APPROACH.seconds
    return replace(
        plan,
        parts=parts_of([(m.name, m.title, s) for m, s in ((APPROACH, APPROACH.seconds), (STEADY, room))]),
    )


def identified(log: Path, belief: Path, seed: int, threads: int) -> dict[str, object]:
    """Estimate, 90 % interval and covariance of log(parameters)."""
    problem = identify_problem(LogSource((log,), {}, None, None, None), [], None, [], None, belief)
    options = IdentifyOptions(seed=seed, threads=threads, prior=problem.prior)
    result = identify(problem.system, problem.training, None, options)
    rows = {
        p.name: {"estimate": p.estimate, "sd": p.sd, "lower": p.lower, "upper": p.upper}
        for p in result.parameters
    }
    return plain({"parameters": rows, "covariance": result.belief.covariance})


def _belief() -> Belief:
    names = tuple(BELIEVED)
    sd = np.array([0.5, 0.2, 0.5])
    estimate = np.array(list(BELIEVED.values()))
    return Belief("go1_push", names, ("kg", "-", "-"), (True,) * 3, estimate, np.diag(sd**2))


def table(out: Path) -> str:
    """Median errors, coverage and sd of both motions over the seeds that have both files, in Markdown."""
    lines = [
        "| motion | known | expected sd | achieved sd | identify: sd | median error | 90 % holds |",
        "|---|---|---|---|---|---|---|",
    ]
    for motion in ("probe", "straight"):
        found = [json.loads(path.read_text()) for path in sorted(out.glob(f"*-{motion}.found.json"))]
        told = [json.loads(path.read_text()) for path in sorted(out.glob(f"*-{motion}.json"))]
        for name, powers in POWERS.items():
            expected, reached = (_sd([t[key] for t in told], powers) for key in ("expected", "achieved"))
            own = _sd([f["covariance"] for f in found], powers)
            lines.append(f"| {motion} | {name} | {expected} | {reached} | {own} | {_errors(found, name)} |")
        lines.append(f"| {motion} | runs | {len(told)} | {len(told)} | {len(found)} | | |")
    return "\n".join(lines)


def _sd(covariances: list, powers: np.ndarray) -> str:
    """Median over the seeds of the sd of log of a product of parameters to these powers."""
    sds = [np.sqrt(powers @ np.array(one) @ powers) for one in covariances if one is not None]
    return f"{np.median(sds):.1%}" if sds else "-"


def _errors(found: list, name: str) -> str:
    if name not in TRUTH or not found:
        return "|"
    rows, truth = [one["parameters"][name] for one in found], TRUTH[name]
    error = np.median([abs(row["estimate"] / truth - 1.0) for row in rows])
    held = sum(row["lower"] <= truth <= row["upper"] for row in rows)
    return f"{error:.1%} | {held} of {len(rows)}"


if __name__ == "__main__":
    main()
