"""One matching-cost evaluation against the bare rollouts in it: the arithmetic around them should be free.

    python benchmarks/matching_cost.py [--repetitions 15] [--quick]

The bare side is `mujoco.batch.Batch.rollout` of the same candidates, first states, inputs, lengths and
records, in the same length groups, on a pool that is set up beforehand.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import mujoco
import mujoco.batch
import numpy as np
from common import multisine, paired, show, simulated

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.log import Log
from amhe_cli.core.rotations import exp
from amhe_cli.core.signals import Series
from amhe_cli.engine.cpu import _groups as length_groups
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.offline.clips import ClipPool, whole
from amhe_cli.matching.cost import MatchingCost
from amhe_cli.system.system import System

GOAL = 1.10
CANDIDATES = 32
CLIPS = 24


def pendulum() -> tuple[System, list[Log]]:
    """A servo and a load: the cheapest steps, so the hardest case."""
    system = System.load("pendulum")
    rng = np.random.default_rng(0)
    return system, [simulated(system, system.space.nominal, multisine(rng), 20.0, rng)]


def cube_toss() -> tuple[System, list[Log]]:
    """Tosses of a cube with random spin: contact, quaternions, twelve channels."""
    system = System.load("cube_toss")
    return system, [_toss(system, np.random.default_rng(seed)) for seed in range(CLIPS)]


def _toss(system: System, rng: np.random.Generator) -> Log:
    """One simulated toss of half a second."""
    model, data = system.model, mujoco.MjData(system.model)
    data.qpos[:3] = (0.0, 0.0, 0.15)
    data.qpos[3:] = exp(rng.uniform(-1.0, 1.0, 3))
    data.qvel[:] = rng.normal(0.0, (1.0, 1.0, 0.3, 5.0, 5.0, 5.0))
    qpos, qvel = np.empty((251, model.nq)), np.empty((251, model.nv))
    for k in range(len(qpos)):
        qpos[k], qvel[k] = data.qpos, data.qvel
        mujoco.mj_step(model, data)
    on = np.ones(len(qpos), dtype=bool)
    sampled = np.arange(len(qpos)) % 3 == 0  # 167 Hz, like motion capture
    source = {"qpos": qpos, "qvel": qvel}
    series = {
        c.key: Series(source[c.source][:, list(c.columns)], on, sampled, tuple(map(str, c.columns)))
        for c in system.channels
    }
    return Log(model.opt.timestep, series, "toss")


def matching(system: System, logs: list[Log], threads: int) -> tuple[MatchingCost, FloatArray]:
    """A cost on clips as SPI draws them, and candidates about the nominal."""
    rng = np.random.default_rng(1)
    pool = ClipPool(system, [whole(log) for log in logs], system.settings.clips)
    engine = open_engine(system, threads=threads)
    cost = MatchingCost(system, pool.draw(rng, CLIPS), engine, system.settings.cost)
    return cost, 0.2 * rng.standard_normal((CANDIDATES, len(system.space)))


def bare(cost: MatchingCost, z: FloatArray, threads: int) -> Callable[[], None]:
    """The same rollouts with nothing around them."""
    system, starts, model = cost.system, cost.clips.starts, cost.system.model
    theta = system.space.theta_of(z)
    batch = mujoco.batch.Batch(model, len(z) * len(starts.lengths), threads)
    fields = {name: batch.expand(name) for name in system.edits.fields}
    system.edits.write(fields, np.repeat(theta, len(starts.lengths), axis=0))
    batch.set_const()
    qpos, qvel = np.tile(starts.qpos, (len(z), 1)), np.tile(starts.qvel, (len(z), 1))
    inputs = starts.inputs_under(system.edits.delays(theta) / model.opt.timestep)
    groups = [
        (ids, steps, inputs[ids, :steps]) for ids, steps in length_groups(np.tile(starts.lengths, len(z)))
    ]

    def run() -> None:
        batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.bind("qpos")[:] = qpos
        batch.bind("qvel")[:] = qvel
        for ids, steps, control in groups:
            batch.rollout(
                steps,
                control=control if control.shape[2] else None,
                control_spec=system.input_spec,
                record=["qpos", "qvel"],
                ids=ids,
            )

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="5 repetitions")
    arguments = parser.parse_args()
    lines = []
    for name, case in (("pendulum", pendulum), ("cube_toss", cube_toss)):
        system, logs = case()
        for threads in (1, 2):
            cost, z = matching(system, logs, threads)
            steps = int(cost.clips.starts.lengths.sum()) * len(z)
            alone, full, ratio = paired(
                bare(cost, z, threads),
                lambda c=cost, v=z: c.costs(v),
                5 if arguments.quick else arguments.repetitions,
            )
            lines.append(
                (
                    name, str(threads), f"{steps:,}", f"{1e3 * alone:.1f} ms", f"{1e3 * full:.1f} ms",
                    f"{ratio:.2f}x", "yes" if ratio <= GOAL else "NO",
                )
            )  # fmt: skip
    show(
        f"Matching cost of {CANDIDATES} candidates on {CLIPS} clips (goal {GOAL:.2f}x)",
        ("system", "threads", "steps", "bare rollouts", "matching cost", "ratio", "in goal"),
        lines,
    )


if __name__ == "__main__":
    main()
