"""Does `explain` name what a model lacks, or what is wrong with a log?

    python benchmarks/missing.py [--seeds 3] [--jobs 2] [--systems swing] [--faults spring,delay] [--pairs]
                                 [--every 1] [--identify] [--repair] [--verbose] [--part 1/3] [--add FILE...]

Faults are put into five simulated robots, whose positions have noise: one at a time, or with `--pairs` two.
A user's model lacks them, and its masses, damping or friction are unknown. The first row must name a fault
and its place in 90 %. Of pairs, the faults that any row names are counted too. With `--identify` the model is
identified first, as by `amhe identify`: logs that it misses by no more than twice their noise are then not
explained, and of faultless ones nothing may be named in 95 %. With `--repair` the faults that are numbers of
a model are repaired, as by `amhe identify --repair`: the error of held-out clips must be within 10 % of that
of a model whose user knew the cause, if not its size. Each trial is printed as it ends; of many parts, each
run by itself, `--add` takes what their runs have printed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from common import add_parts, in_parts, seeds_of, show

import amhe_cli as amhe
from amhe_cli.api.compare import scored
from amhe_cli.core.arrays import FloatArray
from amhe_cli.estimation.core.result import Missing
from amhe_cli.estimation.explain.explain import explain
from amhe_cli.estimation.offline.clips import split_held_out, whole

#: Time between two samples and two commands [s], length of a log [s], noise of positions [rad or m].
PERIOD, SECONDS, NOISE = 0.01, 16.0, 5e-4
RIGHT_GOAL, NOTHING_GOAL, REPAIR_GOAL = 0.90, 0.95, 1.10


@dataclass(frozen=True)
class Robot:
    """A robot as its user models it.

    Args:
        xml: Its MJCF; {idle} takes an actuator that nothing commands.
        joints: Its joints, those with a drive first.
        sizes: Size of the commands of each drive.
        servo: Drives are position servos.
        free: Unknown parameters -> target and nominal value.
        typical: Usual force of the first drive's joint.
    """

    xml: str
    joints: Sequence[str]
    sizes: Sequence[float]
    servo: bool
    free: Mapping[str, tuple[dict[str, Any], float]]
    typical: float
    highest: float = 2.0


def _mjcf(bodies: str, actuators: str) -> str:
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody>{bodies}</worldbody>
      <actuator>{actuators}{{idle}}</actuator></mujoco>"""


