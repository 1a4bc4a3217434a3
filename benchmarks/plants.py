"""Small robots for `honesty.py`: what a user models, and a plant that may differ from it.

A problem is a model with unknown parameters, and logs of a plant. The parameters of the plant are drawn near
the prior. Its twin's plant differs from the model in nothing else; the wrong one has what the model lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

import amhe_cli as amhe
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.settings import AssumedSettings

#: Settings of all problems: short clips, and no more searching than a small problem needs.
SMALL = {
    "clips": {"length": [0.4, 1.0], "count": 12},
}
#: Sd of the priors, and the share of it by which plants differ from the nominal; both of logarithms.
PRIOR, SPREAD = 0.7, 0.5
#: Time between two samples, and two commands, of a log [s].
PERIOD = 0.01

#: Time, positions and velocities of a plant -> commands (m,).
Command = Callable[[float, FloatArray, FloatArray], FloatArray]
#: What one robot is, by the name of what its model lacks; None is its twin.
Robot = Callable[[np.random.Generator, str | None], "Case"]


@dataclass(frozen=True)
class Case:
    """One identification: the user's system, the logs, and the truth that the user does not know."""

    system: amhe.System
    logs: tuple[amhe.Log, ...]
    truth: dict[str, float]
    made: Callable[[dict[str, Any]], amhe.System] | None = None

    def told(self, **identify: Any) -> Case:
        """The same for a user who says more in `settings: identify:`."""
        assert self.made is not None, "the problem says how its system is made"
        return replace(self, system=self.made(SMALL | {"identify": identify}))

    def exact(self) -> Case:
        """The same for a user who has measured what the model takes as exact."""
        return self.told(assumed=AssumedSettings.model_validate(0).model_dump())


@dataclass(frozen=True)
class Problem:
    """One robot, and what its model lacks."""

    lacks: str
    robot: Robot

    def case(self, name: str, seed: int, wrong: bool) -> Case:
        """One identification, the same for the same seed."""
        rng = np.random.default_rng([seed, list(PROBLEMS).index(name), wrong])
        return self.robot(rng, name if wrong else None)


# -- plants and what is logged of them ---------------------------------------------------------------------


@dataclass(frozen=True)
class Plant:
    """A robot that is simulated beside its model.

    Args:
        xml: Its MJCF.
        before: Called before every step.
        start: Joint -> position at first, where it is not 0.
        delay: Time by which commands act later than they are logged [s].
        shift: Joint -> what its encoder shows at zero; servos act on what encoders show.
        band: Band of the sensors [Hz], of first order; None: they show each instant.
    """

    xml: str
    before: Callable[[mujoco.MjModel, mujoco.MjData], None] | None = None
    start: Mapping[str, float] | None = None
    delay: float = 0.0
    shift: Mapping[str, float] | None = None
    band: float | None = None


@dataclass(frozen=True)
class Recording:
    """What a plant did, every PERIOD: times (n,), joints (n, k), commands (n, m), sensors (n, s)."""

    time: FloatArray
    joints: FloatArray
    commands: FloatArray
    sensors: FloatArray


def record(plant: Plant, command: Command, joints: Sequence[str], seconds: float) -> Recording:
    """Play commands to a plant."""
    model = mujoco.MjModel.from_xml_string(plant.xml)
    data = mujoco.MjData(model)
    for name, position in (plant.start or {}).items():
        data.joint(name).qpos[0] = position
    columns = [int(model.joint(name).qposadr[0]) for name in joints]
    shift = np.array([(plant.shift or {}).get(name, 0.0) for name in joints])
    servos = [
        (i, joints.index(model.joint(model.actuator_trnid[i, 0]).name))
        for i in np.flatnonzero(model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE)
    ]
    every, late = round(PERIOD / model.opt.timestep), round(plant.delay / model.opt.timestep)
    share = 1.0 - 1.0 / (1.0 + 2.0 * np.pi * plant.band * model.opt.timestep) if plant.band else 1.0
    steps = round(seconds / model.opt.timestep)
    time, commands = np.arange(steps) * model.opt.timestep, np.zeros((steps, model.nu))
    positions, sensors = np.empty((steps, len(joints))), np.empty((steps, model.nsensordata))
    for k in range(steps):
        positions[k] = data.qpos[columns] + shift
        commands[k] = commands[k - 1] if k % every else command(time[k], data.qpos, data.qvel)
        data.ctrl[:] = commands[max(0, k - late)]
        for actuator, joint in servos:
            data.ctrl[actuator] -= shift[joint]
        if plant.before:
            plant.before(model, data)
        mujoco.mj_step(model, data)
        before = sensors[k - 1] if k else data.sensordata
        sensors[k] = before + share * (data.sensordata - before)
    return Recording(time[::every], positions[::every], commands[::every], sensors[::every])


