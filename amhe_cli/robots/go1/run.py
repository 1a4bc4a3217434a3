"""A task's name and options become an episode that is ready to run.

What has been identified of the robot itself (`group: robot` in models/go1_push/system.yaml) goes into gait
and planner. A planner without dry friction takes half the time: what is known of it is viscous friction
there, of the same torque at the speed of a walking joint, and the gait leads the joints by it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from amhe_cli import __version__
from amhe_cli.control.controller import Controller
from amhe_cli.control.protocols import Behaviour
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.belief import Belief, belief_for, belief_of, completed
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.log import Samples, Thinner, since
from amhe_cli.core.rotations import exp, multiply
from amhe_cli.core.signals import Signal
from amhe_cli.core.yaml_file import merged
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.online.horizon import MovingHorizon, check_window
from amhe_cli.estimation.online.tracker import Tracker
from amhe_cli.estimation.online.workers import PATIENCE, InProcess, InStep
from amhe_cli.live.episode import BeliefSource, Episode
from amhe_cli.live.recorder import Recorder
from amhe_cli.live.target import SimTarget, Target
from amhe_cli.robots.go1.behaviours.gait import Gait
from amhe_cli.robots.go1.behaviours.walking import Reflex
from amhe_cli.robots.go1.judge import Judge
from amhe_cli.robots.go1.kinematics import HOME, KINDS, SERVOS
from amhe_cli.robots.go1.model import KD, KP, SYSTEM, Box, home, layout, planner_model
from amhe_cli.robots.go1.plant import Plant, find_plant, shaped_plant
from amhe_cli.robots.go1.settings import PushSettings, settings_of
from amhe_cli.robots.go1.state import GRAVITY, State
from amhe_cli.robots.go1.state_estimator import StateEstimator
from amhe_cli.robots.go1.tasks import LONGEST, Task, find_task
from amhe_cli.system.provenance import attachments
from amhe_cli.system.system import System

#: Speed of a joint at which dry friction and its stand-in are equal [rad/s]; dry friction of the model that
#: the gait was made with [N m].
_SPEED, _USUAL = 1.5, 0.2


def robot_is_known(system: System) -> bool:
    """Whether somebody has identified the robot."""
    return any(held.sd for held in system.edits.held.values())


def latency_of(system: System) -> float:
    """Time that a command takes to act, as far as it is known [s]."""
    return system.edits.held["command_latency"].value if robot_is_known(system) else 0.0


def without_dry_friction(system: System) -> System:
    """The system without dry friction in the robot's joints; viscous friction stands in for what is known."""
    held = {name: one.value for name, one in system.edits.held.items()}
    numbers = {f"joint_friction_{kind}": 0.0 for kind in KINDS}
    if robot_is_known(system):
        for kind in KINDS:
            more = held[f"joint_friction_{kind}"] - _USUAL
            numbers[f"joint_damping_{kind}"] = max(held[f"joint_damping_{kind}"] + more / _SPEED, 0.05)
    return system.fixing({name: value for name, value in numbers.items() if name in held})


