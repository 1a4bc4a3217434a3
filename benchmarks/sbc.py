"""Simulation-based calibration: are truths that are drawn from the prior spread as the posteriors say?

    python benchmarks/sbc.py [--case pendulum arm box] [--seeds 200] [--jobs 2] [--assumed] [--quick]

Each trial draws its truth from the prior, simulates a log with sensor noise, and identifies it. Where priors
and intervals are right, the rank of the truth in its posterior is uniform (Talts et al. 2018), whatever the
log was worth. The posterior is normal in z, so that the rank is PIT = Phi((z_true - z) / sd). Two views:

- coverage of the central 50, 80, 90 and 95 % intervals, with the band in which 95 % of all counts lie;
- the ECDF of the ranks with a band that 95 % of all ECDFs stay within as a whole (Saeilynoja, Buerkner and
  Vehtari 2022, section 2.2), simulated; p is the share of ECDFs that stray farther by chance.

What ranks of single parameters cannot show, a test quantity of all of them may: the log-likelihood of the
truth among draws of the posterior (Modrak et al. 2023). Of a linear model with little prior that is the rank
of its Mahalanobis distance among those of the draws, which is what is computed: no rollout is needed.

Models are exact, and say so: no assumed value is off. With `--assumed` each is off by a draw of what the
settings say that a data sheet is worth, but for the time step. Results are kept on disk: a run that was cut
short goes on where it was.
"""

from __future__ import annotations

import argparse
import functools
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any

import mujoco
import numpy as np
from common import (
    PROJECT,
    RESULTS,
    SYSTEMS,
    Command,
    drawn_from_prior,
    made_with,
    over_seeds,
    plant_of,
    seeds_of,
    show,
    simulated,
)
from coverage import STEP, log_of

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings

CASES = ("pendulum", "arm", "box")
LEVELS = (0.5, 0.8, 0.9, 0.95)
#: Share of calibrated results that a band holds.
BAND = 0.95
#: Simulated counts, ECDFs and distances that bands and ranks are made from.
DRAWS = 20_000
#: Name of the test quantity of all parameters.
LIKELIHOOD = "likelihood"

# -- the cases ---------------------------------------------------------------------------------------------

JOINTS = ("yaw", "shoulder", "elbow")
#: Pose about which the arm moves, and how far [rad].
CENTRE, SIZE = np.array([0.0, -0.4, 0.6]), np.array([0.4, 0.3, 0.3])


def settings_of(assumed: bool) -> dict[str, Any]:
    """Cheap settings: figures and validation change no interval."""
    exact = dict.fromkeys(AssumedSettings.model_fields, 0.0)
    return {
        "clips": {"held_out": 0.0, "count": 12},
        "identify": {"assumed": {"time_step": 0.0} if assumed else exact},
    }


def system_of(case: str, assumed: bool = False) -> amhe.System:
    """The system of a case."""
    given = settings_of(assumed)
    if case == "box":
        return amhe.System.load(SYSTEMS / "pushed_box", given)
    if case == "arm":
        return arm(given)
    given["clips"]["length"] = [0.4, 1.2]
    if assumed:  # the bundled system says that its servo is known exactly
        default = AssumedSettings()
        given["identify"]["assumed"] |= {
            name: getattr(default, name) for name in ("gain", "center_of_mass", "mass", "geometry", "gravity")
        }
    system = amhe.System.load("pendulum", given)
    system.model.opt.timestep = STEP
    return system


def arm(settings: dict[str, Any]) -> amhe.System:
    """The arm of `example:arm`: friction, armature and zero of each joint, and the delay of commands."""
    spec = mujoco.MjSpec.from_file(str(PROJECT / "examples" / "logs" / "arm.xml"))
    spec.option.timestep = 0.002
    parameters: dict[str, Any] = {
        "delay": {
            "nominal": 0.011, "bounds": [0.0, 0.03], "scale": "linear", "prior_sd": 0.003,
            "targets": [{"set": "command_delay"}],
        }
    }  # fmt: skip
    for joint in JOINTS:
        for word in ("damping", "friction_loss", "armature"):
            parameters[f"{joint}_{word}"] = {"targets": [{"joint": joint, "set": word}]}
        zero = {"signal": "joints", "set": "bias", "quantity": "position", "joint": joint}
        parameters[f"{joint}_offset"] = {
            "nominal": 0.0, "bounds": [-0.3, 0.3], "scale": "linear", "prior_sd": 0.05, "targets": [zero],
        }  # fmt: skip
    signals = {
        "joints": {"joints": list(JOINTS), "noise": {"position": 0.0006}},
        "command": {"actuators": list(JOINTS), "quantity": "position"},
    }
    return amhe.System.from_model(
        spec, parameters=parameters, signals=signals, settings=settings, name="arm", warn=False
    )


