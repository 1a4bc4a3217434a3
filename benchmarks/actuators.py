"""Every drive of a whole robot from one excitation: error, coverage and time, `mujoco.sysid` beside it.

    python benchmarks/actuators.py [--seeds 20] [--seconds 20] [--noise-free] [--sysid] [--jobs 2] [--quick]
    python benchmarks/actuators.py --seeds 50 --any-step   # as if the plant's time step were not known
    python benchmarks/actuators.py --quick --minutes 30    # of a long log: time, memory, and what was fitted

Results are kept on disk, those of the two searches apart: a run that was cut short goes on where it was, and
the same code shows the table of results that another machine has made (`--seeds 10:20` is the second half).

The problem of PACE (Bjelonic et al. 2025): a Go1 hangs by its trunk and every joint follows a chirp from 0.1
to 10 Hz. Armature, viscous and Coulomb friction and encoder offset of its 12 joints and the delay of all
commands are unknown, 49 numbers, and off their priors by factors up to 2. Encoders have 1 mrad of noise at
400 Hz. A second log, of another excitation, is held out.

The Cramer-Rao bound is that of the whole log from its known first state. `--sysid` runs Levenberg-Marquardt
on the same log, open loop, in the same coordinates and bounds, with its own defaults and with residuals in
units of the noise, for at most `--budget` CPU seconds each. Every estimate that a search visits is then
scored on the held-out log, also open loop.
"""

from __future__ import annotations

import argparse
import functools
import logging
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from against_sysid import ARRIVED, Path, arrival, levenberg_marquardt
from common import PROJECT, over_seeds, seeds_of, show

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.core.statistics import Z90
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.matching.cost import MatchingCost

LEGS, PARTS = ("FR", "FL", "RR", "RL"), ("hip", "thigh", "calf")
JOINTS = [f"{leg}_{part}_joint" for leg in LEGS for part in PARTS]
HOME = [0.0, 0.9, -1.8] * len(LEGS)
STEP, NOISE = 1.0 / 400.0, 1e-3
#: Amplitude of the chirp [rad], and its frequencies at first and last [Hz].
SIZE, BAND = 0.25, (0.1, 10.0)
#: Log of the largest factor by which drives differ from their priors; offsets [rad] and delays [s] likewise.
FACTOR, OFFSET, DELAY = float(np.log(2.0)), 0.05, (0.0025, 0.0175)
KINDS = ("armature", "viscous", "coulomb", "offset", "delay")
ERROR, MEDIAN, SECONDS, COVERAGE, RATIO = 1.2, 0.5, 60.0, (0.86, 0.94), 0.5
#: Peak memory of an identification from a long log [GB].
MEMORY = 2.0


# -- the problem -------------------------------------------------------------------------------------------


def system_of(settings: dict[str, Any] | None = None, step: float = 0.0) -> amhe.System:
    """The Go1 whose trunk is fixed to the world, with 4 n + 1 unknowns.

    The plant is this model, so that what it assumes is exact. Of a plant whose time step is not known to be
    the model's, `step` is 1, the default of `identify.assumed.time_step`.
    """
    spec = mujoco.MjSpec.from_file(str(PROJECT / "models" / "go1_push" / "go1.xml"))
    spec.delete(spec.joint("trunk"))
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.add_key(name="home", qpos=HOME, ctrl=HOME)
    parameters: dict[str, Any] = {
        "delay": {
            "nominal": 0.01125, "bounds": [0.0, 0.03], "scale": "linear", "prior_sd": 0.005,
            "targets": [{"set": "command_delay"}],
        }
    }  # fmt: skip
    for joint in JOINTS:
        for kind, word in zip(KINDS[:3], ("armature", "damping", "friction_loss"), strict=True):
            targets = [{"joint": joint, "set": word}]
            parameters[f"{joint[:-6]}_{kind}"] = {"scale": "log", "prior_sd": FACTOR, "targets": targets}
        target = {"signal": "joints", "set": "bias", "quantity": "position", "joint": joint}
        parameters[f"{joint[:-6]}_offset"] = {
            "nominal": 0.0, "bounds": [-0.3, 0.3], "scale": "linear", "prior_sd": OFFSET, "targets": [target],
        }  # fmt: skip
    signals = {
        "joints": {"topic": "/joint_states", "joints": JOINTS, "noise": {"position": NOISE}},
        "command": {
            "topic": "/joint_commands",
            "actuators": {joint[:-6]: joint for joint in JOINTS},
            "quantity": "position",
        },
    }
    exact = dict.fromkeys(AssumedSettings.model_fields, 0.0)
    given = {"identify": {"assumed": exact | {"time_step": step}}}
    return amhe.System.from_model(
        spec, parameters=parameters, signals=signals, settings=given | (settings or {}), keyframe="home",
        name="go1_in_the_air", warn=False,
    )  # fmt: skip