def gait_of(system: System) -> Gait:
    """The gait of a robot as far as it is known."""
    if not robot_is_known(system):
        return Gait()
    model = without_dry_friction(system).model
    data, at = mujoco.MjData(model), layout(model)
    data.qpos[:] = home(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    held = {name: one.value for name, one in system.edits.held.items()}
    gain, zeros = held.get("motor_gain", 1.0), tuple(held.get(f"zero_{servo}", 0.0) for servo in SERVOS)
    trunk, damping = model.body("trunk").id, model.dof_damping[at.joints_v[:3]] + gain * KD
    ahead, left = (data.subtree_com[trunk] - data.xpos[trunk])[:2].tolist()
    hip, thigh, calf = np.asarray(damping).tolist()
    return Gait(
        kp=gain * KP, damping=(hip, thigh, calf), weight=float(model.body_subtreemass[trunk]) * GRAVITY,
        centre=(ahead, left), zeros=zeros,
    )  # fmt: skip


#: Time between two samples of joints and IMU [s].
SAMPLE_PERIOD = 0.01
_OWN = ("joints.position", "joints.velocity", "imu.angular_velocity", "imu.linear_acceleration")


class Sampler:
    """Makes samples of each cycle's measurements, estimates and commands, in single precision.

    The robot's own samples are thinned: 500 Hz of twelve joints are most of a log, and an identification
    learns little from them. Nothing is older than the first command: then the clock of our reader, which
    starts at the first sample, meets every command on a step of its own.
    """

    def __init__(self) -> None:
        self._thinner = Thinner(SAMPLE_PERIOD)
        self._last: State | None = None

    def __call__(self, measured: Samples, estimate: State) -> Samples:
        """The samples of one cycle, from its measurements and its estimate; once for each, in order."""
        own = self._thinner.thinned({key: measured[key] for key in _OWN})
        seen = {key: series for key, series in measured.items() if key.startswith(("trunk.", "box."))}
        commands = {"command.position": measured["command.position"]}
        begun = -np.inf if self._last else estimate.time - 1e-6
        seen = self._with_twists(since(seen, begun), estimate)
        samples = {**since(own, begun), **seen, **since(commands, begun)}
        self._last = estimate
        # single precision: half of a log's size, and more digits than any sensor has
        return {
            key: (times, np.asarray(values, dtype=np.float32).astype(np.float64))
            for key, (times, values) in samples.items()
        }

    def _with_twists(self, seen: Samples, now: State) -> Samples:
        """Measured poses, with twists interpolated between the last cycle's estimate and this one's."""
        before = self._last or now
        samples = dict(seen)
        for name in ("trunk", "box"):
            times, _ = seen[f"{name}.position"]
            passed = max(now.time - before.time, 1e-9)
            share = np.clip((times - before.time) / passed, 0.0, 1.0)[:, None] if self._last else 1.0
            for key, part in (("linear_velocity", "velocity"), ("angular_velocity", "rate")):
                twists = [getattr(getattr(state, name), part) for state in (before, now)]
                start, end = (np.tile(twist, (times.size, 1)) for twist in twists)
                samples[f"{name}.{key}"] = times, start + share * (end - start)
        return samples


MODES = ("true", "baseline", "stale", "adaptive")
#: Start poses of robot and box differ by up to this, uniformly [m], [rad].
_START_PLACE, _START_TURN = 0.03, float(np.deg2rad(3.0))
#: Variance of z of numbers that a task takes for granted: none, but a covariance must be regular.
_CERTAIN = 1e-8
#: Uses of a run's seed; a new one goes to the end, so that the others draw as before.
_USES = ("start", "sensors", "samples", "estimator")


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of `amhe run`.

    Args:
        task: Name of the task.
        mode: Which belief the controller uses: one of `MODES`.
        target: 'sim' or 'go1'.
        belief: A belief, or its file, that replaces the mode's fixed one.
        seed: Seed of start poses, sensor noise and sampling.
        threads: Threads of the rollouts; the outcome does not depend on them.
        duration: Longest duration of the episode [s].
        plant: Another Go1: a name of `plant.PLANTS`, or its MJCF.
        settings: Settings that replace the system's own, as a nested mapping.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.
        engine: What computes the rollouts: one of `engine.open.KINDS`.
    """

    task: str
    mode: str = "true"
    target: str = "sim"
    belief: Belief | Path | None = None
    seed: int = 0
    threads: int = 1
    duration: float = LONGEST
    plant: str | Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    belief_anyway: bool = False
    engine: str = "cpu"


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """An episode on its target, with task and system.

    Args:
        options: Options that the run was opened with.
        system: `go1_push` with the user's settings.
        plant: Plant behind a simulated target, for pictures; None for a real robot.
        first_truth: The plant's parameters at the start, by name; {} where they are unknown.
    """

    options: RunOptions
    task: Task
    system: System
    episode: Episode
    target: Target
    plant: Plant | None
    judge: Judge
    first_truth: dict[str, float]

    @property
    def live(self) -> bool:
        """Whether time goes on while the program computes."""
        return _live(self.options, self.system)


def generator(seed: int, use: str) -> np.random.Generator:
    """The random generator for one of the uses of a run's seed: start, sensors, samples or estimator."""
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(len(_USES))[_USES.index(use)])


def open_run(options: RunOptions, task: Task | None = None) -> Run:
    """Prepare a run.

    Args:
        task: The task, in place of the one that the options name.

    Raises:
        ConfigError: Unknown task or mode, a belief that does not suit, a plant that is no Go1, or a wrong
            setting.
    """
    named = task or find_task(options.task)
    task, system = task_and_system(options, named)
    settings = settings_of(system).control
    start, sensors = (generator(options.seed, use) for use in ("start", "sensors"))
    shape, robot = find_plant(options.plant)
    box = _moved(task, start)
    if shape.box != (1.0, 1.0, 1.0):  # it has its own size, whatever the user states
        box = replace(box, size=named.box.size)
    model = shaped_plant(box, shape, robot)
    first = _start(home(model), layout(model).trunk, start)
    gap = system.model.geom("box").size - model.geom("box").size  # negative: it is larger than stated
    sizes = {"face_overlap": float(gap[int(task.one_leg)]), "floor_overlap": float(gap[2])}
    beside = {name: value for name, value in sizes.items() if name in system.space.names}
    plant = Plant(model, task.changes, sensors, start=first, shape=shape, beside=beside)
    target = SimTarget(plant, settings.period, HOME, settings.realtime, latency_of(system))
    return run_on(options, task, system, target, plant)


