"""From a belief off by 2x: `amhe probe` against a straight push, and what is identified from each.

    python benchmarks/probing.py --seeds 15

Seeds that have a result are not run again: stop it, and go on later. `--report` only prints the table.
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
from amhe_cli.probing.plan import Plan, parts_of
from amhe_cli.probing.primitives import APPROACH, STEADY
from amhe_cli.probing.probe import ProbeOptions, achieved
from amhe_cli.probing.push import PushProbe
from amhe_cli.report.belief_file import belief_text
from amhe_cli.report.record import plain

PROJECT = Path(__file__).resolve().parent.parent
#: Half of what is true of T1's box, with the spread of the system's own prior.
BELIEVED = {"box_mass": 2.0, "box_inertia_scale": 1.0, "floor_friction": 0.3}
TRUTH = {"box_mass": 4.0, "box_inertia_scale": 1.0, "floor_friction": 0.6}


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
    for seed in range(0 if arguments.report else arguments.seeds):
        file = arguments.out / f"{seed}.json"
        if not file.exists():
            file.write_text(json.dumps(run(seed, arguments), indent=2))
            print(f"seed {seed}: done", flush=True)
    print(table([json.loads(path.read_text()) for path in sorted(arguments.out.glob("*.json"))]))


def run(seed: int, arguments: argparse.Namespace) -> dict[str, object]:
    """One seed: the probe and the straight push, each run and identified from."""
    belief = arguments.out / "belief.yaml"
    belief.write_text(belief_text(_belief()))
    options = ProbeOptions(
        seconds=arguments.seconds, belief=belief, seed=seed, threads=arguments.threads or 1
    )
    probe = PushProbe(options)
    plan = probe.design(lambda text: None)
    result: dict[str, object] = {"sequence": [part.name for part in plan.parts]}
    for name, own in (("probe", plan), ("straight", straight(plan))):
        log = arguments.out / f"{seed}-{name}.mcap"
        ending = probe.run(own, log, lambda: False, lambda text: None)
        known = achieved(probe.system, log, options)
        expected = plan.expected if name == "probe" else plan.plain
        result[name] = {
            "error": ending.error and str(ending.error),
            "expected_sd": plain(expected.sd),
            "achieved_sd": None if known is None else plain(known.sd),
            "identified": identified(log, belief, seed, options.threads),
        }
    return result


def straight(plan: Plan) -> Plan:
    """An equally long push at one speed."""
    count = round((plan.seconds - APPROACH.seconds) / STEADY.seconds)
    parts = [(part.name, part.title, part.seconds) for part in (APPROACH, *[STEADY] * count)]
    return replace(plan, parts=parts_of(parts))


def identified(log: Path, belief: Path, seed: int, threads: int) -> dict[str, dict[str, float]]:
    """Estimate, sd and 90 % interval of each parameter."""
    problem = identify_problem(LogSource((log,), {}, None, None, None), [], None, [], None, belief)
    options = IdentifyOptions(seed=seed, threads=threads, prior=problem.prior)
    result = identify(problem.system, problem.training, None, options)
    return {
        p.name: plain({"estimate": p.estimate, "sd": p.sd, "lower": p.lower, "upper": p.upper})
        for p in result.parameters
    }


def _belief() -> Belief:
    names = tuple(BELIEVED)
    sd = np.array([0.5, 0.2, 0.5])
    estimate = np.array(list(BELIEVED.values()))
    return Belief("go1_push", names, ("kg", "-", "-"), (True,) * 3, estimate, np.diag(sd**2))


def table(results: list[dict]) -> str:
    """Median errors, coverage and sd of both motions, in Markdown."""
    lines = [
        "| motion | parameter | expected sd | achieved sd | identify: sd | median error | 90 % holds |",
        "|---|---|---|---|---|---|---|",
    ]
    for motion in ("probe", "straight"):
        for i, (name, truth) in enumerate(TRUTH.items()):
            rows = [result[motion] for result in results]
            found = [row["identified"][name] for row in rows]
            errors = [abs(f["estimate"] / truth - 1.0) for f in found]
            held = sum(f["lower"] <= truth <= f["upper"] for f in found)
            expected = np.median([row["expected_sd"][i] for row in rows])
            reached = np.median([row["achieved_sd"][i] for row in rows if row["achieved_sd"]])
            own = np.median([f["sd"] / f["estimate"] for f in found])
            lines.append(
                f"| {motion} | {name} | {expected:.1%} | {reached:.1%} | {own:.1%} | {np.median(errors):.1%} "
                f"| {held} of {len(found)} |"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