def truth_of(system: amhe.System, rng: np.random.Generator) -> FloatArray:
    """True parameters, shape (d,): off their priors by factors up to 2, offsets and delay likewise."""
    theta = np.array(system.space.nominal)
    for i, name in enumerate(system.space.names):
        if name == "delay":
            theta[i] = rng.uniform(*DELAY)
        elif name.endswith("offset"):
            theta[i] = rng.uniform(-OFFSET, OFFSET)
        else:
            theta[i] *= np.exp(rng.uniform(-FACTOR, FACTOR))
    return theta


def chirp(time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Commands of all joints (t, 12): each a chirp of its own phase and sweep, softly begun."""
    low, high = BAND
    sweep = rng.uniform(0.9, 1.1, len(JOINTS)) * np.log(high / low)
    share = (time / time[-1])[:, None]
    turns = time[-1] * low * np.expm1(sweep * share) / sweep
    phase = rng.uniform(0.0, 2.0 * np.pi, len(JOINTS))
    soft = np.minimum(1.0, time / 0.5)[:, None]
    return np.array(HOME) + SIZE * soft * np.sin(2.0 * np.pi * turns + phase)


def log_of(
    system: amhe.System, theta: FloatArray, seconds: float, rng: np.random.Generator, noise: float
) -> amhe.Log:
    """The log of one chirp, from rest at home; a delay interpolates commands as the engine's does."""
    model = system.edits.apply(system.model, theta)
    data = mujoco.MjData(model)
    clock = STEP * np.arange(round(seconds / STEP) + 1, dtype=np.float64)
    command = chirp(clock, rng)
    steps = theta[system.space.names.index("delay")] / STEP
    late = np.arange(len(clock)) - steps
    acting = np.stack([np.interp(late, np.arange(len(clock)), column) for column in command.T], axis=1)
    data.qpos[:] = HOME
    position = np.empty_like(command)
    for k, control in enumerate(acting):
        position[k] = data.qpos
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    measured = position + noise * rng.standard_normal(position.shape)
    return amhe.Log.from_arrays(
        {"joints": {"time": clock, "position": measured}, "command": {"time": clock, "position": command}},
        system,
    )


@dataclass(frozen=True)
class Case:
    """A log to fit, one to judge by, and the truth."""

    system: amhe.System
    theta: FloatArray
    fitted: amhe.Log
    held_out: amhe.Log


def case_of(seed: int, seconds: float, noise: float, step: float = 0.0) -> Case:
    """The problem of one seed."""
    rng = np.random.default_rng([seed, 19])
    system = system_of(step=step)
    theta = truth_of(system, rng)
    fitted, held_out = (log_of(system, theta, s, rng, noise) for s in (seconds, 0.25 * seconds))
    return Case(system, theta, fitted, held_out)


def open_loop(system: amhe.System, log: amhe.Log) -> MatchingCost:
    """The cost of a whole log as one clip."""
    return MatchingCost(system, [whole(log)], open_engine(system), system.settings.cost)


def bound_of(case: Case) -> FloatArray:
    """Least sd of z that an unbiased estimate can have, the prior's share included, shape (d,)."""
    z, d = case.system.space.z_of(case.theta), len(case.system.space)
    step = 1e-3 * np.eye(d)
    flat = open_loop(case.system, case.fitted).residuals(np.concatenate((z + step, z - step))).flat[:, 0]
    slopes = (flat[:d] - flat[d:]) / 2e-3
    return np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T + np.eye(d))))


# -- the two searches --------------------------------------------------------------------------------------


