"""Matching cost on graphics cards: agreement with the CPU engine, and steps a second against worlds.

    python benchmarks/gpu.py [--rollouts 1024,4096,8192,32768] [--problems go1_push,arm] [--device cuda:0]
    python benchmarks/gpu.py --cards cuda:0,cuda:1   # the cost on all of them, beside the first
    python benchmarks/gpu.py --fits gpu,auto [--problems arm,cube_toss,feet] [--seeds 3]  # beside the cpu's

"step" is the captured step of mujoco-warp on the same worlds through the motion of the clips: with their
inputs, a clock, and nothing else; all that the worlds step counts, also while they wait for longer clips.
"Busy" is the share of these steps that clips asked for: only those count for the cost. "still" is the step
alone under the last inputs, where worlds come to rest; "iterations" are those of its solver in motion and
there, on the average. The CPU beside it evaluates the same cost of fewer candidates with all cores.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import mujoco
import numpy as np
from common import PROJECT, multisine, show, simulated
from matching_cost import cube_toss, pendulum

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log
from amhe_cli.core.rotations import exp, multiply
from amhe_cli.engine.cpu import CpuEngine
from amhe_cli.engine.gpu.engine import GpuEngine
from amhe_cli.engine.open import open_engine
from amhe_cli.engine.rollout import Engine, Predicted
from amhe_cli.estimation.offline import search
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.estimation.offline.problem import Problem
from amhe_cli.logs import read_log
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

CLIPS = 16
JOINTS = 12
#: Steps by which a step at rest is timed, and steps after which the solver's iterations are read.
STILL, LOOK = 200, 20


def go1_push() -> tuple[System, list[Log]]:
    """`make demo`: a Go1 pushes a box, with contacts everywhere."""
    system = System.load("go1_push")
    return system, [read_log(PROJECT / "examples" / "logs" / "t1.mcap", system)]


def arm() -> tuple[System, list[Log]]:
    """Four legs of three servo joints on a fixed base; armature, damping and friction of each are unknown."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.0025, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for leg in range(JOINTS // 3):
        parent = spec.worldbody.add_body(name=f"base{leg}", pos=[0.3 * leg, 0.0, 1.0])
        parent.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], contype=0, conaffinity=0)
        for joint, axis in enumerate(([1, 0, 0], [0, 1, 0], [0, 1, 0])):
            name, k = f"j{3 * leg + joint}", 0.213 if joint else 0.08
            parent = parent.add_body(name=f"link_{name}", pos=[0, 0, -k if joint == 2 else 0])
            parent.add_joint(name=name, axis=axis, armature=0.01, damping=0.1, frictionloss=0.1)
            parent.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0, 0, -k], size=[0.02, 0, 0],
                mass=0.6, contype=0, conaffinity=0,
            )  # fmt: skip
            servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=20.0, kv=0.5)
    names = [f"j{i}" for i in range(JOINTS)]
    words = {"armature": 0.01, "damping": 0.1, "friction_loss": 0.1}
    parameters = {
        f"{word}_{name}": {"nominal": value, "targets": [{"set": word, "joint": name}]}
        for name in names
        for word, value in words.items()
    }
    signals = {
        "joints": {"topic": "/joint_states", "joints": names, "noise": {"position": 0.001}},
        "command": {"topic": "/command", "actuators": names, "quantity": "position"},
    }
    system = System.from_model(spec, parameters=parameters, signals=signals, name="arm")
    rng = np.random.default_rng(0)
    each = [multisine(np.random.default_rng(i), 0.4) for i in range(JOINTS)]
    command = lambda t: np.concatenate([np.atleast_1d(one(t)) for one in each])  # noqa: E731
    return system, [simulated(system, system.space.nominal, command, 20.0, rng, state_hz=400.0)]


