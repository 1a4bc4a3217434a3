"""What the benchmarks share: simulated logs with known truth, seeds over processes, results kept on disk."""

from __future__ import annotations

import argparse
import copy
import functools
import hashlib
import json
import multiprocessing
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy: BLAS threads would fight the rollouts' own

import mujoco
import numpy as np

import amhe_cli
from amhe_cli.core import resample, rotations
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log
from amhe_cli.core.signals import Series
from amhe_cli.matching.starts import tangent_of
from amhe_cli.system.assumed import Acting, assumed_of, with_assumed
from amhe_cli.system.description.data import Channel
from amhe_cli.system.system import System

PROJECT = Path(__file__).resolve().parent.parent
SYSTEMS = Path(__file__).resolve().parent / "systems"
#: Real logs, not part of the project; benchmarks that need them are skipped where they are absent.
DATA = PROJECT.parent / "shared" / "data"
RESULTS = PROJECT / "amhe-out" / "benchmarks"
#: Steps of a real motion in one of a model whose time step is doubted.
FINER = 8

#: Command over time: seconds -> input vector of the model's actuators.
Command = Callable[[float], FloatArray]


# -- simulated logs ----------------------------------------------------------------------------------------


def simulated(
    system: System,
    theta: FloatArray,
    command: Command,
    seconds: float,
    rng: np.random.Generator,
    *,
    state_hz: float = 100.0,
    command_hz: float = 50.0,
    settle: float = 0.0,
    noisy_start: bool = True,
    askew: bool = False,
    finer: int = 1,
) -> Log:
    """A log as the reader would make it, of the system's own model at theta.

    Args:
        system: Its channels say what is measured, and with what noise.
        theta: True parameters, shape (d,).
        command: Held between commands.
        seconds: Length of the log.
        rng: Draws the noise.
        state_hz, command_hz: Message rates.
        settle: Seconds simulated under the first command before the log begins.
        noisy_start: Whether the very first state carries noise as well.
        askew: The plant begins as far from the model's own state as its sensors err. Nothing real is exactly
            symmetric, and a simulation that is stays so, on a motion that any breath of air would end.
        finer: Steps of the simulation in one of the log.
    """
    model = system.edits.apply(system.model, theta)
    late = system.edits.delays(theta[None])[0] / model.opt.timestep
    first = _askew(system, model, rng) if askew else model.qpos0
    logged = _simulate(model, first, command, seconds, command_hz, settle, late)
    qpos, qvel, ctrl = (values[::finer] for values in logged)
    dt = finer * model.opt.timestep
    every = round(1.0 / state_hz / dt)
    steps = len(qpos) - 1
    rows = np.arange(0, steps + 1, every)
    truth = {"qpos": qpos, "qvel": qvel}
    series: dict[str, Series] = {}
    for channel in system.channels:
        if channel.source == "qvel" and channel.noise is None:
            series[channel.key] = _derived(channel, series, rows * dt)
        else:
            series[channel.key] = _measured(channel, truth[channel.source], rows, rng, noisy_start)
    for source in system.inputs:
        names = tuple(f"u{c}" for c in source.columns)
        on = np.ones(steps + 1, dtype=bool)
        series[source.key] = Series(ctrl[:, list(source.columns)], on, on, names)
    return Log(dt, series, "simulated")


def _askew(system: System, model: mujoco.MjModel, rng: np.random.Generator) -> FloatArray:
    """A first position (nq,) that differs from the model's own by a draw of the sensors' noise."""
    sd, first = np.zeros(model.nv), np.array(model.qpos0)
    for channel in system.channels:
        if channel.source == "qpos":
            sd[tangent_of(system, channel)] = channel.noise or 0.0
    mujoco.mj_integratePos(model, first, sd * rng.standard_normal(model.nv), 1.0)
    return first


