"""What separates mass from friction: ways to push a box, and the information of each log at the truth.

    python benchmarks/probing_motions.py --seeds 3

A controller that is `held` believes half of the true values; one that is `learning` has the online estimator
beside it. Finished runs are stored in files and not repeated.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from common import RESULTS
from probing import POWERS, along, at_the_truth, kept, off_by_two

from amhe_cli.core.belief import belief_text
from amhe_cli.estimation.design.probe import ProbeOptions
from amhe_cli.robots.go1.probing.motions import STEADY, Motion, Segment, named_motion
from amhe_cli.robots.go1.probing.probe import PushProbe

#: Parameters and products of the table.
KNOWN = ("box_mass", "m mu", "m / mu")
#: The run's mode for each kind of belief.
MODES = {"held": "baseline", "learning": "adaptive"}


def turns(*phases: tuple[float, float]) -> Motion:
    """Repeated (speed [m/s], seconds [s]) phases, steering along the line."""
    return Motion("turns", "speeds by turns", tuple(Segment(seconds, speed) for speed, seconds in phases))


MOTIONS = {
    "0.2 m/s, steady": STEADY,
    "0.4 m/s, steady": turns((0.4, 1.0)),
    "0.4 / 0.1 m/s, 0.25 s each": turns((0.4, 0.25), (0.1, 0.25)),
    "0.4 / 0.05, left and right (`sides`)": named_motion("sides"),
    "0.2 m/s, the trunk 4 cm up and down (`bob`)": named_motion("bob"),
    "`sides`, the trunk 2 cm up and down": replace(named_motion("sides"), bob=0.02),
    "0.5 / 0.1, 0.25 s each": turns((0.5, 0.25), (0.1, 0.25)),
    "0.5 / 0, 0.25 s each": turns((0.5, 0.25), (0.0, 0.25)),
    "0.4 / 0, 0.5 s each": turns((0.4, 0.5), (0.0, 0.5)),
    "0.4 for 1 s, 0 for 0.5 s": turns((0.4, 1.0), (0.0, 0.5)),
    "`bob`, 5 cm": replace(named_motion("bob"), bob=0.05),
    "`bob` at 0.3 m/s": replace(turns((0.3, 1.0)), bob=0.04),
    "`bob` at 0.4 m/s": replace(turns((0.4, 1.0)), bob=0.04),
    "`bob`, 0.3 / 0.1 m/s, 0.25 s each": replace(turns((0.3, 0.25), (0.1, 0.25)), bob=0.04),
}


def main() -> None:
    """Run the motions that are not stored yet, then print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=RESULTS / "probing-motions")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    belief = arguments.out / "belief.yaml"
    belief.write_text(belief_text(off_by_two()))
    print("Posterior sd of mass / mu m / m/mu, median over the seeds.\n")
    print("| motion | " + " | ".join(MODES) + " |\n|---|" + "---|" * len(MODES))
    for title in MOTIONS:
        cells = []
        for believes in MODES:
            options = [
                ProbeOptions(belief=belief, seed=seed, threads=arguments.threads)
                for seed in range(arguments.seeds)
            ]
            cells.append(cell([known_after(title, believes, one, arguments.out) for one in options]))
        print(f"| {title} | {' | '.join(cells)} |", flush=True)


def known_after(title: str, believes: str, options: ProbeOptions, out: Path) -> list:
    """Push once; the posterior covariance from the log."""
    name = f"{list(MOTIONS).index(title)}-{believes}-{options.seed}"

    def push() -> dict[str, object]:
        probe, log = PushProbe(options), out / f"{name}.mcap"
        probe.push(MOTIONS[title], options.seconds, log, mode=MODES[believes])
        return {"motion": title, "known": at_the_truth(probe.system, log, options)}

    return kept(out / f"{name}.json", push)["known"]


def cell(covariances: list[list]) -> str:
    """Median sd of the table's parameters and products, in percent."""
    sds = [np.median([100.0 * along(one, POWERS[name]) for one in covariances]) for name in KNOWN]
    return " / ".join(f"{sd:.2g}" for sd in sds)


if __name__ == "__main__":
    main()