ROBOTS: Mapping[str, Robot] = {
    "swing": Robot(
        _mjcf(
            """<body><joint name="hinge" axis="0 1 0" damping="0.12" armature="0.004"/>
            <geom type="capsule" fromto="0 0 0 0.03 0 -0.3" size="0.01" mass="0.1"/>
            <body name="load" pos="0.05 0 -0.3"><geom size="0.04" mass="0.4"/></body></body>""",
            '<motor name="motor" joint="hinge"/>',
        ),
        ["hinge"], [0.5], False,
        {"mass": ({"body": "load", "set": "mass"}, 0.4),
         "damping": ({"joint": "hinge", "set": "damping"}, 0.12)},
        0.6,
    ),
    "servos": Robot(
        _mjcf(
            """<body><joint name="shoulder" axis="0 1 0" damping="0.3" frictionloss="0.1" armature="0.02"/>
            <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
            <body pos="0.3 0 0">
            <joint name="elbow" axis="0 1 0" damping="0.2" frictionloss="0.1" armature="0.01"/>
            <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.5"/>
            <body name="payload" pos="0.25 0 0"><geom size="0.04" mass="0.6"/></body></body></body>""",
            """<position name="shoulder" joint="shoulder" kp="60" kv="3"/>
            <position name="elbow" joint="elbow" kp="25" kv="1"/>""",
        ),
        ["shoulder", "elbow"], [0.7, 0.9], True,
        {"payload": ({"body": "payload", "set": "mass"}, 0.6),
         "friction": ({"joint": "*", "set": "friction_loss"}, 0.1)},
        8.0,
    ),
    "cart": Robot(
        _mjcf(
            """<body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="0.8"/>
            <geom type="box" size="0.1 0.05 0.05" mass="1"/>
            <body name="pole"><joint name="pole" axis="0 1 0" damping="0.02"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" mass="0.2"/></body></body>""",
            '<position name="rail" joint="rail" kp="40" kv="6"/>',
        ),
        ["rail", "pole"], [0.3], True,
        {"cart": ({"body": "cart", "set": "mass"}, 1.0), "pole": ({"body": "pole", "set": "mass"}, 0.2)},
        8.0, 1.5,
    ),
    "torques": Robot(
        _mjcf(
            """<body><joint name="base" axis="0 0 1" damping="0.1" armature="0.02"/>
            <geom size="0.05" mass="1"/><body><joint name="lift" axis="0 1 0" damping="0.1" armature="0.02"/>
            <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.8"/>
            <body name="tool" pos="0.3 0 0"><joint name="wrist" axis="0 1 0" damping="0.05" armature="0.005"/>
            <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.02" mass="0.4"/></body></body></body>""",
            """<general name="base" joint="base" gainprm="8" biastype="affine" biasprm="0 -8 -1.5"/>
            <general name="lift" joint="lift" gainprm="30" biastype="affine" biasprm="0 -30 -2"/>
            <general name="wrist" joint="wrist" gainprm="6" biastype="affine" biasprm="0 -6 -0.4"/>""",
        ),
        ["base", "lift", "wrist"], [0.9, 0.7, 0.9], True,
        {"tool": ({"body": "tool", "set": "mass"}, 0.4), "damping": ({"joint": "*", "set": "damping"}, 0.1)},
        3.0,
    ),
    "furuta": Robot(
        _mjcf(
            """<body><joint name="arm" axis="0 0 1" damping="0.01" armature="0.001"/>
            <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.008" mass="0.1"/>
            <body pos="0.2 0 0" name="pendulum"><joint name="pendulum" axis="1 0 0" damping="0.0005"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.006" mass="0.08"/></body></body>""",
            '<position name="motor" joint="arm" kp="0.25" kv="0.02"/>',
        ),
        ["arm", "pendulum"], [0.9], True,
        {"mass": ({"body": "pendulum", "set": "mass"}, 0.08),
         "damping": ({"joint": "arm", "set": "damping"}, 0.01)},
        0.15, 2.5,
    ),
}  # fmt: skip


# -- faults ------------------------------------------------------------------------------------------------


@dataclass
class Trial:
    """One robot with faults, while it is simulated and logged."""

    robot: Robot
    rng: np.random.Generator
    model: mujoco.MjModel
    forces: list[Callable[[mujoco.MjData], None]] = field(default_factory=list)
    logs: list[Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]] = field(
        default_factory=list
    )
    idle: str = ""
    delay: float = 0.0
    clip: float = np.inf

    def force(self, joint: str, of: Callable[[float, float, float], float]) -> None:
        """Add a force on a joint, of its position and speed, and of time."""
        row = int(self.model.joint(joint).dofadr[0])

        def act(data: mujoco.MjData) -> None:
            data.qfrc_applied[row] += of(data.qpos[row], data.qvel[row], data.time)

        self.forces.append(act)


def _turns(robot: Robot) -> bool:
    return robot.joints[0] != "rail"


def _two(robot: Robot) -> bool:
    return len(robot.sizes) > 1


def _size(trial: Trial, joint: str, share: float) -> float:
    """A force that is a share of what usually acts on a joint, drawn within 30 %."""
    usual = trial.robot.typical * (1.0 if joint == trial.robot.joints[0] else 0.4)
    return float(share * usual * trial.rng.uniform(0.8, 1.3))


def _drive(trial: Trial) -> str:
    return trial.robot.joints[int(trial.rng.integers(len(trial.robot.sizes)))]


def _joint_force(share: float, of: Callable[[float, float, float], float]) -> Callable[[Trial], str]:
    def put(trial: Trial) -> str:
        joint = _drive(trial)
        size = _size(trial, joint, share)
        trial.force(joint, lambda q, v, t: size * of(q, v, t))
        return joint

    return put


def _log_fault(change: Callable[[FloatArray, FloatArray, int], tuple[FloatArray, FloatArray]]):  # type: ignore[no-untyped-def]
    def put(trial: Trial) -> str:
        joint = _drive(trial)
        column = list(trial.robot.joints).index(joint)
        trial.logs.append(lambda q, u: change(q, u, column))
        return joint

    return put


