"""`amhe audit` on simulated robots whose model files have spoilt numbers: which are found, and at what cost.

    python benchmarks/audit.py [--seeds 10] [--jobs 2] [--robots arm3 torque7 ...] [--seconds 60] [--part 1/3]

A robot's own numbers are drawn from what its data sheets leave open. Its file has those of the data sheets,
but for 1 to 4 that are spoilt: a mass times 0.5, 2 or 3, a damping times 10, no armature, a centre of mass
5 cm off, a gain times 0.3. Other robots are paths of MJCF files, without free joints, or names of the MuJoCo
Menagerie, which is downloaded: encoders and measured torques of all joints, whose efforts are matched.

arm3      three position servos, encoders and commands; the motion is matched
pendulum  two torque motors, encoders and commands; the motion is matched
servo7    seven position servos, encoders and commands; the motion is matched
torque7   seven joints, encoders and measured torques; the efforts are matched
"""

from __future__ import annotations

import argparse
import functools
import logging
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import PROJECT, add_parts, in_parts, seeds_of, show
from effort import TORQUE, arm, motion

from amhe_cli.audit.audit import audit
from amhe_cli.audit.claims import Claim, claims_of
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings
from amhe_cli.engine.inverse import forces_along
from amhe_cli.estimation.identification import IdentifyOptions
from amhe_cli.init.folder import proposed
from amhe_cli.logs import read_log

#: Noise of encoders [rad], delay of commands [s], rows of a log per second.
NOISE, LATE, HZ = 3e-4, 0.008, 100
#: Noise of measured torques, as a share of what the motion needs.
SHARE = 0.01
#: A number is within reach where the truth is so many sd away, of the log and the data sheet together.
TOLD = 4.0
#: Stiffness of the servos of seven joints [N m/rad].
SERVOS = (400.0, 400.0, 300.0, 300.0, 100.0, 100.0, 50.0)
FILES = {
    "arm3": PROJECT / "examples" / "logs" / "arm.xml",
    "pendulum": PROJECT / "examples" / "systems" / "double_pendulum" / "model.xml",
}


def spec_of(robot: str) -> mujoco.MjSpec:
    """The robot as its data sheets have it."""
    if robot == "torque7":
        return arm()
    if robot == "servo7":
        spec = arm()
        spec.option.timestep = 0.002
        for joint, kp in zip(spec.joints, SERVOS, strict=True):
            servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            servo.set_to_position(kp=kp, kv=0.05 * kp)
        return spec
    if robot in FILES:
        return mujoco.MjSpec.from_file(str(FILES[robot]))
    if robot.endswith(".xml"):
        return mujoco.MjSpec.from_file(robot)
    from amhe_cli.init.sources import menagerie_model

    return mujoco.MjSpec.from_file(str(menagerie_model(robot)))


