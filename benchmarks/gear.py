"""Geared servos whose friction grows with load: is it found, and is its absence said?

    python benchmarks/gear.py [--seeds 20] [--jobs 2] [--quick]
    python benchmarks/gear.py --cost

A servo swings a load. Its plant has friction of the model M5 (arXiv 2410.08650), set before each step by ten
lines of Python that share nothing with the package's engines. Each log is identified three times:

    M5         the numbers of its friction are parameters, and the rest of the model was measured
    geared     friction is constant in the model, which says that the joint has a gear
    constant   friction is constant in the model, and nothing is said

With M5, 86 to 94 % of the 90 % intervals must hold, and errors must be at most 1.2 times the sd that noise
and priors alone give (the Cramer-Rao bound). With constant friction no load may be called identified beyond
its interval, and friction that grows with load must be among the reasons, and first of what the model lacks.

`--cost` times rollouts of 400 steps with and without friction of gears (goal: at most 1.3 times as long): of
this servo, and of an arm of six joints.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections import Counter
from functools import partial
from typing import Any

import mujoco
import numpy as np
from common import PROJECT, over_seeds, paired, seeds_of, show
from plants import SMALL, Case, Plant, multisine, noisy, record

import amhe_cli as amhe
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.engine.open import open_engine

KINDS = (M5, GEARED, CONSTANT) = ("M5", "geared", "constant")
NOISE = 0.002
#: What is unknown of the drive: nominal value, prior sd, bounds of what is linear, target.
PLAIN: dict[str, tuple[float, float, Any, dict[str, str]]] = {
    "mass": (0.5, 0.5, None, {"body": "load", "set": "mass"}),
    "damping": (0.08, 0.5, None, {"joint": "hinge", "set": "damping"}),
    "friction": (0.06, 0.5, None, {"joint": "hinge", "set": "friction_loss"}),
    "armature": (0.012, 0.5, None, {"joint": "hinge", "set": "armature"}),
}
GEAR: dict[str, tuple[float, float, Any, dict[str, str]]] = {
    "load_friction_motor": (0.10, 0.05, [-0.4, 0.6], {"joint": "hinge", "set": "load_friction_motor"}),
    "load_friction_external": (0.15, 0.05, [-0.4, 0.7], {"joint": "hinge", "set": "load_friction_external"}),
    "stribeck_friction": (0.10, 0.04, [-0.3, 0.5], {"joint": "hinge", "set": "stribeck_friction"}),
    "stribeck_velocity": (0.3, 0.5, None, {"joint": "hinge", "set": "stribeck_velocity"}),
}


def swing(mass: float, damping: float, friction: float, armature: float, **_: float) -> str:
    """A load at the end of a rod, on a position servo."""
    joint = f'axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="{armature}"'
    return f"""<mujoco><option timestep="0.002"/><worldbody><body><joint name="hinge" {joint}/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" mass="0.1" contype="0" conaffinity="0"/>
      <body name="load" pos="0 0 -0.4"><geom size="0.04" mass="{mass}" contype="0" conaffinity="0"/></body>
      </body></worldbody>
      <actuator><position name="servo" joint="hinge" kp="15" kv="0.2"/></actuator></mujoco>"""


def case(rng: np.random.Generator, kind: str) -> Case:
    """The user's system, a log of the plant, and the truth."""
    truth = {
        name: nominal * np.exp(0.5 * sd * rng.standard_normal()) for name, (nominal, sd, *_) in PLAIN.items()
    }
    for name, (nominal, sd, bounds, _) in GEAR.items():
        drawn = sd * rng.standard_normal()
        truth[name] = nominal * np.exp(0.5 * drawn) if bounds is None else nominal + drawn

    def hold(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        mujoco.mj_forward(model, data)
        motor, load = data.qfrc_actuator[0], data.qfrc_smooth[0] - data.qfrc_actuator[0] - data.qfrc_damper[0]
        slow = np.exp(-abs(data.qvel[0]) / truth["stribeck_velocity"])
        under_load = abs(truth["load_friction_external"] * load - truth["load_friction_motor"] * motor)
        held = truth["friction"] + under_load + slow * truth["stribeck_friction"]
        model.dof_frictionloss[0] = max(held, 0.0)

    made = record(Plant(swing(**truth), before=hold), multisine(rng, [1.2], 2.5), ["hinge"], 12.0)
    entries = PLAIN | GEAR if kind == M5 else PLAIN
    identify: dict[str, Any] = {"geared": ["hinge"]} if kind == GEARED else {}
    identify |= {"assumed": AssumedSettings.model_validate(0).model_dump()} if kind == M5 else {}
    system = amhe.System.from_model(
        mujoco.MjSpec.from_string(swing(**{name: nominal for name, (nominal, *_) in PLAIN.items()})),
        parameters={
            name: {"nominal": nominal, "prior_sd": sd, "targets": [target]}
            | ({"bounds": bounds} if bounds else {})
            for name, (nominal, sd, bounds, target) in entries.items()
        },
        signals={
            "joints": {"joints": ["hinge"], "noise": {"position": NOISE}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        settings=SMALL | {"identify": identify},
        name="servo",
        warn=False,
    )
    arrays = {
        "joints": {"time": made.time, "position": noisy(rng, made.joints, NOISE)},
        "command": {"time": made.time, "position": made.commands},
    }
    return Case(system, (amhe.Log.from_arrays(arrays, system, name="log"),), truth)


def trial(number: int) -> dict[str, Any]:
    """Identify one log, as a user would."""
    logging.disable(logging.WARNING)
    seed, of_kind = divmod(number, len(KINDS))
    kind = KINDS[of_kind]
    made = case(np.random.default_rng([seed, 35]), kind)  # the same plant and log for each kind
    began = time.process_time()
    result = amhe.identify(made.system, made.logs, seed=seed, threads=1)
    spreads = dict(zip(result.belief.names, np.sqrt(np.diag(result.belief.covariance)), strict=True))
    parameters = []
    for space, p in zip(made.system.space.parameters, result.parameters.values(), strict=True):
        truth = made.truth[p.name]
        error = np.log(p.estimate / truth) if space.log else p.estimate - truth
        share = p.budget.get("noise", 0.0) + p.budget.get("prior", 0.0)  # what any estimate owes to the data
        because = " ".join(reason.text for reason in p.reasons) + (p.given or "")
        parameters.append(
            {
                "name": p.name,
                "over_bound": float(error / (spreads[p.name] * np.sqrt(share))),
                "held": bool(p.lower <= truth <= p.upper),
                "verdict": p.verdict,
                "named": "constant friction of hinge" in because,
                "assumed": float(p.budget.get("assumed", 0.0)),
            }
        )
    lacks = result.found.missing.rows if result.found.missing else ()
    cause = lacks[0].name if lacks else ""  # the first that `identify` names of what the model has not
    taken = time.process_time() - began
    return {"kind": kind, "cpu_seconds": taken, "parameters": parameters, "cause": cause}


def row(label: str, trials: list[dict[str, Any]], name: str | None = None) -> tuple[str, ...]:
    """One line of the table, over the parameters of some trials, or over one of them."""
    by_log = [[p for p in t["parameters"] if name in (None, p["name"])] for t in trials]
    parameters = [p for one in by_log for p in one]
    claimed = [p for p in parameters if p["verdict"] in ("identified", "conditional")]
    plain = [p for p in parameters if p["verdict"] == "identified"]
    over = np.sqrt(np.mean([p["over_bound"] ** 2 for p in parameters]))
    seconds = sorted(t["cpu_seconds"] for t in trials)
    return (
        label,
        name or "all",
        f"{np.mean([p['held'] for p in parameters]):.0%}",
        f"{over:.2f}",
        f"{sum(not p['held'] for p in plain)} of {len(plain)}",
        f"{sum(p['held'] for p in claimed)} of {len(claimed)}",
        f"{sum(any(p['named'] for p in one) for one in by_log)} of {len(trials)}",
        f"{sum(t['cause'].startswith('load-friction') for t in trials)} of {len(trials)}",
        ", ".join(f"{v} {n}" for v, n in Counter(p["verdict"] for p in parameters).most_common(3)),
        f"{seconds[len(seconds) // 2]:.1f} s",
    )


def cost(repetitions: int = 15) -> None:
    """The time that friction of gears takes: the same candidates, states and commands, in turns."""
    arm = (PROJECT / "examples" / "systems" / "so101" / "scene.xml").read_text()
    nominal = swing(**{name: value for name, (value, *_) in PLAIN.items()})
    rows, rng = [], np.random.default_rng(0)
    for name, xml in (("servo", nominal), ("arm of six joints", arm)):
        spec = mujoco.MjSpec.from_string(xml)
        joints, servos = ([one.name for one in some] for some in (spec.joints, spec.actuators))
        numbers = "".join(
            f'<numeric name="gear_friction/{joint}" data="0.1 0.15 0.1 0.3 1 0 0 0"/>' for joint in joints
        )
        systems = [
            amhe.System.from_model(
                mujoco.MjSpec.from_string(xml.replace("</mujoco>", f"<custom>{more}</custom></mujoco>")),
                parameters={
                    "damping": {"nominal": 0.05, "targets": [{"joint": joints[0], "set": "damping"}]}
                },
                signals={
                    "joints": {"joints": joints, "noise": {"position": NOISE}},
                    "command": {"actuators": servos, "quantity": "position"},
                },
                warn=False,
            )
            for more in ("", numbers)
        ]
        for count in (32, 192, 768):
            width, steps = systems[0].model.nv, 400
            inputs = np.cumsum(rng.normal(0.0, 0.01, (count, steps, systems[0].model.nu)), axis=1)
            given = 0.05 * np.ones((count, 1)), np.zeros((count, width)), np.zeros((count, width)), inputs
            plain, geared = (
                partial(open_engine(system, threads=1).rollout, *given, np.full(count, steps))
                for system in systems
            )
            alone, _, ratio = paired(plain, geared, repetitions)
            rows.append((name, str(count), f"{1e6 * alone / count / steps:.1f} us", f"{ratio:.2f}"))
    show("friction of gears: time over a plain rollout", ("model", "rollouts", "a plain step", "ratio"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(20), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--cost", action="store_true", help="what it costs, not what it finds")
    given = parser.parse_args()
    if given.cost:
        cost()
        return
    seeds = range(1) if given.quick else given.seeds
    done = over_seeds(
        "gear", trial, [seed * len(KINDS) + i for seed in seeds for i in range(len(KINDS))], given.jobs
    )
    by_kind = {kind: [t for t in done if t["kind"] == kind] for kind in KINDS}
    columns = ("model", "of", "intervals hold", "error over bound", "identified, outside", "claimed, hold")
    show(
        f"geared servos, {len(seeds)} seeds",
        (*columns, "logs with gear friction a reason", "the first cause", "verdicts", "CPU"),
        [row(kind, trials, name) for kind, trials in by_kind.items() for name in (None, "mass")],
    )


if __name__ == "__main__":
    main()