def with_amhe(case: Case, seed: int) -> tuple[Any, Path, list[str]]:
    """Identify; the result, the estimates on its way, and its warnings."""
    times, visited, warnings = [], [], []

    class Collect(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            warnings.append(record.getMessage())

    logger, handler = logging.getLogger("amhe_cli"), Collect(logging.WARNING)
    logger.addHandler(handler)
    began = time.process_time()

    def note(iteration, _total) -> None:
        times.append(time.process_time() - began)
        visited.append(case.system.space.z_of(np.array(iteration.theta)))

    try:
        options = IdentifyOptions(seed=seed)
        found = identify(case.system, [case.fitted], [case.held_out], options, note)
    finally:
        logger.removeHandler(handler)
    return found, Path(times, visited, time.process_time() - began), warnings


def with_sysid(case: Case, whitened: bool, budget: float) -> Path:
    """Levenberg-Marquardt with finite differences on the whole log, open loop, from the known first state."""
    from mujoco import sysid

    system, log, model = case.system, case.fitted, case.system.model
    clock = np.arange(log.steps) * STEP
    command, position = (log[key].values for key in ("command.position", "joints.position"))
    layout, *_ = sysid.TimeSeries.compute_all_state_mappings(model)
    sequences = sysid.ModelSequences(
        system.name, system.spec, ["chirp"],
        [sysid.create_initial_state(model, position[0], np.zeros(model.nv))],
        [sysid.TimeSeries.from_control_names(clock, command, model)],
        [sysid.TimeSeries.from_custom_map(clock, position, [(n, c.size, k) for n, (k, c) in layout.items()])],
        allow_missing_sensors=True,
    )  # fmt: skip

    def in_noise(parameters, predicted, measured, model, return_all, state):
        return (state[: log.steps - 1, 1 : 1 + model.nq] - position[1:]) / NOISE, measured, measured

    return levenberg_marquardt(
        system, sequences, in_noise if whitened else None, {}, clock=time.process_time, budget=budget
    )


# -- the comparison ----------------------------------------------------------------------------------------


def on_held_out(case: Case, path: Path) -> list[float]:
    """Cost of the held-out log under every estimate of a search, as one clip."""
    return [float(cost) for cost in open_loop(case.system, case.held_out).costs(np.stack(path.z))]


def trial(seconds: float, noise: float, step: float, seed: int) -> dict[str, Any]:
    """Our search on the log of one seed; errors in z."""
    case = case_of(seed, seconds, noise, step)
    space, truth = case.system.space, case.system.space.z_of(case.theta)
    found, path, warnings = with_amhe(case, seed)
    return {
        "error": (space.z_of(found.belief.estimate) - truth).tolist(),
        "bound": bound_of(case).tolist(),
        "share": (
            np.array(found.belief.estimate) / np.where(case.theta == 0.0, 1.0, case.theta) - 1
        ).tolist(),
        "held": [bool(p.lower <= t <= p.upper) for p, t in zip(found.parameters, case.theta, strict=True)],
        "verdicts": [p.verdict for p in found.parameters],
        "settled": not any("settled" in text for text in warnings),
        "warnings": warnings,
        "rollouts": found.rollouts,
        "cpu": path.total,
        "times": path.times,
        "costs": on_held_out(case, path),
    }


def sysid_trial(seconds: float, noise: float, whitened: bool, budget: float, seed: int) -> dict[str, Any]:
    """The search of `mujoco.sysid` on the same log; the error in z is that of its best point."""
    case = case_of(seed, seconds, noise)
    path = with_sysid(case, whitened, budget)
    costs = np.minimum.accumulate(on_held_out(case, path))
    best = path.z[int(costs.argmin())]
    return {
        "error": (best - case.system.space.z_of(case.theta)).tolist(),
        "cpu": path.total,
        "times": path.times,
        "costs": costs.tolist(),
    }


def long_trial(minutes: float, seed: int) -> dict[str, Any]:
    """Our search on a long log: what it takes, what it fits, and how far it is off."""
    case = case_of(seed, 60.0 * minutes, NOISE)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found, path, warnings = with_amhe(case, seed)
    theta = np.array(found.belief.estimate)
    truth, scale = case.theta, case.system.space.log
    return {
        "cpu": path.total,
        "gigabytes": [
            1024.0 * kib / 1e9 for kib in (before, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        ],
        "fitted": found.clips.fitted_of,
        "share": np.abs(theta / truth - 1.0)[scale].tolist(),
        "held": [bool(p.lower <= t <= p.upper) for p, t in zip(found.parameters, truth, strict=True)],
        "verdicts": [p.verdict for p in found.parameters],
        "warnings": warnings,
    }


def arrivals(ours: dict[str, Any], theirs: dict[str, Any]) -> tuple[float, float]:
    """CPU seconds until each of two searches was within ARRIVED of the better one's last held-out cost."""
    target = ARRIVED * min(ours["costs"][-1], theirs["costs"][-1])
    one, other = (arrival(r["times"], np.array(r["costs"]), target) for r in (ours, theirs))
    return one, other


def sysid_row(
    label: str, results: Sequence[dict[str, Any]], others: Sequence[dict[str, Any]]
) -> tuple[str, ...]:
    """One line of the comparison with `mujoco.sysid`, over seeds."""
    error = np.array([other["error"] for other in others])
    bound = np.array([one["bound"] for one in results])
    pairs = [arrivals(one, other) for one, other in zip(results, others, strict=True)]
    ours, theirs = np.array(pairs).T
    ratio = [np.inf if np.isinf(one) else one / other for one, other in pairs]  # 0: it never arrives
    return (
        label, f"{np.median([other['cpu'] for other in others]):.1f}",
        f"{np.sqrt(np.mean((error / bound) ** 2)):.2f}",
        f"{np.median([one['costs'][-1] for one in results]):.4g} / "
        f"{np.median([other['costs'][-1] for other in others]):.4g}",
        f"{np.median(ours):.1f} / {np.median(theirs):.1f}", f"{np.median(ratio):.2f}x",
    )  # fmt: skip


def kind_rows(results: Sequence[dict[str, Any]], names: Sequence[str]) -> list[tuple[str, ...]]:
    """One line for each kind of parameter, and one for all."""
    error, bound = (np.array([r[key] for r in results]) for key in ("error", "bound"))
    share, held = (np.array([r[key] for r in results]) for key in ("share", "held"))
    verdicts = np.array([r["verdicts"] for r in results])
    lines = []
    for kind in (*KINDS, "all"):
        of = np.array([kind == "all" or name.endswith(kind) for name in names])
        # an offset has no share of itself: of its prior's sd
        off = 100.0 * np.abs(np.where([n.endswith("offset") for n in names], error, share))[:, of]
        lines.append(
            (
                kind, f"{np.median(off):.3g} %", f"{off.max():.3g} %",
                f"{np.sqrt(np.mean((error[:, of] / bound[:, of]) ** 2)):.2f}",
                f"{np.mean(np.abs(error[:, of]) < Z90 * bound[:, of]):.1%}", f"{held[:, of].mean():.1%}",
                f"{np.mean(verdicts[:, of] == 'identified'):.0%}",
            )
        )  # fmt: skip
    return lines


def show_long(minutes: float, results: Sequence[dict[str, Any]]) -> None:
    """One line for each seed of long logs."""
    rows = [
        (
            str(r["seed"]), f"{r['cpu']:.0f}", "{1:.2f} ({0:.2f})".format(*r["gigabytes"]), r["fitted"],
            f"{np.median(r['share']):.3%}", f"{max(r['share']):.2%}", f"{np.mean(r['held']):.0%}",
            f"{np.mean([v == 'identified' for v in r['verdicts']]):.0%}",
        )
        for r in results
    ]  # fmt: skip
    show(
        f"{minutes:g} minutes of log (goal: {MEMORY:g} GB); errors of what has a log scale",
        ("seed", "CPU s", "peak GB (before)", "fitted", "median error", "largest", "held", "identified"),
        rows,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(20), metavar="N or A:B")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--minutes", type=float, help="of a long log instead: time and memory")
    parser.add_argument("--noise-free", action="store_true")
    parser.add_argument("--any-step", action="store_true", help="the plant's time step is not known")
    parser.add_argument("--sysid", action="store_true", help="mujoco.sysid on the same logs")
    parser.add_argument("--budget", type=float, default=600.0, help="CPU seconds of each search of sysid")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--quick", action="store_true", help="one seed")
    given = parser.parse_args()
    noise, seeds = (0.0 if given.noise_free else NOISE), (range(1) if given.quick else given.seeds)
    if given.minutes:
        one = functools.partial(long_trial, given.minutes)
        name = f"actuators-{given.minutes:g}min"
        return show_long(given.minutes, over_seeds(name, one, seeds, given.jobs))
    name = f"actuators-{given.seconds:g}s-{'exact' if given.noise_free else 'noisy'}"
    ours = f"{name}-any-step" if given.any_step else name
    one = functools.partial(trial, given.seconds, noise, float(given.any_step))
    began = time.perf_counter()
    results = over_seeds(ours, one, seeds, given.jobs)
    print(f"{len(seeds)} problems on {given.jobs} processes: {time.perf_counter() - began:.1f} s")
    names = system_of().space.names
    low, high = COVERAGE
    show(
        f"{len(names)} unknowns from {given.seconds:g} s, {len(seeds)} seeds (goal: median {MEDIAN:g} %, "
        f"error / bound {ERROR:g}, held {low:.0%} to {high:.0%}); errors of offsets in shares of their prior",
        ("parameters", "median error", "largest", "error / bound, rms", "in 90 % of the bound", "held",
         "identified"),
        kind_rows(results, names),
    )  # fmt: skip
    cpu, error, bound = (np.array([r[key] for r in results]) for key in ("cpu", "error", "bound"))
    rows: list[tuple[str, ...]] = []
    rows.append(("amhe", f"{np.median(cpu):.1f}", f"{np.sqrt(np.mean((error / bound) ** 2)):.2f}", *[""] * 3))
    for whitened, label in ((False, "sysid, its defaults"), (True, "sysid, noise units")):
        if given.sysid:
            one = functools.partial(sysid_trial, given.seconds, noise, whitened, given.budget)
            others = over_seeds(f"{name}-sysid-{whitened:d}-{given.budget:g}", one, seeds, given.jobs)
            rows.append(sysid_row(label, results, others))
    show(
        f"CPU seconds (goal {SECONDS:g}, and {RATIO:g}x to the same held-out error); "
        f"settled: {sum(r['settled'] for r in results)} of {len(seeds)}",
        ("search", "CPU s", "error / bound", "held-out: amhe / sysid", "s to it", "ratio"), rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