def recorded(
    robot: str, truth: mujoco.MjModel, seconds: float, rng: np.random.Generator
) -> tuple[list[str], FloatArray]:
    """A table: names of the columns, and rows."""
    times = np.arange(0.0, seconds, 1.0 / HZ)
    joints = [truth.joint(j).name for j in range(truth.njnt)]
    if robot not in (*FILES, "servo7"):
        position, speed, acceleration = motion(rng, times, truth.nv)
        needed = forces_along(truth, position, speed, acceleration).needed
        tau = needed + truth.dof_frictionloss * np.sign(speed)
        position = position + NOISE * rng.standard_normal(tau.shape)
        noise = 0.3 * TORQUE if robot == "torque7" else SHARE * np.sqrt((tau**2).mean(axis=0))
        effort = tau + noise * rng.standard_normal(tau.shape)
        return [f"{kind}_{j}" for kind in ("position", "effort") for j in joints], np.column_stack(
            (times, position, effort)
        )
    commands = targets(truth, times, rng)
    data, per_row = mujoco.MjData(truth), round(1.0 / HZ / truth.opt.timestep)
    late, rows = round(LATE / truth.opt.timestep), []
    for step in range(len(times) * per_row):
        if step % per_row == 0:
            rows.append(data.qpos + NOISE * rng.standard_normal(truth.nq))
        data.ctrl[:] = commands[max(0, step - late) // per_row]
        mujoco.mj_step(truth, data)
    kind = "command_position" if truth.actuator_biastype.any() else "command_effort"
    names = [f"position_{j}" for j in joints] + [f"{kind}_{truth.actuator(a).name}" for a in range(truth.nu)]
    return names, np.column_stack((times, np.array(rows), commands))


def targets(model: mujoco.MjModel, times: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Commands (T, nu): sums of sines of 0.1 to 3 Hz; of motors torques that move the joints well."""
    w = 2.0 * np.pi * np.geomspace(0.1, 3.0, 8)[:, None, None]
    size = rng.uniform(0.5, 1.0, (8, 1, model.nu)) / (1.0 + w / 3.0)
    waves = (size * np.sin(w * times[:, None] + rng.uniform(0.0, 2.0 * np.pi, (8, 1, model.nu)))).sum(axis=0)
    if not model.actuator_biastype.any():
        return 1.2 * waves
    return 0.5 * waves * np.minimum(1.0, times)[:, None]


def spoilt(claims: list[Claim], rng: np.random.Generator) -> dict[str, float]:
    """Parameter -> what the file says in place of the data sheet."""
    number = int(rng.integers(1, 5))
    found: dict[str, float] = {}
    for i in rng.permutation(len(claims)):
        claim = claims[i]
        wrong = {
            "mass": claim.value * float(rng.choice([0.5, 2.0, 3.0])),
            "damping": 10.0 * claim.value,
            "armature": 0.0,
            "center_of_mass": claim.value + 0.05 * float(rng.choice([-1.0, 1.0])),
            "gain": 0.3 * claim.value,
        }.get(claim.number.kind)
        if wrong is not None and wrong != claim.value and len(found) < number:
            found[claim.parameter] = wrong
    return found


def written(model: mujoco.MjModel, spec: mujoco.MjSpec, claims: list[Claim], values: dict[str, float]) -> str:
    """The robot's file with other numbers."""
    from amhe_cli.system.export.mjcf import identified_xml
    from amhe_cli.system.system import System

    chosen = [c for c in claims if c.parameter in values]
    entries = {
        c.parameter: replace(
            c, nominal=max(values[c.parameter] / c.factor, 1e-12) if c.log else values[c.parameter]
        )
        .guess(False)
        .entry
        for c in chosen
    }
    for c in chosen:
        entries[c.parameter] |= {
            "bounds": [-1e3 if c.number.kind == "center_of_mass" else (0.0 if not c.log else 1e-13), 1e6]
        }
        if not c.log and c.number.kind != "center_of_mass":
            entries[c.parameter]["nominal"] = max(values[c.parameter], 1e-12)
    joints = [model.joint(j).name for j in range(model.njnt)]
    system = System.from_model(
        spec,
        parameters=entries,
        signals={"joints": {"joints": joints, "noise": {"position": 0.01}}},
        warn=False,
    )
    theta = np.array(
        [values[name] / next(c.factor for c in chosen if c.parameter == name) for name in system.space.names]
    )
    return identified_xml(system, theta)


def trial(number: int, robots: list[str], seconds: float) -> dict[str, Any]:
    """Spoil a file, record its robot, and audit it."""
    logging.disable(logging.WARNING)
    seed, place = divmod(number, len(robots))
    robot = robots[place]
    rng = np.random.default_rng([seed, *Path(robot).stem.encode()])
    spec = spec_of(robot)
    model = spec.compile()
    with tempfile.TemporaryDirectory() as name:
        file, log = Path(name) / "robot.xml", Path(name) / "log.csv"
        names, table = recorded(robot, model, 1.0, rng)
        save(log, names, table)
        sheet = Path(name) / "sheet.xml"
        sheet.write_text(spec.to_xml(), encoding="utf-8")
        claims = claims_of(proposed(sheet, [log], efforts=True), AssumedSettings())
        drawn = {
            c.parameter: c.value * np.exp(c.sd * rng.standard_normal())
            if c.log
            else c.value + c.sd * rng.standard_normal()
            for c in claims
        }
        drawn = {
            c.parameter: abs(drawn[c.parameter]) if c.number.kind != "center_of_mass" else drawn[c.parameter]
            for c in claims
        }
        truth = mujoco.MjModel.from_xml_string(written(model, spec, claims, drawn))
        save(log, *recorded(robot, truth, seconds, rng))
        wrong = spoilt(claims, rng)
        file.write_text(written(model, spec, claims, wrong), encoding="utf-8")
        begun = time.process_time()
        found = audit(
            proposed(file, [log], efforts=True),
            robot,
            lambda s: read_log([log], s),
            IdentifyOptions(threads=1),
        )
        spent = time.process_time() - begun
    said = {line.parameter: line for line in found.lines}
    told, hit = [], []
    for name in wrong:
        line = said[name]
        claim = next(c for c in found.claims if c.parameter == name)
        # on the scale of the test; a log that says nothing may say a logarithm of minus infinity
        sd = (line.sd / line.log if line.log else np.inf) if claim.log else line.sd
        sd = np.hypot(sd, claim.sd)
        told.append(bool(abs(claim.phi(float(drawn[name])) - claim.phi(line.file)) > TOLD * sd))
        hit.append(line.verdict == "contradicted")
    false = [
        line.parameter
        for line in found.lines
        if line.verdict == "contradicted" and line.parameter not in wrong
    ]
    return {
        "robot": Path(robot).stem,
        "wrong": {n: [v, float(drawn[n]), said[n].log, said[n].sd] for n, v in wrong.items()},
        "told": told, "hit": hit, "false": false, "cpu_seconds": spent, "numbers": len(found.lines),
        "missed": [one.text for one in found.found.unexplained],
        "right": [line.t for name, line in said.items() if name not in wrong and line.sd < abs(line.file)],
    }  # fmt: skip


def save(path: Path, names: list[str], table: FloatArray) -> None:
    np.savetxt(path, table, fmt="%.6g", delimiter=",", header=",".join(("time", *names)), comments="")


def main() -> None:
    parser = argparse.ArgumentParser(description="amhe audit on files with spoilt numbers.")
    parser.add_argument("--seeds", type=seeds_of, default=range(10), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--robots", nargs="+", default=["arm3", "pendulum", "torque7"])
    add_parts(parser)
    options = parser.parse_args()
    one = functools.partial(trial, robots=options.robots, seconds=options.seconds)
    numbers = [seed * len(options.robots) + i for seed in options.seeds for i in range(len(options.robots))]
    of = "-".join(Path(robot).stem for robot in options.robots)
    done = in_parts(f"audit-{of}-{options.seconds:g}", one, numbers, options)
    robots = dict.fromkeys(one["robot"] for one in done)
    rows = [row(robot, [one for one in done if one["robot"] == robot]) for robot in robots]
    rows.append(row("all", done))
    show(
        "Spoilt numbers of model files",
        (
            "robot",
            "spoilt",
            "within reach",
            "found of these (>= 90 %)",
            "tables with a false one (<= 5 %)",
            "sd of t of right numbers",
            "CPU s (<= 60)",
        ),
        rows,
    )


def row(robot: str, some: list[dict[str, Any]]) -> tuple[str, ...]:
    told = sum(sum(one["told"]) for one in some)
    hits = sum(t and h for one in some for t, h in zip(one["told"], one["hit"], strict=True))
    false = sum(bool(one["false"]) for one in some)
    spoilt_ = sum(len(one["told"]) for one in some)
    return (
        robot, str(spoilt_), str(told), f"{hits / max(told, 1):.0%}", f"{false} of {len(some)}",
        f"{np.std([t for one in some for t in one['right']]):.2f}",
        f"{np.median([one['cpu_seconds'] for one in some]):.0f}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