def feet() -> tuple[System, list[Log]]:
    """A plate that slides on 60 sphere feet: more rows of constraints than buffers begin with."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.002
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1])
    body = spec.worldbody.add_body(name="plate", pos=[0, 0, 0.02])
    body.add_freejoint(name="free")
    for i, (x, y) in enumerate(np.stack(np.meshgrid(np.arange(10), np.arange(6)), axis=-1).reshape(-1, 2)):
        body.add_geom(
            name=f"foot{i}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0, 0], mass=0.05,
            pos=[0.05 * (x - 4.5), 0.05 * (y - 2.5), 0.0],
        )  # fmt: skip
        spec.add_pair(name=f"pair{i}", geomname1="floor", geomname2=f"foot{i}", friction=[0.4, 0.4, 0, 0, 0])
    pairs = [{"pair": f"pair{i}", "set": "sliding_friction"} for i in range(60)]
    noise = {"position": 0.001, "orientation": 0.005}
    system = System.from_model(
        spec,
        parameters={"friction": {"nominal": 0.4, "targets": pairs}},
        signals={"plate": {"body": "plate", "noise": noise, "slope": {"linear_velocity": 0.05}}},
        name="feet",
        warn=False,
    )
    model = system.edits.apply(system.model, np.array([0.35]))
    logs = []
    for seed in range(4):
        rng, data = np.random.default_rng(seed), mujoco.MjData(model)
        data.qpos[2], data.qvel[:2], data.qvel[5] = 0.02, rng.normal(0.0, 0.7, 2), rng.normal(0.0, 2.0)
        states = np.empty((400, 7))
        for k in range(len(states)):
            states[k] = data.qpos
            mujoco.mj_step(model, data)
        states[:, :3] += rng.normal(0.0, noise["position"], (len(states), 3))
        turns = exp(rng.normal(0.0, noise["orientation"], (len(states), 3)))
        states[:, 3:] = multiply(states[:, 3:], turns)
        time = spec.option.timestep * np.arange(len(states))
        arrays = {"time": time, "position": states[:, :3], "orientation": states[:, 3:]}
        logs.append(Log.from_arrays({"plate": arrays}, system))
    return system, logs


PROBLEMS: dict[str, Callable[[], tuple[System, list[Log]]]] = {
    "pendulum": pendulum,
    "cube_toss": cube_toss,
    "go1_push": go1_push,
    "arm": arm,
    "feet": feet,
}


def matching(system: System, logs: list[Log], engine: Engine) -> MatchingCost:
    """The cost on clips as SPI draws them."""
    pool = ClipPool(system, [whole(log) for log in logs], system.settings.clips)
    return MatchingCost(system, pool.draw(np.random.default_rng(1), CLIPS), engine, system.settings.cost)


def on_device(system: System, *devices: str) -> GpuEngine:
    """The engine on some devices."""
    return GpuEngine(system.model, system.edits, system.input_spec, system.senses, devices)


def agreement(name: str, device: str, cores: int) -> list[str]:
    """Costs, their order, and slopes of both engines at the same candidates."""
    system, logs = PROBLEMS[name]()
    one = matching(system, logs, open_engine(system, threads=cores))
    other = matching(system, logs, on_device(system, device))
    rng, d = np.random.default_rng(2), len(system.space)
    z = 0.2 * rng.standard_normal((64, d))
    costs = one.costs(z), other.costs(z)
    ranks = [np.argsort(np.argsort(c)) for c in costs]
    predicted = [c.residuals(z[:8]).flat for c in (one, other)]
    away = np.abs(predicted[1] - predicted[0])
    steps = np.concatenate((0.05 * np.eye(d), -0.05 * np.eye(d)))
    slopes = []
    for cost in (one, other):
        flat = cost.residuals(steps).flat
        slopes.append((flat[:d] - flat[d:]).reshape(d, -1))
    cosine = [float(a @ b / np.sqrt((a @ a) * (b @ b))) for a, b in zip(*slopes, strict=True) if a @ a > 0]
    together = np.asarray(np.corrcoef(np.stack(ranks)))[0, 1]
    other_cost = np.abs(costs[1] / costs[0] - 1.0)
    return [
        name, f"{np.median(other_cost):.1e}", f"{other_cost.max():.1e}",
        f"{together:.4f}", f"{np.median(away):.1e}", f"{np.quantile(away, 0.99):.1e}",
        f"{np.median(cosine):.5f}", f"{min(cosine):.5f}",
    ]  # fmt: skip


def timed(call: Callable[[], object], repetitions: int = 3) -> float:
    """Median seconds."""
    call()
    taken = []
    for _ in range(repetitions):
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def stepped(worlds: Any, job: Any, device: str) -> list[tuple[float, float]]:
    """Seconds of the steps of a job, and of STILL steps after its end; and the solver's mean iterations."""
    import warp as wp

    iterations: list[float] = []

    def look(step: int) -> None:
        if step % LOOK == 0:
            iterations.append(float(worlds._data.solver_niter.numpy().mean()))

    def moving(looks: bool = False) -> float:
        with worlds.stream():
            work, clock, count = worlds.prepare(job, []), worlds._view(worlds.clock), itertools.count(1)

            def watch() -> None:
                clock.__iadd__(1)  # without a clock the inputs stand still, and so do most worlds
                if looks:
                    look(next(count))

            wp.synchronize_device(device)
            start = time.perf_counter()
            replace(work, record=[], watch=watch).run()
            wp.synchronize_device(device)
        return time.perf_counter() - start

    def still(looks: bool = False) -> float:
        start = time.perf_counter()
        for step in range(1, STILL + 1):
            worlds.step()
            if looks:
                look(step)
        wp.synchronize_device(device)
        return time.perf_counter() - start

    def measured(call: Callable[[bool], float]) -> tuple[float, float]:
        """Median seconds, and mean iterations of the solver."""
        call(False)
        iterations.clear()
        call(True)
        return float(np.median([call(False) for _ in range(3)])), float(np.mean(iterations))

    return [measured(moving), measured(still)]


