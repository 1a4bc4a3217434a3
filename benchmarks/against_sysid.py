"""Time to the same held-out error, against Levenberg-Marquardt in `mujoco.sysid`.

    python benchmarks/against_sysid.py [--case pendulum double_pendulum cube_toss] [--repetitions 5] [--quick]

Both start at the prior mean, in the same coordinates z within the same bounds, on the same logs and
threads, with models made by the same code. `mujoco.sysid` gets the logs cut into clips side by side, as
amhe's own validation cuts them, and three variants: its defaults as its guide uses them; residuals in
units of the sensors' noise; and those with a finite-difference step of 0.05 prior sd instead of 1.5e-8,
which is lost in contacts. Every point that a search visits is evaluated afterwards, outside of the measured
time, on held-out clips.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from common import DATA, PROJECT, multisine, show, simulated

from amhe_cli.core import rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log, Window
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.identification import IdentifyOptions, identify
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.logs import read_signals
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

GOAL = 0.5
#: A search has arrived once its held-out error is within this factor of the better one's last error.
ARRIVED = 1.05
THREADS = 2
LARGER_STEP = 0.05


@dataclass(frozen=True)
class Case:
    """Logs to fit, and logs to judge by."""

    system: System
    fitted: Sequence[Log]
    held_out: Sequence[Log]


@dataclass(frozen=True)
class Path:
    """Where a search was, and when: times [s] (n,), z (n, d); `total` includes what came after."""

    times: list[float]
    z: list[FloatArray]
    total: float


def pendulum() -> Case:
    """A simulated servo that swings a load 40 % heavier than its prior mean, and one more log."""
    system = System.load("pendulum")
    truth = np.array([0.55, 0.03, 0.035, 0.006])
    rng = np.random.default_rng(0)
    logs = [simulated(system, truth, multisine(rng), seconds, rng) for seconds in (15.0, 8.0)]
    return Case(system, logs[:1], logs[1:])


def double_pendulum() -> Case | None:
    """A real double pendulum: two of its owners' runs to fit, and the one to judge of docs/real.md."""
    paths = [DATA / "double_pendulum" / f"trajectory_{run}.csv" for run in ("143339", "143601", "143524")]
    if not all(path.exists() for path in paths):
        return None
    system = System.load(PROJECT / "examples" / "systems" / "double_pendulum")
    logs = [read_signals(p, system.signals, system.model.opt.timestep, system.settings.logs) for p in paths]
    return Case(system, logs[:2], logs[2:])


def cube_toss() -> Case | None:
    """Real tosses: forty to fit, twenty to judge."""
    paths = sorted((DATA / "cube_tosses").glob("toss_*.mcap"))
    if not paths:
        return None
    system = System.load("cube_toss")
    logs = [read_signals(p, system.signals, system.model.opt.timestep, system.settings.logs) for p in paths]
    return Case(system, logs[:40], logs[40:])


CASES: dict[str, Callable[[], Case | None]] = {
    "pendulum": pendulum,
    "double_pendulum": double_pendulum,
    "cube_toss": cube_toss,
}


# -- amhe --------------------------------------------------------------------------------------------------


def with_amhe(case: Case, seed: int) -> Path:
    """Identify, noting each iteration's estimate."""
    times, visited = [], []
    began = time.perf_counter()

    def note(iteration, _total) -> None:
        times.append(time.perf_counter() - began)
        visited.append(case.system.space.z_of(np.array(iteration.theta)))

    identify(case.system, case.fitted, case.held_out, IdentifyOptions(seed=seed, threads=THREADS), note)
    return Path(times, visited, time.perf_counter() - began)


# -- mujoco.sysid ------------------------------------------------------------------------------------------


def with_sysid(case: Case, whitened: bool, step: float | None) -> Path:
    """Levenberg-Marquardt on clips side by side, noting every point whose residuals it requested."""
    from mujoco import sysid

    began = time.perf_counter()
    modify = _whitening(sysid, case.system) if whitened else None
    sequences = _sequences(sysid, case)
    took = time.perf_counter() - began
    options = {} if step is None else {"eps": step}
    return levenberg_marquardt(case.system, sequences, modify, options, threads=THREADS, took=took)


class BudgetSpentError(Exception):
    """The time of a search has run out."""