def sway(rng: np.random.Generator) -> Command:
    """Commands of the arm [rad]: each joint by a multisine of its own; at CENTRE at time 0."""
    hertz = np.geomspace(0.2, 3.0, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, (len(JOINTS), 6))
    size = SIZE[:, None] / np.sqrt(hertz / hertz[0]) / 2.0
    return lambda t: CENTRE + (size * (np.sin(2.0 * np.pi * hertz * t + phase) - np.sin(phase))).sum(axis=1)


def trial(case: str, assumed: bool, seed: int) -> dict[str, Any]:
    """Ranks of one truth in its posterior."""
    logging.disable(logging.WARNING)
    rng = np.random.default_rng([seed, CASES.index(case), assumed])
    system = system_of(case, assumed)
    truth = drawn_from_prior(system, rng)
    plant, off, _ = plant_of(system, rng) if assumed else (system, np.empty(0), 1)
    theta = np.concatenate((truth, off))
    if case == "arm":
        log = simulated(plant, theta, sway(rng), 10.0, rng, settle=1.0)
    else:
        log = log_of(case, plant, theta, rng)
    try:
        result = amhe.identify(system, log, seed=seed, threads=1)
    except amhe.AmheError as error:
        return {"failed": str(error)}
    space, belief = system.space, result.belief
    error = space.z_of(truth) - space.z_of(belief.estimate)
    covariance = np.array(belief.covariance) / np.outer(space.prior_sd, space.prior_sd)
    sd = np.sqrt(np.diag(covariance))
    distance = float(error @ np.linalg.solve(covariance, error))
    draws = np.random.default_rng(0).chisquare(len(error), DRAWS)
    parameters = result.parameters.values()
    return {
        "pit": [NormalDist().cdf(t) for t in error / sd],
        "likelihood": float(np.mean(draws < distance)),
        "error": error.tolist(),
        "sd": sd.tolist(),
        "held": [bool(p.lower <= t <= p.upper) for p, t in zip(parameters, truth, strict=True)],
        "verdicts": [p.verdict for p in parameters],
    }


# -- what calibrated ranks do ------------------------------------------------------------------------------


def counts_below(count: int, places: FloatArray) -> FloatArray:
    """Distribution of how many of n uniform ranks are at most each place, shape (k, n + 1): P(at most j)."""
    logs = np.concatenate(([0.0], np.cumsum(np.log(np.arange(1, count + 1)))))
    j = np.arange(count + 1)
    choose = logs[-1] - logs[j] - logs[count - j]
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = choose + j * np.log(places)[:, None] + (count - j) * np.log1p(-places)[:, None]
    return np.minimum(np.cumsum(np.exp(terms), axis=1), 1.0)


def places_of(count: int) -> FloatArray:
    """Where ECDFs of n ranks are compared, below 1; of a single one at its middle."""
    steps = min(max(count, 2), 100)
    return np.arange(1, steps) / steps


def tails(ranks: FloatArray, places: FloatArray, below: FloatArray) -> FloatArray:
    """Twice the smallest pointwise tail of ECDFs of ranks (m, n), shape (m,): small where one strays."""
    counts = (ranks[:, :, None] <= places).sum(axis=1)
    rows = np.arange(len(places))
    upper = 1.0 - np.where(counts > 0, below[rows, np.maximum(counts - 1, 0)], 0.0)
    return 2.0 * np.minimum(below[rows, counts], upper).min(axis=1)


