"""Real tosses of an acrylic cube: fit the first forty, roll out the last twenty from their first sample.

    python benchmarks/cube_tosses.py [--seeds 3] [--quick]

Published for this cube: friction 0.18. The logs are not part of the project; without them the script says so.
"""

from __future__ import annotations

import argparse
import functools
import logging
from typing import Any

from common import DATA, over_seeds, show

from amhe_cli.core.log import Log
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.logs import read_signals
from amhe_cli.system.system import System

FOLDER = DATA / "cube_tosses"
FITTED = 40
FRICTION_GOAL, ERROR_GOAL = (0.15, 0.23), 0.009


def tosses(system: System) -> list[Log]:
    """All logs, in order."""
    paths = sorted(FOLDER.glob("toss_*.mcap"))
    return [read_signals(p, system.signals, system.model.opt.timestep, system.settings.logs) for p in paths]


def trial(seed: int) -> dict[str, Any]:
    """Identify with the system's own settings."""
    logging.disable(logging.WARNING)
    system = System.load("cube_toss")
    logs = tosses(system)
    result = identify(system, logs[:FITTED], logs[FITTED:], IdentifyOptions(seed=seed))
    return {
        "parameters": {
            p.name: {"estimate": p.estimate, "lower": p.lower, "upper": p.upper, "verdict": p.verdict}
            for p in result.parameters
        },
        "error": result.held_out.position_error_m,
        "initial_error": result.held_out.initial_position_error_m,
        "clips": result.held_out.clips,
    }


def row(result: dict[str, Any]) -> tuple[str, ...]:
    """One line for each seed."""
    found = result["parameters"]
    friction, mass = found["friction"], found["mass"]
    met = (
        FRICTION_GOAL[0] <= friction["estimate"] <= FRICTION_GOAL[1]
        and result["error"] <= ERROR_GOAL
        and mass["verdict"] == "prior"
    )
    return (
        str(result["seed"]),
        f"{friction['estimate']:.3f} ({friction['lower']:.3f} to {friction['upper']:.3f})",
        f"{1e3 * result['initial_error']:.1f} mm",
        f"{1e3 * result['error']:.1f} mm",
        mass["verdict"],
        f"{found['inertia_scale']['estimate']:.2f}, {found['inertia_scale']['verdict']}",
        f"{result['seconds']:.0f} s",
        "yes" if met else "NO",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    if not FOLDER.is_dir():
        print("skipped: the cube tosses are not here")
        return
    results = over_seeds(
        "cube_tosses",
        functools.partial(trial),
        range(1 if arguments.quick else arguments.seeds),
        arguments.processes,
    )
    show(
        f"Cube tosses: {FITTED} fitted, {results[0]['clips']} held out "
        f"(goal: friction {FRICTION_GOAL[0]} to {FRICTION_GOAL[1]}, "
        f"at most {1e3 * ERROR_GOAL:.0f} mm, mass 'prior')",
        ("seed", "friction", "error before", "held-out error", "mass", "inertia scale", "took", "in goal"),
        map(row, results),
    )


if __name__ == "__main__":
    main()