def levenberg_marquardt(
    system: System,
    sequences: Any,
    modify: Callable[..., Any] | None,
    options: Mapping[str, float],
    *,
    threads: int = 1,
    clock: Callable[[], float] = time.perf_counter,
    took: float = 0.0,
    budget: float = np.inf,
) -> Path:
    """`mujoco.sysid` from the prior's mean, in z, within the bounds.

    Args:
        system: Model and parameters; a command delay acts as in amhe's engine.
        sequences: What was commanded and measured.
        modify: Its `modify_residual`; None: its default.
        options: Of `sysid.optimize`.
        threads: Threads of the rollouts.
        clock: What the times are read from [s].
        took: Time that `sequences` took [s].
        budget: The search is stopped after this time [s].
    """
    from mujoco import sysid
    from mujoco.sysid._src.trajectory import sysid_rollout

    began = clock() - took
    lower, upper = system.space.bounds
    unknowns = sysid.ParameterDict(
        {name: sysid.Parameter(name, 0.0, lower[i], upper[i]) for i, name in enumerate(system.space.names)}
    )

    def late(control, found):
        """The commands that act, under the delays of the found parameters."""
        steps = system.edits.delays(system.space.theta_of(found.as_vector())[None])[0] / system.dt
        rows = np.arange(len(control.times))
        columns = zip(control.data.T, steps, strict=True)
        acting = [np.interp(rows - delay, rows, column) for column, delay in columns]
        return sysid.TimeSeries(control.times, np.stack(acting, axis=1), control.signal_mapping)

    def rollout(*, control_signal, param_dicts, **rest):
        return sysid_rollout(
            control_signal=[late(*pair) for pair in zip(control_signal, param_dicts, strict=True)], **rest
        )

    residual = sysid.build_residual_fn(
        models_sequences=[sequences],
        build_model=lambda found, _spec: system.edits.apply(
            system.model, system.space.theta_of(found.as_vector())
        ),
        custom_rollout=rollout if system.edits.late else None,
        modify_residual=modify,
        n_threads=threads,
    )
    times, visited = [], []

    def watched(x, parameters):
        if clock() - began > budget:
            raise BudgetSpentError
        result = residual(x, parameters)
        if np.ndim(x) == 1 or x.shape[1] == 1:
            times.append(clock() - began)
            visited.append(np.array(x).reshape(-1))
        return result

    # its own `verbose` does not reach its solver
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(BudgetSpentError):
        sysid.optimize(unknowns, watched, optimizer="mujoco", verbose=False, **options)
    return Path(times, visited, clock() - began)


def _sequences(sysid, case: Case):
    """Every clip as one sequence, from its recorded first state."""
    system, model = case.system, case.system.model
    layout = _layout(sysid, model)
    starts, controls, measured = [], [], []
    clips = _clips_of(case)
    for window in clips:
        state = _states(system, window)
        starts.append(sysid.create_initial_state(model, state[0, : model.nq], state[0, model.nq :]))
        stamps = np.arange(window.length + 1) * model.opt.timestep
        control = np.zeros((window.length + 1, model.nu))
        for source in system.inputs:
            values = window.log[source.key].values
            control[:, list(source.columns)] = values[window.start : window.stop + 1]
        controls.append(sysid.TimeSeries.from_control_names(stamps, control, model))
        rows = np.flatnonzero(_sampled(system, window))
        measured.append(sysid.TimeSeries.from_custom_map(stamps[rows], state[rows], layout))
    numbers = [f"clip {i}" for i in range(len(clips))]
    return sysid.ModelSequences(
        system.name, system.spec, numbers, starts, controls, measured, allow_missing_sensors=True
    )


def _clips_of(case: Case) -> list[Window]:
    low, high = case.system.settings.clips.length
    pool = ClipPool(case.system, [whole(log) for log in case.fitted], case.system.settings.clips)
    return pool.cut(0.5 * (low + high))


def _layout(sysid, model: mujoco.MjModel) -> list[tuple]:
    """Its names, widths and types of all positions, then all velocities."""
    positions, velocities, _, _ = sysid.TimeSeries.compute_all_state_mappings(model)
    return [(name, columns.size, kind) for name, (kind, columns) in (positions | velocities).items()]


def _states(system: System, window: Window) -> FloatArray:
    """Recorded states of a clip, quaternions without jumps of sign, shape (length + 1, nq + nv)."""
    state = np.zeros((window.length + 1, system.model.nq + system.model.nv))
    for channel in system.channels:
        values = np.array(window.log[channel.key].values[window.start : window.stop + 1])
        if channel.kind == "rotation":
            jumps = np.sign((values[1:] * values[:-1]).sum(axis=1))
            values[1:] *= np.cumprod(jumps)[:, None]
        offset = system.model.nq if channel.source == "qvel" else 0
        state[:, [offset + c for c in channel.columns]] = values
    return state


def _sampled(system: System, window: Window) -> np.ndarray:
    """Instants of a clip at which something was measured, its first one left out."""
    rows = slice(window.start, window.stop + 1)
    sampled = np.any([window.log[c.key].sampled[rows] for c in system.channels], axis=0)
    sampled[0] = False
    return sampled