def _scaled(values: FloatArray, column: int, factor: float) -> FloatArray:
    found = values.copy()
    found[:, column] *= factor
    return found


def _swapped(values: FloatArray) -> FloatArray:
    found = values.copy()
    found[:, [0, 1]] = found[:, [1, 0]]
    return found


def _swap(of_joints: bool) -> Callable[[Trial], str]:
    def put(trial: Trial) -> str:
        trial.logs.append(lambda q, u: (_swapped(q), u) if of_joints else (q, _swapped(u)))
        return ", ".join(trial.robot.joints[:2])

    return put


def _idle(trial: Trial) -> str:
    joint = trial.robot.joints[-1]
    stiff = 1.5 * _size(trial, joint, 1.0)
    trial.idle = f'<position name="idle" joint="{joint}" kp="{stiff:.3g}"/>'
    return "idle"


def _load_friction(trial: Trial) -> str:
    joint = _drive(trial)
    row, share = int(trial.model.joint(joint).dofadr[0]), trial.rng.uniform(0.15, 0.3)

    def act(data: mujoco.MjData) -> None:
        data.qfrc_applied[row] -= share * abs(data.qfrc_actuator[row]) * np.tanh(data.qvel[row] / 0.02)

    trial.forces.append(act)
    return joint


def _armature(trial: Trial) -> str:
    joint = _drive(trial)
    row, data = int(trial.model.joint(joint).dofadr[0]), mujoco.MjData(trial.model)
    mujoco.mj_forward(trial.model, data)
    mass = np.zeros((trial.model.nv, trial.model.nv))
    mujoco.mj_fullM(trial.model, data, mass)
    trial.model.dof_armature[row] += mass[row, row] * trial.rng.uniform(0.3, 0.6)
    return joint


def _delay(trial: Trial) -> str:
    trial.delay = trial.rng.uniform(0.012, 0.03)
    return "commands"


def _clip(trial: Trial) -> str:
    trial.clip = trial.rng.uniform(0.4, 0.6)
    return trial.robot.joints[0]


def _coupling(trial: Trial) -> str:
    joint, other = trial.robot.joints[:2]
    driven = len(trial.robot.sizes) > 1
    size = _size(trial, joint, 0.5 if driven else 0.05)
    row = int(trial.model.joint(other).dofadr[0])
    own = int(trial.model.joint(joint).dofadr[0])

    def act(data: mujoco.MjData) -> None:
        data.qfrc_applied[own] += size * data.qpos[row]
        if not driven:  # a spring between the two: what nothing drives feels what it does
            data.qfrc_applied[row] += size * data.qpos[own]

    trial.forces.append(act)
    return joint


#: Fault -> how it is put into a trial, which returns its place; kinds of rows that name it; and robots that
#: can have it (None: all).
FAULTS: Mapping[str, tuple[Callable[[Trial], str], tuple[str, ...], Callable[[Robot], bool] | None]] = {
    "joint sign": (_log_fault(lambda q, u, k: (_scaled(q, k, -1.0), u)), ("joint sign", "command"), None),
    "command sign": (_log_fault(lambda q, u, k: (q, _scaled(u, k, -1.0))), ("command", "joint sign"), None),
    "swapped joints": (_swap(True), ("swapped joints",), _two),
    "swapped commands": (_swap(False), ("exchanged",), _two),
    "degrees": (_log_fault(lambda q, u, k: (_scaled(q, k, 180 / np.pi), u)), ("unit",), _turns),
    "thousandths": (_log_fault(lambda q, u, k: (q, _scaled(u, k, 1e3))), ("unit", "command"), None),
    "delay": (_delay, ("delay",), None),
    "force limit": (_clip, ("force limit", "servo limit"), None),  # of a servo both are the same
    "idle actuator": (_idle, ("idle actuator", "spring"), None),
    "constant": (_joint_force(0.4, lambda q, v, t: 1.0), ("constant",), None),
    "spring": (_joint_force(0.6, lambda q, v, t: -(q - 0.2)), ("spring",), None),
    "sine": (_joint_force(0.6, lambda q, v, t: np.sin(q + 0.8)), ("sine",), _turns),
    "viscous": (_joint_force(0.3, lambda q, v, t: -v), ("viscous",), lambda r: "damping" not in r.free),
    "dry": (_joint_force(0.25, lambda q, v, t: -np.tanh(v / 0.01)), ("dry",),
            lambda r: "friction" not in r.free),
    "quadratic": (_joint_force(0.2, lambda q, v, t: -v * abs(v)), ("quadratic",), None),
    "load friction": (_load_friction, ("load friction",), None),
    "armature": (_armature, ("armature",), _turns),  # of a cart it is mass, which is free
    "coupling": (_coupling, ("coupling",), lambda r: len(r.joints) > 1),
    "cogging": (_joint_force(0.3, lambda q, v, t: np.sin(12 * q + 0.5)), ("cogging",), _turns),
    "periodic": (_joint_force(0.4, lambda q, v, t: np.sin(2 * np.pi * 1.13 * t)), ("periodic",), None),
}  # fmt: skip