def _simulate(
    model: mujoco.MjModel,
    first: FloatArray,
    command: Command,
    seconds: float,
    command_hz: float,
    settle: float,
    late: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """True states and inputs at every instant, the first one included; inputs act `late` steps after it."""
    data = mujoco.MjData(model)
    data.qpos[:] = first
    data.ctrl[:] = command(0.0)
    for _ in range(round(settle / model.opt.timestep)):
        mujoco.mj_step(model, data)
    steps, hold = round(seconds / model.opt.timestep), round(1.0 / command_hz / model.opt.timestep)
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    instants = np.arange(steps + 1)
    ctrl = np.array([command(k * model.opt.timestep) for k in instants[::hold]])[instants // hold]
    # a delay interpolates commands, as the engine's does
    lags = np.broadcast_to(late, model.nu)
    acting = [np.interp(instants - lag, instants, column) for lag, column in zip(lags, ctrl.T, strict=True)]
    for k in instants:
        qpos[k], qvel[k] = data.qpos, data.qvel
        data.ctrl[:] = [column[k] for column in acting]
        mujoco.mj_step(model, data)
    return qpos, qvel, ctrl


def _measured(
    channel: Channel, truth: FloatArray, rows: np.ndarray, rng: np.random.Generator, noisy_start: bool
) -> Series:
    """Noisy samples on some rows, interpolated between them."""
    exact = truth[rows][:, list(channel.columns)]
    noise = channel.noise or 0.0
    if channel.kind == "rotation":
        turn = rng.normal(0.0, noise, (len(rows), 3))
        turn[0] *= noisy_start
        samples = rotations.multiply(rotations.normalised(exact), rotations.exp(turn))
    else:
        error = rng.normal(0.0, noise, exact.shape)
        error[0] *= noisy_start
        samples = exact + error
    return _between(samples, rows, len(truth), channel, derived=False)


def _derived(channel: Channel, series: dict[str, Series], stamps: FloatArray) -> Series:
    """A velocity that no topic carries, differentiated as the log reader does."""
    signal, quantity = channel.key.rsplit(".", 1)
    turning = quantity == "angular_velocity"
    below = series[f"{signal}.orientation" if turning else f"{signal}.position"]
    rows = np.flatnonzero(below.sampled)
    slope = resample.angular_velocity if turning else resample.derivative
    samples = slope(stamps, below.values[rows], 10.0)
    return _between(samples, rows, len(below.values), channel, derived=True)


def _between(samples: FloatArray, rows: np.ndarray, count: int, channel: Channel, derived: bool) -> Series:
    """Samples on some of `count` rows, interpolated between them."""
    instants = np.arange(count)
    below = np.clip(np.searchsorted(rows, instants, side="right") - 1, 0, len(rows) - 2)
    share = (instants - rows[below]) / (rows[below + 1] - rows[below])
    if channel.kind == "rotation":
        values = rotations.slerp(samples[below], samples[below + 1], share)
    else:
        values = samples[below] + share[:, None] * (samples[below + 1] - samples[below])
    valid = instants <= rows[-1]
    names = tuple(f"c{c}" for c in channel.columns)
    return Series(values, valid, np.isin(instants, rows), names, derived)


def multisine(rng: np.random.Generator, size: float = 0.9) -> Command:
    """A position command [rad], from slow (friction shows) to fast (inertia shows); 0 at time 0."""
    hertz = np.geomspace(0.15, 2.5, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    sizes = 0.5 * size / np.sqrt(hertz / hertz[0])
    return lambda t: np.array([(sizes * (np.sin(2.0 * np.pi * hertz * t + phase) - np.sin(phase))).sum()])


def stop_and_go(rng: np.random.Generator, seconds: float) -> Command:
    """A slider command [m] that only advances: pushes at random speeds, pauses between them."""
    times, places = [0.0], [0.0]
    while times[-1] < seconds:
        push, pause = rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.5)
        place = places[-1] + push * rng.uniform(0.25, 0.6)
        times += [times[-1] + push, times[-1] + push + pause]
        places += [place, place]
    return lambda t: np.array([np.interp(t, times, places)])


def plant_of(system: System, rng: np.random.Generator) -> tuple[System, FloatArray, int]:
    """A system that differs from its model by what the settings say that the model's numbers are worth.

    Args:
        system: The system.
        rng: Draws how far each assumed value is off, and by how much softer or harder contacts are.

    Returns:
        The system with the assumed values as further parameters; how far they are off, shape (k,); and how
        many of its steps make one of the model's: `FINER` where the settings doubt the time step.
    """
    model, doubts = system.model, system.settings.identify.assumed
    counts = model.nactuator, model.nactuator, model.nu, model.njnt, model.njnt
    acts = Acting(*(np.ones((1, count), dtype=bool) for count in counts))
    plant = with_assumed(system, [v for v in assumed_of(system, acts, system.space.names, {}) if v.sd > 0.0])
    values = plant.space.parameters[len(system.space) :]
    away = [p.prior_sd * z for p, z in zip(values, rng.standard_normal(len(values)), strict=True)]
    off = [p.nominal * np.exp(d) if p.log else p.nominal + d for p, d in zip(values, away, strict=True)]
    changed, finer = copy.copy(plant.model), FINER if doubts.time_step else 1
    changed.opt.timestep = model.opt.timestep / finer
    factor = 2.0 ** (doubts.contacts * rng.standard_normal())
    for solref in (changed.geom_solref, changed.pair_solref):
        solref[solref[:, 0] > 0.0, 0] *= factor
    return replace(plant, model=changed), np.array(off), finer


def drawn_from_prior(system: System, rng: np.random.Generator) -> FloatArray:
    """True parameters as the prior promises them, within the bounds."""
    lower, upper = system.space.bounds
    z = rng.standard_normal(len(system.space))
    while (outside := (z <= lower) | (z >= upper)).any():
        z[outside] = rng.standard_normal(int(outside.sum()))
    return system.space.theta_of(z)


# -- many seeds --------------------------------------------------------------------------------------------


def seeds_of(text: str) -> range:
    """The seeds below N, or from A to below B."""
    first, _, last = text.rpartition(":")
    return range(int(first or 0), int(last))


def over_seeds(
    name: str,
    one: Callable[[int], dict[str, Any]],
    seeds: Iterable[int],
    processes: int,
) -> list[dict[str, Any]]:
    """Results of `one(seed)`, from disk where an earlier run of the same code left them.

    Args:
        name: Of the file; say in it all that the results depend on besides the code.
        one: Module-level function of a seed; its result must go into JSON.
        seeds: Which.
        processes: Worker processes, each of one thread.
    """
    wanted = list(seeds)
    path = RESULTS / f"{name}-{fingerprint()}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {}
    if path.exists():
        done = {r["seed"]: r for r in map(json.loads, path.read_text().splitlines())}
    left = [seed for seed in wanted if seed not in done]
    with path.open("a") as file, multiprocessing.Pool(processes) as pool:
        for result in pool.imap_unordered(_Seeded(one), left):
            done[result["seed"]] = result
            file.write(json.dumps(result) + "\n")
            file.flush()
    return [done[seed] for seed in wanted]


def add_parts(parser: argparse.ArgumentParser) -> None:
    """Options of a run in parts; see `in_parts`."""
    parser.add_argument(
        "--part", default="1/1", metavar="K/N", help="every Nth trial, from the Kth on; 0/1: none"
    )
    parser.add_argument("--add", type=Path, nargs="+", default=[], help="what runs of other parts printed")


def in_parts(
    name: str, one: Callable[[int], dict[str, Any]], seeds: Iterable[int], given: argparse.Namespace
) -> list[dict[str, Any]]:
    """Results of one part of `one(seed)`, each printed as it ends, and of the parts that `--add` names."""
    first, every = map(int, given.part.split("/"))
    lines = [line for path in given.add for line in path.read_text(encoding="utf-8").splitlines()]
    known = [json.loads(line) for line in lines if line.startswith('{"seed"')]
    ready = {found["seed"]: found for found in known}
    wanted = list(seeds)
    left = [seed for seed in wanted[first - 1 :: every] if first and seed not in ready]
    done = over_seeds(name, functools.partial(_printed, one), left, given.jobs)
    return [*(ready[seed] for seed in wanted if seed in ready), *done]


def _printed(one: Callable[[int], dict[str, Any]], seed: int) -> dict[str, Any]:
    found = {"seed": seed} | one(seed)
    print(json.dumps(found), flush=True)
    return found


class _Seeded:
    """`one(seed)` with the seed and the time it took in its result; a class so that it pickles."""

    def __init__(self, one: Callable[[int], dict[str, Any]]) -> None:
        self._one = one

    def __call__(self, seed: int) -> dict[str, Any]:
        began = time.perf_counter()
        return {"seed": seed, **self._one(seed), "seconds": time.perf_counter() - began}


def fingerprint() -> str:
    """Of all code that a result depends on: a changed program starts its results anew."""
    digest = hashlib.sha1()
    folders = (Path(amhe_cli.__file__).parent, Path(__file__).parent)
    for path in sorted(
        p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".xml", ".yaml")
    ):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


# -- tables ------------------------------------------------------------------------------------------------


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print one small table, and below it what it was made with."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*row)
    console = Console(width=max(100, Console().width))
    console.print(table)
    console.print(made_with(), style="dim", highlight=False)


def made_with() -> str:
    """Date, versions, machine, and the commit where there is one."""
    package = Path(amhe_cli.__file__).parent
    found = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=package, capture_output=True, text=True, check=False
    )
    commit = f" ({found.stdout.strip()})" if found.returncode == 0 else ""
    return (
        f"{date.today()}, amhe {amhe_cli.__version__}{commit}, mujoco {mujoco.__version__}, "
        f"numpy {np.__version__}, Python {platform.python_version()}, {os.cpu_count()} cores"
    )


def paired(
    first: Callable[[], object], second: Callable[[], object], repetitions: int
) -> tuple[float, float, float]:
    """Median seconds of two calls timed in turns, and the median of their ratios second / first.

    A busy machine slows both alike: their ratio, taken pair by pair, survives it.
    """
    first(), second()  # warm up
    times = np.empty((repetitions, 2))
    for row in times:
        for i, call in enumerate((first, second)):
            began = time.perf_counter()
            call()
            row[i] = time.perf_counter() - began
    return (
        float(np.median(times[:, 0])),
        float(np.median(times[:, 1])),
        float(np.median(times[:, 1] / times[:, 0])),
    )