@functools.cache
def chance(count: int) -> FloatArray:
    """Tails of ECDFs of n uniform ranks, sorted."""
    rng, places = np.random.default_rng(1), places_of(count)
    below = counts_below(count, places)
    return np.sort(
        np.concatenate([tails(rng.random((100, count)), places, below) for _ in range(DRAWS // 100)])
    )


def band_of(count: int, tail: float) -> tuple[FloatArray, FloatArray]:
    """Least and largest ECDF whose pointwise tails are at least `tail`, at `places_of`."""
    below = counts_below(count, places_of(count))
    low = (below < 0.5 * tail).sum(axis=1)
    high = (below < 1.0 - 0.5 * tail + 1e-12).sum(axis=1)  # one with just this tail stays within
    return low / count, high / count


def coverage_band(count: int, level: float) -> tuple[float, float]:
    """Shares of n intervals that hold their truth, between which calibrated ones lie."""
    (below,) = counts_below(count, np.array([level]))
    tail = 0.5 * (1.0 - BAND)
    return float((below < tail).sum() / count), float((below < 1.0 - tail).sum() / count)


# -- table and figure --------------------------------------------------------------------------------------


def ranks_of(case: str, results: Sequence[dict[str, Any]]) -> dict[str, FloatArray]:
    """Quantity -> its ranks."""
    pit = np.array([r["pit"] for r in results])
    named = dict(zip(system_of(case).space.names, pit.T, strict=True))
    return {**named, LIKELIHOOD: np.array([r["likelihood"] for r in results])}


def rows(case: str, results: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """One line for each parameter, one for all of them, and one for the likelihood."""
    ranks, count = ranks_of(case, results), len(results)
    bands, by_chance = {level: coverage_band(count, level) for level in LEVELS}, chance(count)
    places = places_of(count)
    below = counts_below(count, places)
    between = [f"{low:.0%} to {high:.0%}" for low, high in bands.values()]
    lines = [(f"calibrated, {BAND:.0%}", *between, "", f"over {1.0 - BAND:.2g}", "")]
    sds = np.median([r["sd"] for r in results], axis=0)
    reported = np.mean([r["held"] for r in results], axis=0)
    for i, (name, values) in enumerate(ranks.items()):
        # a parameter's central interval, and of all parameters the ellipsoid that holds as much
        depth = values if name == LIKELIHOOD else np.abs(2.0 * values - 1.0)
        shares = {level: float(np.mean(depth < level)) for level in LEVELS}
        p = float(np.mean(by_chance <= tails(values[None], places, below)[0]))
        lines.append(
            (
                name,
                *(marked(shares[level], bands[level]) for level in LEVELS),
                "" if name == LIKELIHOOD else f"{reported[i]:.0%}",
                f"{p:.3f}" + ("" if p > 1.0 - BAND else " !"),
                "" if name == LIKELIHOOD else f"{sds[i]:.2g}",
            )
        )
    pit = np.abs(2.0 * np.array([r["pit"] for r in results]) - 1.0)
    each = [np.mean(pit < level, axis=1) for level in LEVELS]  # of one log: its parameters are no trials
    spread = [f"{one.mean():.0%} +- {one.std() / math.sqrt(count):.0%}" for one in each]
    lines.append((f"all {pit.shape[1]}", *spread, f"{reported.mean():.0%}", "", ""))
    return lines


def marked(share: float, band: tuple[float, float]) -> str:
    """A share, marked where it is below or above its band."""
    return f"{share:.0%}" + (" low" if share < band[0] else " high" if share > band[1] else "")


def draw(results: dict[str, Sequence[dict[str, Any]]], path: Path) -> None:
    """ECDFs of all ranks less the uniform one, with the band of chance; one panel for each case."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, len(results), figsize=(4.0 * len(results), 3.2), sharey=True, squeeze=False
    )
    for axes, (case, done) in zip(panels[0], results.items(), strict=True):
        count = len(done)
        places = places_of(count)
        low, high = band_of(count, float(np.quantile(chance(count), 1.0 - BAND)))
        axes.fill_between(places, low - places, high - places, color="0.85", lw=0)
        for name, values in ranks_of(case, done).items():
            ecdf = (values[:, None] <= places).mean(axis=0) - places
            style = {"color": "black", "lw": 1.5} if name == LIKELIHOOD else {"color": "tab:blue", "lw": 0.7}
            axes.plot(places, ecdf, label=name if name == LIKELIHOOD else None, **style)
        axes.plot([], [], color="tab:blue", lw=0.7, label="parameters")
        axes.set(title=f"{case}, {count} truths", xlabel="rank of the truth", xlim=(0, 1))
    panels[0][0].set_ylabel("ECDF less uniform")
    panels[0][0].legend(loc="lower left", frameon=False)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None, "Description": made_with()})
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=seeds_of, default=range(200), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--assumed", action="store_true", help="assumed values are off, and identify says so")
    parser.add_argument("--figure", type=Path, default=RESULTS / "sbc.svg", help="where the figure goes")
    parser.add_argument("--quick", action="store_true", help="5 seeds")
    given = parser.parse_args()
    seeds, drawn = range(5) if given.quick else given.seeds, {}
    for case in given.case:
        name = f"sbc-{case}" + ("-assumed" if given.assumed else "")
        one = functools.partial(trial, case, given.assumed)
        done = over_seeds(name, one, seeds, given.jobs)
        drawn[case] = [r for r in done if "failed" not in r]
        for failed in (r for r in done if "failed" in r):
            print(f"{case}, seed {failed['seed']}: {failed['failed']}")
        seconds = np.median([r["seconds"] for r in done])
        show(
            f"{case}: {len(drawn[case])} truths in their posteriors, {seconds:.1f} s each",
            (
                "quantity",
                *(f"{level:.0%}" for level in LEVELS),
                "as reported, 90 %",
                "p of ECDF",
                "median sd",
            ),
            rows(case, drawn[case]),
        )
    draw(drawn, given.figure)
    print(f"figure: {given.figure}")


if __name__ == "__main__":
    main()