def _whitening(sysid, system: System):
    """Residuals in units of the noise, rotations by their logarithm, as amhe's own."""
    nq = system.model.nq

    def modify(parameters, predicted, measured, model, return_all, state):
        rows = np.round(measured.times / model.opt.timestep).astype(int) - 1
        parts = []
        for channel in system.channels:
            columns = [c + (nq if channel.source == "qvel" else 0) for c in channel.columns]
            found, real = state[rows][:, [1 + c for c in columns]], measured.data[:, columns]
            rotation = channel.kind == "rotation"
            difference = rotations.difference(found, real) if rotation else found - real
            assert channel.noise is not None
            parts.append(difference / channel.noise)
        return np.concatenate(parts, axis=1), measured, measured

    return modify


# -- the comparison ----------------------------------------------------------------------------------------


def judge(case: Case) -> Callable[[Sequence[FloatArray]], FloatArray]:
    """Held-out error of points z: mean position error [mm] where bodies are tracked, else matching cost."""
    settings = case.system.settings.clips
    pool = ClipPool(case.system, [whole(log) for log in case.held_out], settings)
    low, high = settings.length
    windows = pool.cut(settings.held_out_length or 0.5 * (low + high), settings.held_out_first_only)
    engine = open_engine(case.system, threads=THREADS, sensors=False)
    cost = MatchingCost(case.system, windows, engine, case.system.settings.cost)

    def error(points: Sequence[FloatArray]) -> FloatArray:
        residuals = cost.residuals(np.stack(points))
        found = 1e3 * cost.errors(residuals, "position").mean(axis=1)
        return cost.costs_of(residuals) if np.isnan(found).all() else found

    return error


def arrival(times: Sequence[float], errors: FloatArray, target: float) -> float:
    """When a search first was as good as the target [s]; inf: never."""
    there = np.flatnonzero(errors <= target)
    return times[there[0]] if there.size else np.inf


VARIANTS: dict[str, tuple[bool, float | None]] = {
    "sysid, its defaults": (False, None),
    "sysid, noise units": (True, None),
    "sysid, noise units, larger step": (True, LARGER_STEP),
}


def compare(name: str, case: Case, repetitions: int) -> list[tuple[str, ...]]:
    """One line for each search; times are medians, ratios are taken repetition by repetition."""
    error = judge(case)
    runs: dict[str, list[tuple[Path, FloatArray]]] = {}
    for seed in range(repetitions):
        path = with_amhe(case, seed)
        runs.setdefault("amhe", []).append((path, error(path.z)))
        for variant, options in VARIANTS.items():
            path = with_sysid(case, *options)
            runs.setdefault(variant, []).append((path, np.minimum.accumulate(error(path.z))))
    final = {who: float(np.median([errors[-1] for _, errors in found])) for who, found in runs.items()}
    before = float(error([np.zeros(len(case.system.space))])[0])
    lines = []
    for who, found in runs.items():
        target = ARRIVED * min(final["amhe"], final[who])  # what the better of the two settles on
        own = np.array([arrival(path.times, errors, target) for path, errors in found])
        amhe = np.array([arrival(path.times, errors, target) for path, errors in runs["amhe"]])
        ratio = float(np.median(np.where(np.isinf(own), 0.0, amhe / own)))
        lines.append(
            (
                f"{name}: {who}",
                f"{before:.3g}",
                f"{final[who]:.3g}",
                f"{np.median([path.total for path, _ in found]):.1f} s",
                f"{np.median(own):.2f} s" if np.isfinite(np.median(own)) else "never",
                "" if who == "amhe" else f"{np.median(amhe):.2f} s",
                "" if who == "amhe" else f"{ratio:.2f}x",
                "" if who == "amhe" else ("yes" if ratio <= GOAL else "NO"),
            )
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--case", nargs="+", choices=tuple(CASES), default=list(CASES))
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one repetition")
    arguments = parser.parse_args()
    try:
        import mujoco.sysid as sysid

        sysid.optimize  # noqa: B018 (the package is there without its extra, and empty)
    except (ImportError, AttributeError):
        print("skipped: mujoco.sysid is not installed; pip install 'amhe[bench]'")
        return
    logging.disable(logging.WARNING)
    lines = []
    for name in arguments.case:
        case = CASES[name]()
        if case is None:
            print(f"{name} skipped: its logs are not here")
            continue
        lines += compare(name, case, 1 if arguments.quick else arguments.repetitions)
    show(
        f"Time to the held-out error that the better one reaches (goal {GOAL:g}x; "
        "cube_toss in mm, pendulums matching cost)",
        ("search", "error before", "after", "whole search", "time to it", "amhe's", "ratio", "in goal"),
        lines,
    )


if __name__ == "__main__":
    main()