def noisy(rng: np.random.Generator, values: FloatArray, sd: float) -> FloatArray:
    """Values with white noise."""
    return values + rng.normal(0.0, sd, values.shape)


def drawn(rng: np.random.Generator, nominal: Mapping[str, float]) -> dict[str, float]:
    """True parameters near the nominal ones."""
    return {name: value * np.exp(SPREAD * PRIOR * rng.standard_normal()) for name, value in nominal.items()}


def multisine(rng: np.random.Generator, sizes: Sequence[float], fastest: float) -> Command:
    """Commands of several joints, from slow (friction shows) to fast (inertia shows); all 0 at first."""
    hertz = np.geomspace(0.2, fastest, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, (len(sizes), 6))
    scale = 0.5 * np.array(sizes)[:, None] / np.sqrt(hertz / hertz[0])
    return lambda t, q, v: (scale * (np.sin(2.0 * np.pi * hertz * t + phase) - np.sin(phase))).sum(axis=1)


def of_joints(what: str, *names: str) -> list[dict[str, Any]]:
    """Targets of a parameter that several joints share."""
    return [{"joint": name, "set": what} for name in names]


def measured(noise: float, *joints: str) -> dict[str, Any]:
    """The signal of some joints' positions."""
    return {"joints": list(joints), "noise": {"position": noise}}


def case(
    xml: str,
    nominal: Mapping[str, float],
    truth: dict[str, float],
    targets: Sequence[list[dict[str, Any]]],
    signals: dict[str, Any],
    *arrays: dict[str, Any],
) -> Case:
    """The user's system from its MJCF, and a log from each dictionary of what was measured."""
    parameters = {
        name: {"nominal": value, "prior_sd": PRIOR, "scale": "log", "targets": target}
        for (name, value), target in zip(nominal.items(), targets, strict=True)
    }

    def made(settings: dict[str, Any]) -> amhe.System:
        spec, more = mujoco.MjSpec.from_string(xml), {"parameters": parameters, "signals": signals}
        return amhe.System.from_model(spec, **more, settings=settings, name="robot", warn=False)

    system = made(SMALL)
    logs = (amhe.Log.from_arrays(a, system, name=f"log {i}") for i, a in enumerate(arrays))
    return Case(system, tuple(logs), truth, made)


# -- a servo that swings a load ----------------------------------------------------------------------------


def swing(rng: np.random.Generator, wrong: str | None, limit: float = 20.0) -> Case:
    """A rod with a load at its end, on one position servo: mass, damping, friction and armature unknown."""
    nominal = {"mass": 0.5, "damping": 0.08, "friction": 0.06, "armature": 0.012}
    truth, noise, gain = drawn(rng, nominal), 0.002, 15.0
    plant = Plant(
        _swing(
            **truth,
            gain=gain * (0.85 if wrong == "gain" else 1.0),
            limit=limit * (0.75 if wrong == "limit" else 1.0),
            play=0.005 if wrong == "backlash" else 0.0,
            tilt=2.0 if wrong == "tilt" else 0.0,
        ),
        before={"stribeck": _stribeck, "servo_off": _servo_off}.get(wrong or ""),
    )
    made = record(plant, multisine(rng, [0.9], 2.5), ["hinge"], 12.0)
    return case(
        _swing(**nominal, gain=gain, limit=limit),
        nominal,
        truth,
        (
            [{"body": "load", "set": "mass"}],
            of_joints("damping", "hinge"),
            of_joints("friction_loss", "hinge"),
            of_joints("armature", "hinge"),
        ),
        {"joints": measured(noise, "hinge"), "command": {"actuators": ["servo"], "quantity": "position"}},
        {
            "joints": {"time": made.time, "position": noisy(rng, made.joints, noise)},
            "command": {"time": made.time, "position": made.commands},
        },
    )


def limited_swing(rng: np.random.Generator, wrong: str | None) -> Case:
    """The same with a servo that often gives all it can."""
    return swing(rng, wrong, limit=2.5)