#: Two of these on one joint are one force: a spring about elsewhere, or another one.
ONE = {"constant", "spring", "idle actuator"}


# -- one trial ---------------------------------------------------------------------------------------------


def simulated(trial: Trial) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), positions (n, k) and commands (n, m) of one log."""
    model, robot = trial.model, trial.robot
    data, every = mujoco.MjData(model), round(PERIOD / model.opt.timestep)
    steps, drives = round(SECONDS / model.opt.timestep), len(robot.sizes)
    hertz = np.geomspace(0.15, robot.highest, 7)
    phase = trial.rng.uniform(0.0, 2.0 * np.pi, (drives, hertz.size))
    scale = 0.6 * np.array(robot.sizes)[:, None] / np.sqrt(hertz / hertz[0])
    if not robot.servo:
        scale = np.broadcast_to(0.5 * np.array(robot.sizes)[:, None], phase.shape)
    times = np.arange(0, steps, every) * model.opt.timestep
    wave = np.sin(2.0 * np.pi * hertz[:, None] * times + phase[..., None]) - np.sin(phase)[..., None]
    commands = (scale[..., None] * wave).sum(axis=1).T  # (n, m)
    usual = np.abs(commands).max(axis=0)
    q, late = np.empty((times.size, model.nq)), round(trial.delay / model.opt.timestep)
    limit = trial.clip * robot.typical if robot.servo else trial.clip * usual[0]
    if np.isfinite(trial.clip):
        model.actuator_forcelimited[0], model.actuator_forcerange[0] = 1, (-limit, limit)
    for k in range(steps):
        if k % every == 0:
            q[k // every] = data.qpos
        data.ctrl[:drives] = commands[max(0, k - late) // every]
        data.qfrc_applied[:] = 0.0
        for act in trial.forces:
            act(data)
        mujoco.mj_step(model, data)
    return times, q, commands


def case(robot: Robot, faults: Sequence[str], rng: np.random.Generator):  # type: ignore[no-untyped-def]
    """The user's system, the arrays of a log with faults, their places, and how far the robot moved."""
    plain = robot.xml.replace("{idle}", "")
    spec = mujoco.MjSpec.from_string(plain)
    trial = Trial(robot, rng, spec.compile())
    truth = {}
    for name, (_, nominal) in robot.free.items():  # the truth is near the prior
        truth[name] = nominal * np.exp(0.3 * rng.standard_normal())
    system = amhe.System.from_model(mujoco.MjSpec.from_string(plain), **_described(robot, plain), warn=False)
    theta = np.array([truth[name] for name in system.space.names])
    trial.model = system.edits.apply(spec.compile(), theta)
    places = [FAULTS[fault][0](trial) for fault in faults]
    times, q, commands = simulated(trial)
    moved = q.copy()
    q = q + rng.normal(0.0, NOISE, q.shape)
    for change in trial.logs:
        q, commands = change(q, commands)
    if trial.idle:
        xml = robot.xml.replace("{idle}", trial.idle)
        system = amhe.System.from_model(mujoco.MjSpec.from_string(xml), **_described(robot, xml), warn=False)
    arrays = {"joints": {"time": times, "position": q}, "command": {"time": times, "value": commands}}
    return system, arrays, places, float(np.abs(moved).max())