def speed(name: str, rollouts: int, device: str, cores: int) -> list[str]:
    """Steps a second of the cost on the card, of the step in motion and at rest, and of the cost on cores."""
    from amhe_cli.engine.gpu.card import Card, bytes_per_world

    system, logs = PROBLEMS[name]()
    engine = on_device(system, device)
    cost = matching(system, logs, engine)
    rng, d = np.random.default_rng(2), len(system.space)
    z = 0.1 * rng.standard_normal((rollouts // CLIPS, d))
    lengths = cost.clips.starts.lengths
    steps = int(lengths.sum()) * len(z)
    first = time.perf_counter()
    cost.costs(z)
    first = time.perf_counter() - first
    full = timed(lambda: cost.costs(z))
    card: Card = engine.cards[0]
    job = engine.job(cost.system.space.theta_of(z), cost.clips.starts, None, ())
    set_ = card.worlds(len(job.queue))

    made = float(job.ends[:, -1].max() * set_.count)
    (in_motion, active), (at_rest, idle) = stepped(set_, job, device)
    step, rest, rate = made / in_motion, STILL * set_.count / at_rest, steps / full
    beside = matching(system, logs, open_engine(system, threads=cores))
    few = z[: max(1, min(len(z), 1024 // CLIPS))]
    host = timed(lambda: beside.costs(few))
    cpu = steps / len(z) * len(few) / host
    memory = bytes_per_world(card.blueprint, set_.room, device)
    return [
        name, f"{rollouts:,}", f"{set_.count:,}", f"{step / 1e6:.2f} M", f"{steps / made:.2f}",
        f"{rate / 1e6:.2f} M", f"{rate / step:.2f}", f"{rest / 1e6:.2f} M", f"{active:.1f}, {idle:.1f}",
        f"{cpu / 1e6:.3f} M", f"{rate / cpu:.1f}x", f"{memory / 1024:.0f} KiB", f"{first:.1f} s",
        f"{set_.room.contacts}/{set_.room.rows}",
    ]  # fmt: skip


def shared(name: str, rollouts: int, devices: Sequence[str]) -> list[str]:
    """Seconds of the cost on the first card and on all, and how far the costs of all are from its own."""
    system, logs = PROBLEMS[name]()
    z = 0.1 * np.random.default_rng(2).standard_normal((rollouts // CLIPS, len(system.space)))
    one, all_ = (matching(system, logs, on_device(system, *some)) for some in (devices[:1], devices))
    seconds = [timed(lambda cost=cost: cost.costs(z)) for cost in (one, all_)]
    away = np.abs(all_.costs(z) / one.costs(z) - 1.0)
    return [
        name, f"{rollouts:,}", *(f"{s:.3f} s" for s in seconds), f"{seconds[0] / seconds[1]:.2f}x",
        f"{np.median(away):.1e}", f"{away.max():.1e}",
    ]  # fmt: skip


def iteration(name: str, cores: int) -> list[str]:
    """Seconds of one iteration of the search with 4096 candidates on 8 clips of a minute."""
    system, logs = PROBLEMS[name]()
    logs = logs * max(1, round(60.0 / sum(log.duration for log in logs)))
    own = system.settings
    system = replace(
        system,
        settings=own.model_copy(
            update={
                "identify": own.identify.model_copy(update={"samples": 4096}),
                "clips": own.clips.model_copy(update={"count": 8}),
            }
        ),
    )
    seconds, begun = [], search.ROUGHLY  # the iterations before take fewer clips
    for kind, repetitions in (("gpu", 3), ("auto", 3), ("cpu", 1)):
        engine = open_engine(system, kind=kind, threads=cores)
        pool = ClipPool(system, [whole(log) for log in logs], system.settings.clips)
        problem = Problem(system, pool, engine, 0, threads=cores)
        state = replace(search.start(problem), number=begun)
        _ = problem.non_smooth, problem.sparsity
        for _ in range(repetitions):  # the first on a card captures its graphs
            start = time.perf_counter()
            search.advance(problem, replace(state, stage="explore"))
            last = time.perf_counter() - start
        seconds.append(last)
    *cards, host = seconds
    return [name, *(f"{card:.2f} s" for card in cards), f"{host:.1f} s", f"{host / min(cards):.1f}x"]


@dataclass(frozen=True)
class Fit:
    """One identification: its wall and CPU seconds, those in rollouts on the processor, and what it found.

    Estimate and sds are in coordinates z.
    """

    seconds: float
    cpu: float
    rollouts: float
    z: FloatArray
    sd: FloatArray
    verdicts: dict[str, str]

    def apart(self, other: Fit) -> float:
        """Farthest estimate, in the other's sd."""
        return float((np.abs(self.z - other.z) / other.sd).max())

    def wider(self, other: Fit) -> float:
        """The factor between the sds that differ most."""
        return float(np.exp(np.abs(np.log(self.sd / other.sd)).max()))


def fit(name: str, kind: str, threads: int, seed: int = 0) -> Fit:
    """Identify a problem."""
    system, logs = PROBLEMS[name]()
    engine: Any = CpuEngine
    spent, predict = [0.0], engine.predict

    def timed(*arguments: Any) -> Predicted:
        begun = time.process_time()
        predicted = predict(*arguments)
        spent[0] += time.process_time() - begun
        return predicted

    engine.predict = timed
    start, cpu = time.perf_counter(), time.process_time()
    result = amhe.identify(system, logs, seed=seed, threads=threads, engine=kind)
    engine.predict = predict
    return Fit(
        time.perf_counter() - start,
        time.process_time() - cpu,
        spent[0],
        system.space.z_of(result.belief.estimate),
        np.sqrt(np.diag(np.array(result.belief.covariance))) / system.space.prior_sd,
        {p.name: p.verdict for p in result.parameters.values()},
    )


def alone(name: str, kind: str, cores: int, seed: int) -> Fit:
    """An identification in a process of its own, as of a command."""
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        return executor.submit(fit, name, kind, cores, seed).result()


def fits(name: str, kinds: Sequence[str], cores: int, seeds: int) -> Iterator[list[str]]:
    """Whole identifications beside those of the processor; of the processor, its seeds beside the first."""
    turns = [{kind: alone(name, kind, cores, seed) for kind in ("cpu", *kinds)} for seed in range(seeds)]
    usual = np.median([turn["cpu"].seconds for turn in turns])
    for kind in turns[0]:
        found = [turn[kind] for turn in turns]
        beside = [turn["cpu"] for turn in turns] if kind != "cpu" else seeds * [found[0]]
        pairs = list(zip(found, beside, strict=True))
        others = [
            f"{seed}: {n}: {v} -> {one.verdicts[n]}"
            for seed, (one, other) in enumerate(pairs)
            for n, v in other.verdicts.items()
            if v != one.verdicts[n]
        ]
        every = sum(len(one.verdicts) for one in found)
        seconds, cpu, rollouts = (
            np.median([getattr(one, time) for one in found]) for time in ("seconds", "cpu", "rollouts")
        )
        yield [
            name, kind, f"{seconds:.1f} s", f"{seconds / usual:.2f}", f"{cpu:.1f} s", f"{rollouts:.1f} s",
            ", ".join(f"{one.apart(other):.2f}" for one, other in pairs),
            ", ".join(f"{one.wider(other):.2f}" for one, other in pairs),
            f"{every - len(others)} of {every}", "; ".join(others),
        ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rollouts", default="1024,4096,8192,32768")
    parser.add_argument("--problems", default=",".join(PROBLEMS))
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--cards", help="compare these with the first of them instead")
    parser.add_argument("--no-agreement", action="store_true")
    parser.add_argument("--iteration", help="problems of which to time one iteration of the search instead")
    parser.add_argument("--fits", help="engines by which to identify each problem instead, beside the cpu's")
    parser.add_argument("--seeds", type=int, default=1, help="of each of these, by whose median time")
    asked = parser.parse_args()
    if asked.iteration:
        lines = [iteration(name, asked.cores) for name in asked.iteration.split(",")]
        show("One iteration, 4096 candidates on 8 clips", ("system", "gpu", "auto", "cores", "faster"), lines)
        return
    names, sizes = asked.problems.split(","), list(map(int, asked.rollouts.split(",")))
    if asked.cards:
        lines = [shared(name, size, asked.cards.split(",")) for name in names for size in sizes]
        columns = ("system", "rollouts", "first", "all", "faster", "costs apart, median", "most")
        show(f"Matching cost on {asked.cards}", columns, lines)
        return
    if asked.fits:
        lines = []
        for name in names:
            for line in fits(name, asked.fits.split(","), asked.cores, asked.seeds):
                print(*lines.append(line) or line, flush=True)
        columns = (
            "system", "engine", "time", "of cpu's", "CPU time", "rollouts", "farthest estimate [sd], by seed",
            "factor of sds", "verdicts alike", "others",
        )  # fmt: skip
        show("Identifications", columns, lines)
        return
    if not asked.no_agreement:
        show(
            "Agreement of the engines, 64 candidates about the nominal",
            ("system", "cost", "worst", "rank corr.", "residual [sd]", "99 %", "slopes' cosine", "worst"),
            [agreement(name, asked.device, asked.cores) for name in names],
        )
    lines = []
    for name in names:
        for rollouts in sizes:
            lines.append(speed(name, rollouts, asked.device, asked.cores))
            print(*lines[-1], flush=True)
    show(
        f"Matching cost on {asked.device}, {asked.cores} CPU cores beside it",
        (
            "system", "rollouts", "worlds", "step/s", "busy", "cost steps/s", "cost/step", "still",
            "iterations", "CPU cost", "faster", "a world", "first", "room",
        ),
        lines,
    )  # fmt: skip


if __name__ == "__main__":
    main()
