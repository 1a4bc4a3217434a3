"""Every drive of a whole robot from one excitation: error, coverage and time, `mujoco.sysid` beside it.

    python benchmarks/actuators.py [--seeds 20] [--seconds 20] [--noise-free] [--sysid] [--quick]

The problem of PACE (Bjelonic et al. 2025): a Go1 hangs by its trunk and every joint follows a chirp from 0.1
to 10 Hz. Armature, viscous and Coulomb friction and encoder offset of its 12 joints and the delay of all
commands are unknown, 49 numbers, and off their priors by factors up to 2. Encoders have 1 mrad of noise at
400 Hz. A second log, of another excitation, is held out.

The Cramer-Rao bound is that of the whole log from its known first state. `--sysid` runs Levenberg-Marquardt
on the same log, open loop, in the same coordinates and bounds, with residuals in units of the noise. Every
estimate that either of the two visits is then scored on the held-out log, also open loop.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from common import PROJECT, over_seeds, show

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import whole
from amhe_cli.estimation.offline.identification import IdentifyOptions, identify
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
#: A search has arrived once its held-out error is within this factor of the better one's last error.
ARRIVED = 1.05


# -- the problem -------------------------------------------------------------------------------------------


def system_of(settings: dict[str, Any] | None = None) -> amhe.System:
    """The Go1 whose trunk is fixed to the world, with 4 n + 1 unknowns."""
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
    given = {"identify": {"rulers": {"gain": 0, "force_limit": 0, "ctrl_limit": 0, "joint_limit": 0}}}
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


def case_of(seed: int, seconds: float, noise: float) -> Case:
    """The problem of one seed."""
    rng = np.random.default_rng([seed, 19])
    system = system_of()
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


@dataclass(frozen=True)
class Path:
    """Where a search was, and after how many CPU seconds: times (n,), z (n, d); `total` includes the rest."""

    times: list[float]
    z: list[FloatArray]
    total: float


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
        found = identify(case.system, [case.fitted], [case.held_out], IdentifyOptions(seed=seed), note)
    finally:
        logger.removeHandler(handler)
    return found, Path(times, visited, time.process_time() - began), warnings


def with_sysid(case: Case) -> Path:
    """Levenberg-Marquardt with finite differences on the whole log, open loop, in units of the noise."""
    from mujoco import sysid
    from mujoco.sysid._src.trajectory import sysid_rollout

    system = case.system
    delay = system.space.names.index("delay")
    began = time.process_time()
    lower, upper = system.space.bounds
    unknowns = sysid.ParameterDict(
        {name: sysid.Parameter(name, 0.0, lower[i], upper[i]) for i, name in enumerate(system.space.names)}
    )
    log, model = case.fitted, system.model
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

    def rollout(*, control_signal, param_dicts, **rest):
        theta = [system.space.theta_of(one.as_vector()) for one in param_dicts]
        late = [np.arange(len(c.times)) - t[delay] / STEP for c, t in zip(control_signal, theta, strict=True)]
        shifted = [
            sysid.TimeSeries(
                c.times,
                np.stack([np.interp(rows, np.arange(len(rows)), u) for u in c.data.T], axis=1),
                c.signal_mapping,
            )
            for c, rows in zip(control_signal, late, strict=True)
        ]
        return sysid_rollout(control_signal=shifted, **rest)

    def whitened(parameters, predicted, measured, model, return_all, state):
        return (state[: log.steps - 1, 1 : 1 + model.nq] - position[1:]) / NOISE, measured, measured

    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda found, _spec: system.edits.apply(
            system.model, system.space.theta_of(found.as_vector())
        ),
        custom_rollout=rollout,
        modify_residual=whitened,
        n_threads=1,
    )
    times, visited = [], []

    def watched(x, parameters):
        result = residual(x, parameters)
        if np.ndim(x) == 1 or x.shape[1] == 1:
            times.append(time.process_time() - began)
            visited.append(np.array(x).reshape(-1))
        return result

    with contextlib.redirect_stdout(io.StringIO()):
        sysid.optimize(unknowns, watched, optimizer="mujoco", verbose=False)
    return Path(times, visited, time.process_time() - began)


def arrival(path: Path, errors: FloatArray, target: float) -> float:
    """CPU seconds until a search first was as good as the target; inf: never."""
    there = np.flatnonzero(errors <= target)
    return path.times[there[0]] if there.size else float("inf")


# -- the comparison ----------------------------------------------------------------------------------------


def trial(seconds: float, noise: float, sysid: bool, seed: int) -> dict[str, Any]:
    """Both searches on the log of one seed; errors in z."""
    case = case_of(seed, seconds, noise)
    space, truth = case.system.space, case.system.space.z_of(case.theta)
    found, path, warnings = with_amhe(case, seed)
    estimate = space.z_of(found.belief.estimate)
    result: dict[str, Any] = {
        "error": (estimate - truth).tolist(),
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
    }
    if sysid:
        other = with_sysid(case)
        judge = open_loop(case.system, case.held_out)
        ours, theirs = (judge.costs(np.stack(one.z)) for one in (path, other))
        theirs = np.minimum.accumulate(theirs)
        target = ARRIVED * min(ours[-1], theirs[-1])
        result |= {
            "sysid_error": (other.z[int(theirs.argmin())] - truth).tolist(),
            "sysid_cpu": other.total,
            "costs": [float(ours[-1]), float(theirs[-1])],
            "arrival": [arrival(path, ours, target), arrival(other, theirs, target)],
        }
    return result


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
                f"{np.sqrt(np.mean((error[:, of] / bound[:, of]) ** 2)):.2f}", f"{held[:, of].mean():.1%}",
                f"{np.mean(verdicts[:, of] == 'identified'):.0%}",
            )
        )  # fmt: skip
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--noise-free", action="store_true")
    parser.add_argument("--sysid", action="store_true", help="mujoco.sysid on the same logs")
    parser.add_argument("--quick", action="store_true", help="1 seed")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    noise, seeds = (0.0 if arguments.noise_free else NOISE), (1 if arguments.quick else arguments.seeds)
    one: Callable[[int], dict[str, Any]] = functools.partial(trial, arguments.seconds, noise, arguments.sysid)
    name = f"actuators-{arguments.seconds:g}s-{'exact' if not noise else 'noisy'}{'-sysid' * arguments.sysid}"
    results = over_seeds(name, one, range(seeds), arguments.processes)
    names = system_of().space.names
    columns = ("parameters", "median error", "largest", "error / bound, rms", "held", "identified")
    low, high = COVERAGE
    show(
        f"{len(names)} unknowns from {arguments.seconds:g} s, {seeds} seeds (goal: median {MEDIAN:g} %, "
        f"error / bound {ERROR:g}, held {low:.0%} to {high:.0%})",
        columns, kind_rows(results, names),
    )  # fmt: skip
    rows = [("amhe", f"{np.median([r['cpu'] for r in results]):.1f}", *[""] * 3)]
    if arguments.sysid:
        error, bound = (np.array([r[key] for r in results]) for key in ("sysid_error", "bound"))
        ours, theirs = np.array([r["arrival"] for r in results]).T
        rows.append(
            (
                "mujoco.sysid", f"{np.median([r['sysid_cpu'] for r in results]):.1f}",
                f"{np.sqrt(np.mean((error / bound) ** 2)):.2f}",
                f"{np.median(ours):.1f} / {np.median(theirs):.1f}", f"{np.median(ours / theirs):.2f}x",
            )
        )  # fmt: skip
    show(
        f"CPU seconds (goal {SECONDS:g}, and {RATIO:g}x to the same held-out error); "
        f"settled: {sum(r['settled'] for r in results)} of {seeds}",
        ("search", "CPU s", "error / bound", "to the same error: amhe / sysid", "ratio"), rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