def _described(robot: Robot, xml: str) -> dict[str, Any]:
    """What system.yaml says beside the model."""
    parameters = {
        name: {"nominal": value, "prior_sd": 0.5, "scale": "log", "targets": [target]}
        for name, (target, value) in robot.free.items()
    }
    drives = [name for name in (a.name for a in mujoco.MjSpec.from_string(xml).actuators) if name != "idle"]
    signals = {
        "joints": {"joints": list(robot.joints), "noise": {"position": NOISE}},
        "command": {"actuators": drives, "quantity": "value"},
    }
    settings = {"clips": {"length": [0.5, 1.0], "count": 12}}
    return {"parameters": parameters, "signals": signals, "settings": settings}


def kinds_of(robot: Robot, faults: Sequence[str], places: Sequence[str]) -> list[set[str]]:
    """What a row may call each fault; several forces on one joint are one force."""
    own = [set(FAULTS[fault][1]) for fault in faults]
    joints = {robot.joints[-1] if place == "idle" else place for place in places}
    return len(own) * [set().union(*own)] if len(joints) == 1 and {*faults} <= ONE else own


def named(found: Missing, kinds: set[str], place: str, first: bool) -> bool:
    """Whether the first row, or any, names a fault at its place."""
    rows = found.rows[:1] if first else found.rows
    return any(
        row.kind in kinds and (any(one in row.place for one in place.split(", ")) or "motor" in row.place)
        for row in rows
    )


def _can(robot: Robot, first: int = 0) -> list[str]:
    """Faults that a robot can have, from one of the list on."""
    return [name for name, (_, _, can) in list(FAULTS.items())[first:] if can is None or can(robot)]


TRIALS: list[tuple[str, tuple[str, ...]]] = [(name, (f,)) for name, one in ROBOTS.items() for f in _can(one)]
TRIALS += [(name, ()) for name in ROBOTS for _ in range(4)]
PAIRS = [(name, pair) for name, one in ROBOTS.items() for pair in itertools.combinations(_can(one, 6), 2)]


def trial(number: int) -> dict[str, Any]:
    """One robot with faults, explained."""
    logging.disable(logging.WARNING)
    seed, place = divmod(number, 2 * (len(TRIALS) + len(PAIRS)))
    index, identified = divmod(place, 2)
    robot, faults = [*TRIALS, *PAIRS][index]
    system, arrays, places, reach = case(ROBOTS[robot], faults, np.random.default_rng([seed, index]))
    log = amhe.Log.from_arrays(arrays, system)
    z = np.zeros(len(system.space))
    began = time.process_time()
    if identified:
        try:
            found = amhe.identify(system, log, seed=seed, threads=1).found.missing or Missing()
        except amhe.AmheError:  # a wrong unit may make every rollout diverge, and that is said
            found = explain(system, [whole(log)], z, np.random.default_rng(seed))
    else:
        found = explain(system, [whole(log)], z, np.random.default_rng(seed))
    told = kinds_of(ROBOTS[robot], faults, places)
    return {
        "robot": robot, "faults": faults, "places": places, "reach": reach,
        "cpu_seconds": time.process_time() - began,
        "first": [named(found, kinds, p, True) for kinds, p in zip(told, places, strict=True)],
        "any": [named(found, kinds, p, False) for kinds, p in zip(told, places, strict=True)],
        "rows": [f"{row.kind} {row.place} {row.share:.0%}" for row in found.rows],
        "texts": [row.text for row in found.rows], "rivals": [row.rivals for row in found.rows],
        "start": found.start, "left": found.left, "untested": found.untested,
    }  # fmt: skip


# -- repairs -----------------------------------------------------------------------------------------------


def _one(word: str, share: float, **more: Any) -> Callable[[Robot, str], dict[str, Any]]:
    """A number of a joint, known within a factor of three: about a share of what usually acts."""

    def known(robot: Robot, joint: str) -> dict[str, Any]:
        size = share * robot.typical * (1.0 if joint == robot.joints[0] else 0.4)
        target = {"joint": joint, "set": word}
        return {word: {"nominal": size, "scale": "log", "prior_sd": 1.0, "targets": [target]} | more}

    return known


def _spring(robot: Robot, joint: str) -> dict[str, Any]:
    rest = {"nominal": 0.0, "bounds": [-3.0, 3.0], "prior_sd": 0.3}
    return _one("stiffness", 0.5)(robot, joint) | {
        "rest": rest | {"targets": [{"joint": joint, "set": "spring_rest"}]}
    }


