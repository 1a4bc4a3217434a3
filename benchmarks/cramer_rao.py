"""Error of the estimate over the Cramer-Rao bound: how much of the logs' information is used.

    python benchmarks/cramer_rao.py [--seeds 400] [--quick]

A pendulum with white noise of known sd, one clip from its exact first state. The bound comes from the
slopes of the noise-free trajectory at the truth, by central differences; the truth is the prior's mean,
so that the prior, whose information is included, adds no bias. At 1 the estimate is optimal.
"""

from __future__ import annotations

import argparse
import functools
import logging
from typing import Any

import numpy as np
from common import multisine, over_seeds, show, simulated

from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

GOAL = 1.2
SECONDS = 4.0
SETTINGS = {
    "clips": {"held_out": 0.0, "count": 1, "length": [SECONDS, SECONDS], "still": 0.0},
    "identify": {"first_state": "never", "samples": 16},
}
#: Off the prior mean by these many prior sd: a search that does nothing must not look perfect.
OFFSET = np.array([0.5, -0.5, 0.5, -0.5])


def problem(seed: int) -> tuple[System, FloatArray, MatchingCost, list]:
    """A system, the truth in z, the cost of one log, and the log."""
    system = System.load("pendulum", SETTINGS)
    truth = system.space.theta_of(OFFSET)
    # every seed moves alike, so that all share one bound, and draws noise of its own
    motion, noise = np.random.default_rng(0), np.random.default_rng([seed, 1])
    log = simulated(system, truth, multisine(motion), SECONDS, noise, noisy_start=False)
    windows = ClipPool(system, [whole(log)], system.settings.clips).cut(SECONDS)
    engine = open_engine(system, sensors=False)
    return system, OFFSET, MatchingCost(system, windows, engine, system.settings.cost), [log]


def bound() -> FloatArray:
    """Least sd of z that any unbiased estimate can have, the prior's share included, shape (d,)."""
    _, truth, cost, _ = problem(0)
    step = 1e-3 * np.eye(truth.size)
    flat = cost.residuals(np.concatenate((truth + step, truth - step))).flat[:, 0]
    slopes = (flat[: truth.size] - flat[truth.size :]) / 2e-3  # (d, R), in units of the noise
    return np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T + np.eye(truth.size))))


def trial(seed: int) -> dict[str, Any]:
    """Identify one log."""
    logging.disable(logging.WARNING)
    system, truth, _, logs = problem(seed)
    result = identify(system, logs, None, IdentifyOptions(seed=seed))
    estimate = system.space.z_of(result.belief.estimate)
    sd = np.sqrt(np.diag(result.belief.covariance)) / system.space.prior_sd
    return {"error": (estimate - truth).tolist(), "sd": sd.tolist(), "iterations": len(result.iterations)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--quick", action="store_true", help="10 seeds")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = 10 if arguments.quick else arguments.seeds
    results = over_seeds("cramer_rao", functools.partial(trial), range(seeds), arguments.processes)
    error = np.array([r["error"] for r in results])
    rms, least = np.sqrt((error**2).mean(axis=0)), bound()
    space = System.load("pendulum").space
    show(
        f"Error over the Cramer-Rao bound, {seeds} logs of {SECONDS:g} s (goal {GOAL:g})",
        ("parameter", "bound", "rms error", "ratio", "claimed sd / rms", "in goal"),
        [
            (
                p.name,
                f"{least[i] * p.prior_sd:.3%}",
                f"{rms[i] * p.prior_sd:.3%}",
                f"{rms[i] / least[i]:.2f} +- {rms[i] / least[i] / np.sqrt(2.0 * seeds):.2f}",
                f"{np.mean([r['sd'][i] for r in results]) / rms[i]:.2f}",
                "yes" if rms[i] <= GOAL * least[i] else "NO",
            )
            for i, p in enumerate(space.parameters)
        ],
    )


if __name__ == "__main__":
    main()