def run_on(
    options: RunOptions,
    task: Task,
    system: System,
    target: Target,
    plant: Plant | None,
    slow: float = 1.0,
) -> Run:
    """A run of a task on a target; arguments as of `Run` and `belief_source`."""
    behaviour = task.behaviour(gait_of(system))
    controller = controller_for(options, task, behaviour, system)
    judge = Judge(task, behaviour.running_cost, settings_of(system).control.period, options.duration)
    belief = belief_source(options, task, system, plant, slow)
    observe = StateEstimator(behaviour.standing).update
    episode = Episode(target, observe, controller, belief, Sampler(), judge)
    return Run(options, task, system, episode, target, plant, judge, plant.parameters if plant else {})


def measured(task: Task) -> dict[str, Any]:
    """Measured sizes that the system file needs for a task: that of its box, where it is another one."""
    return {} if task.box.size == Box().size else {"boxes": {"box": list(task.box.size)}}


def as_measured(task: Task, system: System) -> Task:
    """The task with the box size of the system: the user may have measured another one (`boxes.box`).

    Its near face stays where the task has it, or a deep box would reach into the robot; the path, which
    begins at the centre of the box, goes with it.
    """
    depth, width, height = (2.0 * float(half) for half in system.model.geom("box").size)
    box = replace(task.box, size=(depth, width, height))
    if box == task.box:
        return task
    turn = task.path.heading - box.yaw
    along, across = abs(np.cos(turn)), abs(np.sin(turn))
    further = 0.5 * (along * (depth - task.box.size[0]) + across * (width - task.box.size[1]))
    (x, y), (u, v) = box.position, (np.cos(task.path.heading), np.sin(task.path.heading))
    place = (float(x + further * u), float(y + further * v))
    return replace(task, box=replace(box, position=place), path=replace(task.path, start=place))


def controller_for(options: RunOptions, task: Task, behaviour: Behaviour, system: System) -> Controller:
    """The controller of a task, with the planner's model of its box."""
    settings = settings_of(system).control
    planner = planner_model(task.box, timestep=settings.period / settings.substeps)
    fast = without_dry_friction(system)
    engine = open_engine(fast, threads=options.threads, kind=options.engine, model=planner, sensors=False)
    # its simulations are made now: the first plan at a robot would take twice the time of the others
    n, inputs = settings.samples, np.zeros((settings.samples, 1, planner.nu))
    theta = np.tile(system.space.nominal, (n, 1))
    engine.rollout(theta, planner.qpos0, np.zeros(planner.nv), inputs, np.ones(n, dtype=np.int64))
    robot = layout(planner)
    reflex = Reflex(robot) if options.mode == "adaptive" and task.pushes and settings.reflex else None
    return Controller(
        behaviour, robot, settings.joint_sigma, engine, settings, system.space.names,
        generator(options.seed, "samples"), reflex=reflex,
    )  # fmt: skip


def task_and_system(options: RunOptions, task: Task | None = None) -> tuple[Task, System]:
    """The task with its box as measured, and `go1_push` with that box and the user's settings.

    Args:
        task: The task, in place of the one that the options name.

    Raises:
        ConfigError: Unknown task, or a wrong setting.
    """
    task = task or find_task(options.task)
    system = system_of(options, task)
    return as_measured(task, system), system


def system_of(options: RunOptions, task: Task) -> System:
    """`go1_push` with the task's box and the user's settings.

    Raises:
        ConfigError: A setting is wrong.
    """
    return System.load(SYSTEM, merged(measured(task), options.settings), schema=PushSettings, warn=False)