def _constant(robot: Robot, joint: str) -> dict[str, Any]:
    stiffness = 0.01 * robot.typical
    rest = {"nominal": 0.0, "bounds": [-300.0, 300.0], "prior_sd": 50.0}
    fixed = {"nominal": stiffness, "prior_sd": 0.0, "targets": [{"joint": joint, "set": "stiffness"}]}
    return {"stiffness": fixed, "rest": rest | {"targets": [{"joint": joint, "set": "spring_rest"}]}}


def _late(robot: Robot, joint: str) -> dict[str, Any]:
    late = {"nominal": 0.02, "bounds": [0.0, 0.1], "scale": "linear", "prior_sd": 0.02}
    return {"delay": late | {"targets": [{"set": "command_delay"}]}}


#: Faults that are numbers of a model -> what a user adds to `parameters` who knows the cause.
STRUCTURES: Mapping[str, Callable[[Robot, str], dict[str, Any]]] = {
    "delay": _late, "constant": _constant, "spring": _spring, "viscous": _one("damping", 0.3),
    "dry": _one("friction_loss", 0.3), "quadratic": _one("damping_quadratic", 0.2),
    "armature": _one("armature", 0.05),
    "load friction": _one("load_friction", 0.0, nominal=0.1, scale="linear", bounds=[0.0, 1.0], prior_sd=0.2),
}  # fmt: skip


def repaired(number: int) -> dict[str, Any]:
    """One robot with a fault: its model repaired, against the model of a user who knew the cause."""
    logging.disable(logging.WARNING)
    seed, index = divmod(number, len(TRIALS))
    name, faults = TRIALS[index]
    robot, known = ROBOTS[name], dict[str, Any]()
    _, arrays, places, _ = case(robot, faults, np.random.default_rng([seed, index]))
    for fault, place in zip(faults, places, strict=True):
        known |= STRUCTURES[fault](robot, place)
    began, found = time.process_time(), []
    for entries in ({}, known):
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "model.xml").write_text(xml := robot.xml.replace("{idle}", ""))
            given = _described(robot, xml)
            given["parameters"] |= entries
            given["signals"] = {key: {"topic": key} | one for key, one in given["signals"].items()}
            (Path(folder) / "system.yaml").write_text(json.dumps({"model": "model.xml"} | given))
            system = amhe.System.load(folder, warn=False)
            log = amhe.Log.from_arrays(arrays, system)
            mend = amhe.identify if entries else amhe.repair
            found.append(mend(system, log, seed=seed, threads=1))
    mended = found[0]
    given = mended.found.repairs[0].horizons if mended.found.repairs else ()
    parts = split_held_out(mended.logs, mended.system.settings.clips)[1]
    errors = scored([one.system for one in found], found, [one.logs for one in found], parts, seed, 1, "cpu")
    return {
        "robot": name, "faults": faults, "places": places, "cpu_seconds": time.process_time() - began,
        "ratios": {f"{at.horizon:.2g}": float(at.ratios[0, 1]) for at in errors},
        "gained": float(given[-1].ratios[0, 1]) if given else 1.0,
        "kept": [one.name for one in mended.found.repairs if one.kept],
        "tried": [one.name for one in mended.found.repairs],
        "looked": mended.found.missing is not None,
    }  # fmt: skip


