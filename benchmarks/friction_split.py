"""Viscous against Coulomb friction, where the excitation cannot split them: no run may claim that it does.

    python benchmarks/friction_split.py [--seeds 20] [--quick]

A published table of one motor, three runs each, has viscous and Coulomb frictions that trade places by
+-129 %. Here a stiff servo goes to and fro at one speed, so that logs tell c + b |v|, and hardly c and b.
Each of three runs, of another speed within a few percent and other noise, is identified alone. Two runs
contradict each other where both are `identified` and their 90 % intervals have nothing in common.
"""

from __future__ import annotations

import argparse
import itertools
from typing import Any

import mujoco
import numpy as np
from common import over_seeds, show

import amhe_cli as amhe

STEP, SECONDS, NOISE = 0.005, 8.0, 3e-3
#: Speed of the motion [rad/s], and its size [rad].
SPEED, SIZE = 1.0, 0.5
FRICTION = ("viscous", "coulomb")
XML = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
  <joint name="drive" axis="0 0 1" armature="0.02" damping="0.2" frictionloss="0.2"/>
  <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.3" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><position name="drive" joint="drive" kp="100" kv="2"/></actuator></mujoco>"""


def system() -> amhe.System:
    """One joint with unknown armature and frictions; the gain was measured."""
    words = {"armature": "armature", "viscous": "damping", "coulomb": "friction_loss"}
    return amhe.System.from_model(
        mujoco.MjSpec.from_string(XML),
        parameters={
            name: {"scale": "log", "prior_sd": 0.7, "targets": [{"joint": "drive", "set": word}]}
            for name, word in words.items()
        },
        signals={
            "joints": {"joints": ["drive"], "noise": {"position": NOISE}},
            "command": {"actuators": ["drive"], "quantity": "position"},
        },
        settings={"identify": {"assumed": 0}},
    )


def run(described: amhe.System, theta: np.ndarray, rng: np.random.Generator) -> amhe.Log:
    """To and fro at one speed, without a rest."""
    model = described.edits.apply(described.model, theta)
    data, time = mujoco.MjData(model), np.arange(round(SECONDS / STEP)) * STEP
    turn = time * SPEED * rng.uniform(0.97, 1.03) / SIZE
    command = SIZE * (2.0 * np.abs(turn % 2.0 - 1.0) - 1.0)
    data.qpos[0], position = command[0], np.empty(len(time))
    for k, target in enumerate(command):
        position[k] = data.qpos[0]
        data.ctrl[0] = target
        mujoco.mj_step(model, data)
    measured = position + NOISE * rng.standard_normal(len(time))
    return amhe.Log.from_arrays(
        {
            "joints": {"time": time, "position": measured[:, None]},
            "command": {"time": time, "position": command[:, None]},
        },
        described,
    )


def trial(seed: int) -> dict[str, Any]:
    """Three runs of one joint."""
    rng, described = np.random.default_rng([seed, 3]), system()
    theta = described.space.nominal * np.exp(rng.uniform(-0.5, 0.5, 3))
    found = [amhe.identify(described, [run(described, theta, rng)], seed=seed) for _ in range(3)]
    truth = dict(zip(described.space.names, theta, strict=True))
    result: dict[str, Any] = {"combinations": [[c.text for c in one.found.combinations] for one in found]}
    for name in FRICTION:
        of = [one.parameters[name] for one in found]
        known = [p.interval for p in of if p.verdict == "identified"]
        result[name] = {
            "verdicts": [p.verdict for p in of],
            "error": [p.estimate / truth[name] - 1.0 for p in of],
            "sd": [p.sd / p.estimate for p in of],
            "held": [bool(p.interval[0] <= truth[name] <= p.interval[1]) for p in of],
            "contradict": any(a[1] < b[0] or b[1] < a[0] for a, b in itertools.combinations(known, 2)),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--quick", action="store_true", help="2 seeds")
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    seeds = 2 if arguments.quick else arguments.seeds
    results = over_seeds("friction-split", trial, range(seeds), arguments.processes)
    lines = []
    for name in FRICTION:
        of = [r[name] for r in results]
        verdicts = [v for one in of for v in one["verdicts"]]
        lines.append(
            (
                name,
                f"{np.std([e for one in of for e in one['error']]):.1%}",
                f"{np.median([s for one in of for s in one['sd']]):.1%}",
                f"{np.mean([h for one in of for h in one['held']]):.0%}",
                ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts)),
                str(sum(one["contradict"] for one in of)),
            )
        )
    together = sum(
        any("viscous" in t and "coulomb" in t for t in c) for r in results for c in r["combinations"]
    )
    show(
        f"Three runs at one speed, {seeds} seeds: a combination of both is named in {together} of "
        f"{3 * seeds} runs (goal: no contradiction)",
        ("friction", "error, sd", "claimed sd", "held", "verdicts", "seeds in which runs contradict"),
        lines,
    )


if __name__ == "__main__":
    main()