def _swing(
    mass: float,
    damping: float,
    friction: float,
    armature: float,
    gain: float,
    limit: float,
    play: float = 0.0,
    tilt: float = 0.0,
) -> str:
    arm = f"""<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.01" mass="0.1"/>
      <body name="load" pos="0 0 -0.4"><geom type="sphere" size="0.04" mass="{mass}"/></body>"""
    if play:  # the encoder and the servo sit on the motor's side of the play
        loose = f'<joint axis="0 1 0" range="{-play} {play}" limited="true" damping="0.002"/>'
        arm = f'<inertial mass="0.001" pos="0 0 0" diaginertia="1e-4 1e-4 1e-4"/><body>{loose}{arm}</body>'
    joint = f'axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="{armature}"'
    servo = f'joint="hinge" kp="{gain}" kv="0.2" forcerange="{-limit} {limit}"'
    return f"""<mujoco><compiler angle="radian"/><option timestep="0.005"/><worldbody>
      <body euler="0 {np.radians(tilt)} 0"><joint name="hinge" {joint}/>{arm}</body></worldbody>
      <actuator><position name="servo" {servo}/></actuator></mujoco>"""


def _stribeck(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Friction that is twice as large at rest, and falls to its modelled value within 0.3 rad/s."""
    speed, extra = data.qvel[0], model.dof_frictionloss[0]
    data.qfrc_applied[0] = -extra * np.tanh(speed / 0.01) * np.exp(-((speed / 0.3) ** 2))


def _servo_off(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """The servo has no torque in the second third of the log, and commands go on."""
    model.actuator_forcerange[0] = (-1e-9, 1e-9) if 4.0 <= data.time < 8.0 else (-20.0, 20.0)


# -- an arm of two servos ----------------------------------------------------------------------------------


def arm(rng: np.random.Generator, wrong: str | None) -> Case:
    """Two links in a vertical plane on stiff servos: payload, damping and friction unknown.

    The declared noise is twice the encoders', as a careful user would have it.
    """
    nominal = {"payload": 0.8, "damping": 0.5, "friction": 0.25}
    truth, noise, step = drawn(rng, nominal), 0.001, 0.005
    plant = Plant(
        _arm(
            **truth,
            step=step * (0.5 if wrong == "step" else 1.0),
            centre=(0.03, 0.01) if wrong == "payload" else (0.0, 0.0),
            rocks=wrong == "mount",
        ),
        delay=0.005 if wrong == "delay" else 0.0,
        shift={"elbow": 0.05} if wrong == "encoder" else None,
    )
    names = ["shoulder", "elbow"]
    made = record(plant, multisine(rng, [0.6, 0.8], 2.0), names, 10.0)
    return case(
        _arm(**nominal, step=step),
        nominal,
        truth,
        (
            [{"body": "payload", "set": "mass"}],
            of_joints("damping", *names),
            of_joints("friction_loss", *names),
        ),
        {"joints": measured(noise, *names), "command": {"actuators": names, "quantity": "position"}},
        {
            "joints": {"time": made.time, "position": noisy(rng, made.joints, 0.5 * noise)},
            "command": {"time": made.time, "position": made.commands},
        },
    )


def _arm(
    payload: float,
    damping: float,
    friction: float,
    step: float,
    centre: tuple[float, float] = (0.0, 0.0),
    rocks: bool = False,
) -> str:
    base = ""
    if rocks:
        base = """<joint axis="0 1 0" stiffness="3000" damping="1"/>
          <geom type="box" size="0.1 0.1 0.05" pos="0 0 -0.05" mass="4"/>"""
    joint = f'axis="0 1 0" damping="{damping}" frictionloss="{friction}" armature="0.02"'
    return f"""<mujoco><option timestep="{step}"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody><body>{base}
      <body><joint name="shoulder" {joint}/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
        <body pos="0.3 0 0"><joint name="elbow" {joint}/>
          <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.5"/>
          <body name="payload" pos="0.25 0 0">
            <geom type="sphere" size="0.04" mass="{payload}" pos="{centre[0]} 0 {centre[1]}"/></body>
        </body></body></body></worldbody>
      <actuator><position name="shoulder" joint="shoulder" kp="120" kv="4"/>
        <position name="elbow" joint="elbow" kp="80" kv="2"/></actuator></mujoco>"""


# -- a copter in a plane -----------------------------------------------------------------------------------


def copter(rng: np.random.Generator, wrong: str | None) -> Case:
    """Two rotors that hold a body in a vertical plane: mass, inertia and drag unknown, thrusts logged."""
    nominal = {"mass": 1.2, "inertia": 0.02, "drag": 0.4}
    truth = drawn(rng, nominal)
    plant = Plant(_copter(**truth, lag=0.02 if wrong == "rotors" else 0.0))
    made = record(plant, _pilot(multisine(rng, [0.6, 0.4], 0.8), truth), ["x", "z", "pitch"], 10.0)
    return case(
        _copter(**nominal),
        nominal,
        truth,
        (
            [{"body": "copter", "set": "mass", "carry_inertia": False}],
            [{"body": "copter", "set": "inertia", "axis": "y"}],
            of_joints("damping", "x", "z"),
        ),
        {
            "place": measured(0.002, "x", "z"),
            "pitch": measured(0.003, "pitch"),
            "thrust": {"actuators": ["left", "right"], "quantity": "effort"},
        },
        {
            "place": {"time": made.time, "position": noisy(rng, made.joints[:, :2], 0.002)},
            "pitch": {"time": made.time, "position": noisy(rng, made.joints[:, 2:], 0.003)},
            "thrust": {"time": made.time, "effort": made.commands},
        },
    )


def _copter(mass: float, inertia: float, drag: float, lag: float = 0.0) -> str:
    rotor = f'gear="0 0 1 0 0 0" dyntype="filter" dynprm="{lag}"' if lag else 'gear="0 0 1 0 0 0"'
    return f"""<mujoco><option timestep="0.005"/><worldbody><body name="copter">
      <joint name="x" type="slide" axis="1 0 0" damping="{drag}"/>
      <joint name="z" type="slide" axis="0 0 1" damping="{drag}"/><joint name="pitch" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <site name="left" pos="-0.2 0 0"/><site name="right" pos="0.2 0 0"/></body></worldbody>
      <actuator><general name="left" site="left" {rotor}/>
        <general name="right" site="right" {rotor}/></actuator></mujoco>"""


def _pilot(aims: Command, truth: Mapping[str, float]) -> Command:
    """Thrusts [N] that follow a path: position to pitch to moment, with an integral of the pitch's error."""
    integral = np.zeros(1)

    def fly(t: float, q: FloatArray, v: FloatArray) -> FloatArray:
        aim = aims(t, q, v)
        lift = truth["mass"] * (9.81 + 6.0 * (aim[1] - q[1]) - 4.0 * v[1])
        pitch = np.clip((3.0 * (aim[0] - q[0]) - 2.5 * v[0]) / 9.81, -0.5, 0.5)
        integral[0] += 0.01 * (pitch - q[2])
        turn = truth["inertia"] * (100.0 * (pitch - q[2]) - 16.0 * v[2] + 60.0 * integral[0]) / 0.2
        return np.array([0.5 * (lift + turn), 0.5 * (lift - turn)])

    return fly


# -- a cart with a load on a force sensor ------------------------------------------------------------------


def cart(rng: np.random.Generator, wrong: str | None) -> Case:
    """A cart on a servo, its load carried by a force sensor: load, damping and friction unknown."""
    nominal = {"load": 1.0, "damping": 5.0, "friction": 2.0}
    truth = drawn(rng, nominal)
    plant = Plant(_cart(**truth), band=20.0 if wrong == "force" else None)
    made = record(plant, multisine(rng, [0.25], 2.5), ["slide"], 10.0)
    bias = np.array([0.4, -0.2, 0.4]) if wrong == "force" else np.zeros(3)
    return case(
        _cart(**nominal),
        nominal,
        truth,
        (
            [{"body": "load", "set": "mass"}],
            of_joints("damping", "slide"),
            of_joints("friction_loss", "slide"),
        ),
        {
            "joints": measured(0.0005, "slide"),
            "wrist": {"site": "wrist", "quantity": "force", "noise": {"force": 0.2}},
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        {
            "joints": {"time": made.time, "position": noisy(rng, made.joints, 0.0005)},
            "wrist": {"time": made.time, "force": noisy(rng, made.sensors + bias, 0.2)},
            "command": {"time": made.time, "position": made.commands},
        },
    )


def _cart(load: float, damping: float, friction: float) -> str:
    joint = f'type="slide" axis="1 0 0" damping="{damping}" frictionloss="{friction}"'
    return f"""<mujoco><option timestep="0.005"/><worldbody>
      <body><joint name="slide" {joint}/><geom type="box" size="0.1 0.1 0.05" mass="2"/>
        <body name="load" pos="0 0 0.2"><site name="wrist"/>
          <geom type="box" size="0.05 0.05 0.05" mass="{load}"/></body></body></worldbody>
      <actuator><position name="servo" joint="slide" kp="400" kv="20"/></actuator>
      <sensor><force name="wrist_force" site="wrist"/></sensor></mujoco>"""


# -- a block that is pushed --------------------------------------------------------------------------------


def push(rng: np.random.Generator, wrong: str | None) -> Case:
    """A ball on a servo pushes a block beside its middle: mass, friction and turning friction unknown.

    The ground's friction is that of the block's three joints, so that nothing but the ball makes contact.
    Each log is one push.
    """
    nominal = {"mass": 2.0, "friction": 6.0, "turning": 0.12}
    truth = drawn(rng, nominal)
    logs = []
    for side in (0.05, -0.04, 0.07, -0.06, 0.03, -0.07, 0.04, -0.05):
        plant = Plant(_push(**truth), start={"y": side})
        made = record(plant, _stroke(rng), ["ball", "x", "y", "yaw"], 1.6)
        block, yaw = made.joints[:, 1:3].copy(), made.joints[:, 3:]
        if wrong == "frame":  # the markers' centre is 2 cm beside the block's middle
            block += 0.02 * np.concatenate((-np.sin(yaw), np.cos(yaw)), axis=1)
        if wrong == "untouched":  # block and ball are measured in frames 0.4 m apart
            block[:, 0] += 0.4
        logs.append(
            {
                "block": {"time": made.time, "position": noisy(rng, block, 0.001)},
                "yaw": {"time": made.time, "position": noisy(rng, yaw, 0.004)},
                "ball": {"time": made.time, "position": noisy(rng, made.joints[:, :1], 0.0005)},
                "command": {"time": made.time, "position": made.commands},
            }
        )
    return case(
        _push(**nominal),
        nominal,
        truth,
        (
            [{"body": "block", "set": "mass"}],
            of_joints("friction_loss", "x", "y"),
            of_joints("friction_loss", "yaw"),
        ),
        {
            "block": measured(0.001, "x", "y"),
            "yaw": measured(0.004, "yaw"),
            "ball": measured(0.0005, "ball"),
            "command": {"actuators": ["servo"], "quantity": "position"},
        },
        *logs,
    )


def _push(mass: float, friction: float, turning: float) -> str:
    ground = f'type="slide" frictionloss="{friction}" damping="0.5"'
    return f"""<mujoco><option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
      <default><geom contype="0" conaffinity="0"/></default><worldbody>
      <body pos="-0.16 0 0"><joint name="ball" type="slide" axis="1 0 0" damping="1"/>
        <geom name="ball" type="sphere" size="0.03" mass="1"/></body>
      <body name="block"><joint name="x" axis="1 0 0" {ground}/><joint name="y" axis="0 1 0" {ground}/>
        <joint name="yaw" axis="0 0 1" frictionloss="{turning}" damping="0.01"/>
        <geom name="block" type="box" size="0.12 0.15 0.1" mass="{mass}"/></body></worldbody>
      <contact><pair geom1="ball" geom2="block" condim="3" friction="0.3 0.3 0.005 0.0001 0.0001"/></contact>
      <actuator><position name="servo" joint="ball" kp="600" kv="30"/></actuator></mujoco>"""


def _stroke(rng: np.random.Generator) -> Command:
    """A ball that advances [m] at two random speeds, with a pause between."""
    first, second = rng.uniform(0.12, 0.3, 2)
    places = np.cumsum([0.0, 0.6 * first, 0.0, 0.5 * second, 0.0])
    return lambda t, q, v: np.array([np.interp(t, [0.0, 0.6, 0.8, 1.3, 2.0], places)])


# -- the problems ------------------------------------------------------------------------------------------


PROBLEMS: dict[str, Problem] = {
    "gain": Problem("a servo gain 15 % off", swing),
    "limit": Problem("a torque limit 25 % off, which acts", limited_swing),
    "step": Problem("a plant at half the time step", arm),
    "stribeck": Problem("friction that falls with speed", swing),
    "backlash": Problem("play of 0.005 rad to either side", swing),
    "servo_off": Problem("a servo without torque for a third of the log", swing),
    "encoder": Problem("an encoder 0.05 rad off", arm),
    "frame": Problem("a body's frame 2 cm off", push),
    "mount": Problem("a base that rocks on a soft mount", arm),
    "payload": Problem("a payload with its centre of mass 3 cm farther out", arm),
    "force": Problem("a force sensor with a bias of 0.4 N and a band of 20 Hz", cart),
    "untouched": Problem("frames 0.4 m apart, so that nothing touches", push),
    "delay": Problem("commands that act 5 ms late", arm),
    "rotors": Problem("rotors that lag by 20 ms", copter),
    "tilt": Problem("a base 2 degrees off the vertical", swing),
}