def belief_source(
    options: RunOptions, task: Task, system: System, plant: Plant | None, slow: float = 1.0
) -> BeliefSource:
    """Source of the controller's belief: the plant, where there is one, fixed parameters, or an estimator.

    Args:
        system: The system whose parameters are estimated.
        plant: Plant behind a simulated target; None for a real robot.
        slow: How many seconds of the wall clock one second of the run takes: the estimator has that much
            longer.

    Raises:
        ConfigError: Unknown mode, or a belief that does not suit.
    """
    if options.mode not in MODES:
        raise ConfigError(one_of("mode", options.mode, MODES))
    if options.mode == "true" and plant is not None:
        if options.belief is not None:
            raise ConfigError("`mode=true` believes the plant's own parameters; leave out `belief`")
        nominal = system.space.named(system.space.nominal)  # of what is asked for beside the box
        return BeliefSource(lambda: nominal | plant.parameters)
    if not {"box_mass", "floor_friction"} <= set(system.space.names):
        raise ConfigError("`unknowns`: a run learns box_mass and floor_friction; ask for `box` too")
    start = _start_belief(options, task, system)
    fixed = system.space.named(start.estimate)
    if options.mode != "adaptive":
        return BeliefSource(lambda: fixed)
    mhe = system.settings.mhe
    check_window(mhe, system.model.opt.timestep)
    factory = partial(estimator_of, options, start)
    budget = slow * (mhe.budget or mhe.update_period)
    live = _live(options, system)
    worker = InProcess(factory, budget, slow * PATIENCE) if live else InStep(factory, mhe.latency)
    return BeliefSource(lambda: fixed, Tracker(system, worker))


def estimator_of(options: RunOptions, start: Belief, belief: Belief | None = None) -> MovingHorizon:
    """The estimator of an adaptive run; its arguments are all it needs, also in another process.

    Args:
        start: Prior belief at the start of the run.
        belief: Belief from which to go on after an estimator has ended; None: `start`.
    """
    system = system_of(options, find_task(options.task))
    threads = 1 if _live(options, system) else options.threads
    engine = open_engine(system, threads=threads, kind=options.engine)
    rng = generator(options.seed, "estimator")
    return MovingHorizon(system, engine, rng, belief or start)


def _live(options: RunOptions, system: System) -> bool:
    """Whether time goes on while the program computes."""
    return options.target != "sim" or settings_of(system).control.realtime


def _start_belief(options: RunOptions, task: Task, system: System) -> Belief:
    """The belief of the file, or else the task's fixed one; adaptive runs start from the baseline's."""
    if options.belief is not None:
        return completed(belief_for(system, options.belief, options.belief_anyway), system)
    if options.mode == "stale" and task.stale is None:
        raise ConfigError(
            f"task {task.name} has no stale belief; give one with `belief`, or use `mode=baseline`"
        )
    believed = asdict(task.stale if options.mode == "stale" and task.stale else task.baseline)
    space = system.space
    theta = np.array([believed.get(p.name, p.nominal) for p in space.parameters])
    return belief_of(system, space.z_of(theta), _CERTAIN * np.eye(len(space)))


def _moved(task: Task, rng: np.random.Generator) -> Box:
    x, y = np.array(task.box.position) + rng.uniform(-_START_PLACE, _START_PLACE, 2)
    yaw = task.box.yaw + rng.uniform(-_START_TURN, _START_TURN)
    return replace(task.box, position=(float(x), float(y)), yaw=float(yaw))


def _start(qpos: FloatArray, trunk: slice, rng: np.random.Generator) -> FloatArray:
    pose = qpos[trunk]
    pose[:2] += rng.uniform(-_START_PLACE, _START_PLACE, 2)
    pose[3:] = multiply(exp(np.array([0.0, 0.0, rng.uniform(-_START_TURN, _START_TURN)])), pose[3:])
    return qpos


#: Recorded in addition to the system's own signals. It measures no orientation, which is in /odom.
_IMU = Signal(
    "imu",
    "/imu",
    ("angular_velocity", "linear_acceleration"),
    type="sensor_msgs/msg/Imu",
    child_frame="trunk",
)


def recorder_of(run: Run, path: Path) -> Recorder:
    """The recorder of a run's log, with the metadata that say what the log shows."""
    options = run.options
    metadata = {name: str(getattr(options, name)) for name in ("seed", "task", "mode", "target")}
    metadata |= {"system": run.system.name, "version": __version__}
    known = {key: value for key, value in run.options.settings.items() if key == "parameters"}
    if stated := merged(measured(run.task), known):  # so that the reader of the log has the same model
        metadata["overrides"] = json.dumps(stated)
    if run.first_truth and not run.task.changes:  # values that change are in /amhe/truth
        metadata["truth"] = json.dumps(run.first_truth)
    return Recorder(path, (*run.system.signals, _IMU), metadata, attachments(run.system))