def show_repairs(done: Sequence[dict[str, Any]]) -> None:
    """The table of --repair: the error at the farthest horizon that the trials share."""
    lines = []
    for fault in [*STRUCTURES, ""]:
        own = [d for d in done if not fault or fault in d["faults"]]
        if not own:
            continue
        worst = np.array([max(d["ratios"].values()) for d in own])
        last = np.array([list(d["ratios"].values())[-1] for d in own])
        lines.append((
            fault or "all", f"{sum(bool(d['kept']) for d in own)} of {len(own)}", f"{np.median(last):.2f}",
            f"{np.mean(last <= REPAIR_GOAL):.0%}", f"{np.mean(worst <= REPAIR_GOAL):.0%}",
            "; ".join(f"{d['robot']} {d['kept']} {r:.2f}" for d, r in zip(own, last, strict=True)
                      if fault and r > REPAIR_GOAL),
        ))  # fmt: skip
    seconds = np.array([d["cpu_seconds"] for d in done])
    show(
        f"Held-out error of the repaired model over that of the true structure (goal {REPAIR_GOAL:g}); CPU "
        f"median {np.median(seconds):.0f} s",
        ("fault", "repaired", "median", "within 10 %", "at all horizons", "those that are not"),
        lines,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=seeds_of, default=range(3), metavar="N or A:B")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--systems", default=",".join(ROBOTS))
    parser.add_argument("--faults", default=",".join([*FAULTS, "none"]))
    parser.add_argument("--every", type=int, default=1, help="each of so many trials only")
    parser.add_argument("--pairs", action="store_true", help="two faults at a time")
    parser.add_argument("--identify", action="store_true", help="identify first")
    parser.add_argument("--repair", action="store_true", help="identify, and repair what a model can have")
    add_parts(parser)
    parser.add_argument("--verbose", action="store_true", help="show the rows of what was not named")
    given = parser.parse_args()
    trials, offset = (PAIRS, len(TRIALS)) if given.pairs else (TRIALS, 0)
    wanted = given.faults.split(",")
    if given.repair:
        numbers = [
            seed * len(TRIALS) + index
            for seed in given.seeds
            for index, (robot, faults) in enumerate(TRIALS)
            if robot in given.systems.split(",") and faults and {*faults} <= {*wanted} & STRUCTURES.keys()
        ]
        show_repairs(in_parts("missing-repair", repaired, numbers[:: given.every], given))
        return
    numbers = [
        (seed * (len(TRIALS) + len(PAIRS)) + offset + index) * 2 + given.identify
        for seed in given.seeds
        for index, (robot, faults) in enumerate(trials)
        if robot in given.systems.split(",") and all(f in wanted for f in faults or ("none",))
    ]
    done = in_parts("missing", trial, numbers[:: given.every], given)
    report(done, given.pairs, given.verbose)


def report(done: Sequence[dict[str, Any]], pairs: bool, verbose: bool) -> None:
    """The tables."""
    lines, key = [], "any" if pairs else "first"
    for fault in [*FAULTS, ""]:
        own = [d for d in done if (fault in d["faults"] if fault else not d["faults"])]
        if own and fault:
            right = [d[key][d["faults"].index(fault)] for d in own]
            wrong = Counter(
                d["rows"][0].rsplit(" ", 1)[0] if d["rows"] else "nothing"
                for d, r in zip(own, right, strict=True)
                if not r
            )
            lines.append(
                (
                    fault,
                    f"{sum(right)} of {len(own)}",
                    f"{np.mean(right):.0%}",
                    "; ".join(f"{n} x {w}" for w, n in wrong.most_common(3)),
                )
            )
        elif own:
            nothing = [not d["rows"] for d in own]
            wrong = Counter(d["rows"][0].rsplit(" ", 1)[0] for d in own if d["rows"])
            lines.append(
                (
                    "none",
                    f"{sum(nothing)} of {len(own)}",
                    f"{np.mean(nothing):.0%}",
                    "; ".join(f"{n} x {w}" for w, n in wrong.most_common(3)),
                )
            )
    right = [x for d in done for x in d[key]]
    first = [any(d["first"]) for d in done if d["faults"]]
    for name, some in (("all faults", right), ("first rows that name one", first)):
        lines.append((name, f"{sum(some)} of {len(some)}", f"{np.mean(some):.0%}" if some else "", ""))
    seconds = np.array([d["cpu_seconds"] for d in done])
    show(
        f"Right in the first row (goal {RIGHT_GOAL:.0%}; of no fault nothing named, {NOTHING_GOAL:.0%}); CPU "
        f"median {np.median(seconds):.1f} s, most {seconds.max():.1f} s",
        ("fault", "named", "", "instead"),
        lines,
    )  # fmt: skip
    for d in done if verbose else ():
        if not all(d[key]) or (not d["faults"] and d["rows"]):
            print(
                d["robot"],
                d["faults"],
                d["places"],
                f"reach {d['reach']:.2f}",
                f"{d['start']:.2g}->{d['left']:.2g}",
                d["rows"],
                d["texts"][:2],
                d["rivals"][:1],
            )


if __name__ == "__main__":
    main()
