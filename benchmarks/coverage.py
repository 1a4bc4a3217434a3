"""How often 90 % intervals hold the truth: they should in 86-94 % of 400 trials.

    python benchmarks/coverage.py [--case pendulum box] [--seeds 400] [--quick]
    python benchmarks/coverage.py --online ...

Each trial draws its truth from the prior and simulates a short log with sensor noise, first states included.
`amhe identify` has its default settings, but fewer and shorter clips. The pendulum's log shows that the
model's other numbers are right. That of a box behind contacts cannot, and its intervals hold what settings
say that they are worth: so each is off by a draw of it, and the plant's steps are an eighth as long.
Online, the log is the model's own, and is replayed from the prior with the system's own settings, but no
drift, because the truth is constant. Every estimate from 2 s on counts; the standard errors are over trials.
"""

from __future__ import annotations

import argparse
import functools
import logging
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
from common import (
    SYSTEMS,
    drawn_from_prior,
    multisine,
    over_seeds,
    plant_of,
    show,
    simulated,
    stop_and_go,
)

from amhe_cli.core.log import Log
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.online.horizon import MovingHorizon
from amhe_cli.estimation.online.replay import replay, windows
from amhe_cli.system.system import System

GOAL = (0.86, 0.94)
#: What a trial leaves out: validation costs time and changes no interval.
CHEAP = {"clips": {"held_out": 0.0, "count": 12}}
CASES = ("pendulum", "box")
#: The pendulum's step [s] here, in the simulated log and in the model that identifies it alike.
STEP = 0.005
#: Online, estimates count from here on [s].
SETTLED = 2.0


def system_of(case: str) -> System:
    """The system of a case, with cheap settings."""
    if case == "box":
        return System.load(SYSTEMS / "pushed_box", CHEAP)
    shorter = {"clips": {**CHEAP["clips"], "length": [0.4, 1.2]}}
    system = System.load("pendulum", shorter)
    system.model.opt.timestep = STEP
    return system


def constant(system: System) -> System:
    """The system with parameters that do not drift."""
    parameters = tuple(replace(p, drift=0.0) for p in system.space.parameters)
    return replace(system, space=replace(system.space, parameters=parameters))


def log_of(case: str, system: System, theta: np.ndarray, rng: np.random.Generator, finer: int = 1) -> Log:
    """One short log, each of whose steps is `finer` of the system's."""
    if case == "pendulum":
        return simulated(system, theta, multisine(rng), 10.0, rng, state_hz=50, finer=finer)
    motion = stop_and_go(rng, 6.0)
    return simulated(system, theta, motion, 6.0, rng, state_hz=50, settle=0.5, askew=True, finer=finer)


def trial(case: str, seed: int) -> dict[str, Any]:
    """Identify one log; everything in z, the search's coordinates."""
    logging.disable(logging.WARNING)
    rng = np.random.default_rng([seed, CASES.index(case)])
    system = system_of(case)
    truth = drawn_from_prior(system, rng)
    plant, off, finer = plant_of(system, rng) if case == "box" else (system, np.empty(0), 1)
    log = log_of(case, plant, np.concatenate((truth, off)), rng, finer)
    result = identify(system, [log], None, IdentifyOptions(seed=seed))
    space = system.space
    return {
        "truth": space.z_of(truth).tolist(),
        "estimate": space.z_of(result.belief.estimate).tolist(),
        "sd": (np.sqrt(np.diag(result.belief.covariance)) / space.prior_sd).tolist(),
        "lower": [p.lower for p in result.parameters],
        "upper": [p.upper for p in result.parameters],
        "held": [bool(p.lower <= t <= p.upper) for p, t in zip(result.parameters, truth, strict=True)],
        "verdicts": [p.verdict for p in result.parameters],
        "clips": result.clips.fitted,
        "noise_scale": dict(result.noise_scale),
        "iterations": len(result.iterations),
    }


def online_trial(case: str, seed: int) -> dict[str, Any]:
    """Replay one log; everything in z."""
    rng = np.random.default_rng([seed, CASES.index(case)])
    system = constant(system_of(case))
    truth = drawn_from_prior(system, rng)
    log = log_of(case, system, truth, rng)
    engine = open_engine(system)
    found = list(replay(MovingHorizon(system, engine, rng), windows(system, log)))
    late = [e for e in found if e.time > SETTLED]
    last, space = late[-1], system.space
    return {
        "truth": space.z_of(truth).tolist(),
        "estimate": space.z_of(last.theta).tolist(),
        "sd": (np.sqrt(np.diag(last.belief.covariance)) / space.prior_sd).tolist(),
        "held": np.mean([(e.lower <= truth) & (truth <= e.upper) for e in late], axis=0).tolist(),
        "marks": Counter(e.mark for e in found),
    }


def rows(case: str, results: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """One line for each parameter."""
    system = system_of(case)
    held = np.array([r["held"] for r in results])
    error = np.array([np.subtract(r["estimate"], r["truth"]) for r in results])
    sd = np.array([r["sd"] for r in results])
    lines = []
    for i, p in enumerate(system.space.parameters):
        share = held[:, i].mean()
        chance = held[:, i].std() / np.sqrt(len(held))
        t = error[:, i] / sd[:, i]
        lines.append(
            (
                f"{case}: {p.name}",
                f"{share:.1%} +- {chance:.1%}",
                f"{np.sqrt(np.median(t**2)) / 0.6745:.2f}",
                f"{np.sqrt((t**2).mean()):.2f}",
                f"{np.median(sd[:, i]) * p.prior_sd:.2%}"
                if p.log
                else f"{np.median(sd[:, i]) * p.prior_sd:.2g}",
                "yes" if GOAL[0] <= share <= GOAL[1] else "NO",
            )
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, default=400)
    parser.add_argument("--online", action="store_true", help="of the sampling MHE, not of amhe identify")
    parser.add_argument("--quick", action="store_true", help="10 seeds")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = 10 if arguments.quick else arguments.seeds
    one, name = (online_trial, "coverage-online") if arguments.online else (trial, "coverage")
    lines = []
    for case in arguments.case:
        results = over_seeds(
            f"{name}-{case}", functools.partial(one, case), range(seeds), arguments.processes
        )
        lines += rows(case, results)
    show(
        f"Coverage of 90 % intervals over {seeds} logs (goal {GOAL[0]:.0%} to {GOAL[1]:.0%})",
        ("parameter", "held the truth", "error / sd, median", "rms", "median sd", "in goal"),
        lines,
    )


if __name__ == "__main__":
    main()
