"""Probing a box with a walking Go1: motions are rehearsed in simulation, and the best of them is run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError, ConfigError, Ending, SimulationError
from amhe_cli.core.yaml_file import merged
from amhe_cli.engine.open import open_engine
from amhe_cli.estimation.design.design import ProbePlan, accuracy, criterion, ensemble, parts_of
from amhe_cli.estimation.design.information import clips_of, information_at, problem_of
from amhe_cli.estimation.design.probe import ActuatorProbe, Probe, ProbeOptions, Say, believing
from amhe_cli.live.recorder import drive
from amhe_cli.logs import read_log
from amhe_cli.robots.go1.judge import History
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.robots.go1.plant import find_plant
from amhe_cli.robots.go1.probing.motions import (
    APPROACH,
    MOTIONS,
    STEADY,
    WALK,
    Motion,
    ProbeTask,
    named_motion,
    probe_task,
)
from amhe_cli.robots.go1.run import Run, RunOptions, open_run, recorder_of, system_of
from amhe_cli.robots.go1.tasks import Believed, find_task
from amhe_cli.system.description.folders import find_system
from amhe_cli.system.system import System

if TYPE_CHECKING:
    from amhe_cli.robots.go1.link.open import WireOptions

#: From a run's target, recorder and history: a context in which the robot stands and is ready to run.
Attend = Callable[..., AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class Go1OnLink:
    """A real Go1 to probe.

    Args:
        wire: Addresses of robot and motion capture.
        attend: Checks the robot and makes it stand up; lets it down at the end, whatever happens.
    """

    wire: WireOptions
    attend: Attend


#: Pushes and their expected information were compared under beliefs that no reflex corrects.
_PLAIN = {"control": {"reflex": False}}
#: Shortest push, and longest rehearsal of one, after the approach [s].
_SHORTEST, _REHEARSED = 1.0, 3.0


class PushProbe:
    """See `probe.Probe`.

    Args:
        robot: A robot to probe in place of a simulation.

    Raises:
        ConfigError: Unknown task, a belief or setting that does not suit, or an option that only a simulation
            has.
    """

    def __init__(self, options: ProbeOptions, robot: Go1OnLink | None = None) -> None:
        self.task = options.task or "t1"
        self._walks = self.task == WALK.name
        self._options, self._task, self._robot = options, WALK if self._walks else find_task(self.task), robot
        asked = {"unknowns": ["robot"]} if self._walks else {}
        self._own = system_of(RunOptions(self.task, settings=merged(asked, options.settings)), self._task)
        self.system: System = believing(self._own, options)
        find_plant(options.plant)  # a wrong one is refused before the rehearsals
        if robot and options.box:
            raise ConfigError("`box`: the box of a real robot is as it is; leave it out")
        if robot:  # refuse wrong options before the rehearsals
            self.on_robot(STEADY, options.seconds, robot).episode.belief.close()

    def design(self, say: Say) -> ProbePlan:
        """See `Probe`."""
        options, space = self._options, self.system.space
        room = options.seconds - APPROACH.seconds
        if room < _SHORTEST:
            raise ConfigError(
                f"`seconds` {options.seconds:g}: too short; the approach and the shortest push take "
                f"{APPROACH.seconds + _SHORTEST:g} s"
            )
        if self._walks:  # there is one way to walk
            say("rehearsing free walking")
            known = self._information(WALK.motion, 0, np.zeros(len(space))) * options.seconds
            part = (WALK.motion.name, WALK.motion.title, options.seconds)
            return ProbePlan(parts_of([part]), accuracy(space, known[None]), None, "")
        draws = ensemble(space, self.system.settings.probe.pairs, options.rng(0))
        found = []
        for number, motion in enumerate(MOTIONS):
            say(f"rehearsing {motion.name}, {number + 1} of {len(MOTIONS)}")
            found.append(np.stack([self._information(motion, i, z) for i, z in enumerate(draws)]) * room)
        if not any(information.any() for information in found):
            raise SimulationError(
                "no rehearsal reveals anything about the parameters: under this belief the robot falls, or "
                "the box never moves; give another one with `belief`"
            )
        best = int(np.argmax([criterion(information, space.prior_precision) for information in found]))
        chosen, plain = MOTIONS[best], found[MOTIONS.index(STEADY)]
        return ProbePlan(
            parts_of([(m.name, m.title, s) for m, s in ((APPROACH, APPROACH.seconds), (chosen, room))]),
            accuracy(space, found[best]),
            accuracy(space, plain) if plain.any() else None,
            "straight push",
        )

    def run(self, plan: ProbePlan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """See `Probe`: closed-loop on the task's own box, or the robot's.

        The controller begins with the belief, and an estimator updates it meanwhile: a robot that pushes a
        heavy box as if it were light stalls, and reveals less.
        """
        motion = WALK.motion if self._walks else named_motion(plan.parts[-1].name)
        if not self._robot:
            return self.push(motion, plan.seconds, path, stopped, say)
        run = self.on_robot(motion, plan.seconds, self._robot)
        try:
            return self._record(run, path, stopped, say, self._robot.attend)
        except AmheError as error:  # it did not begin to run: keep the plan
            path.unlink(missing_ok=True)
            return Ending(error=error)

    def push(
        self,
        motion: Motion,
        seconds: float,
        path: Path,
        stopped: Callable[[], bool] = lambda: False,
        say: Say = lambda text: None,
        mode: str = "adaptive",
    ) -> Ending:
        """Run any motion in simulation, for so long [s] with the approach; `baseline` keeps to the belief."""
        task = self._as_it_is(motion, seconds)
        mode = "baseline" if self._walks else mode  # no box to learn of
        run = open_run(self._run_options(task, self._options.seed, mode), task)
        return self._record(run, path, stopped, say)

    def on_robot(self, motion: Motion, seconds: float, robot: Go1OnLink) -> Run:
        """Prepare a motion on the robot; nothing is sent yet.

        Raises:
            ConfigError: What the wire's options or the settings do not allow.
        """
        from amhe_cli.robots.go1.link.open import open_go1_run

        task = self._as_it_is(motion, seconds)
        options = self._run_options(task, self._options.seed, "baseline" if self._walks else "adaptive")
        return open_go1_run(replace(options, target="go1"), robot.wire, task)

    def _information(self, motion: Motion, number: int, z: FloatArray) -> FloatArray:
        """Information per second of a motion (d, d), if z (d,) were true and believed; zero after a fall."""
        system, options = self.system, self._options
        named = self._named(system.space.theta_of(z))
        box = Believed(named["box_mass"], named["floor_friction"])
        seconds = min(options.seconds, APPROACH.seconds + _REHEARSED)
        seed = int(options.rng(1, number).integers(2**31))
        task = self._probe(motion, seconds, box)
        run = open_run(self._run_options(task, seed, "true"), task)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "rehearsal.mcap"
            ending = self._record(run, path)
            log = read_log(path, system)
        begun = 0.0 if self._walks else APPROACH.seconds
        windows = [w for w in clips_of(system, log) if w.start * log.dt >= begun]
        if ending.error is not None or not windows:
            return np.zeros((z.size, z.size))
        theta = np.array([run.first_truth.get(p.name, p.nominal) for p in system.space.parameters])
        truth = system.space.z_of(theta)
        engine = open_engine(system, threads=options.threads, kind=options.engine)
        problem = problem_of(system, windows, engine)
        information = information_at(problem, truth, options.rng(2, number)).matrix.sum(axis=0)
        return information / sum(window.duration for window in windows)

    def _probe(self, motion: Motion, seconds: float, box: Believed) -> ProbeTask:
        if self._walks:
            return replace(WALK, nominal_time=seconds)
        prior = self._named(self._own.space.nominal)
        believed = Believed(prior["box_mass"], prior["floor_friction"])
        return probe_task(self._task, motion, seconds, box, believed)

    def _named(self, theta: FloatArray) -> dict[str, float]:
        """All parameters by name, those too that are held or fixed."""
        held = {name: one.value for name, one in self.system.edits.held.items()}
        own = self.system.space if theta.size == len(self.system.space) else self._own.space
        return held | own.named(theta) | self.system.fixed

    def _as_it_is(self, motion: Motion, seconds: float) -> ProbeTask:
        own = self._options.box or (self._task.box.mass, self._task.box.floor_friction)
        return self._probe(motion, seconds, Believed(*own))

    def _run_options(self, task: ProbeTask, seed: int, mode: str) -> RunOptions:
        """Options with the user's belief and plant; in a rehearsal, `true`, a draw in our own plant."""
        own, real = self._options, mode != "true"
        return RunOptions(
            self.task, mode, seed=seed, threads=own.threads, duration=task.nominal_time,
            belief=own.belief if real else None, plant=own.plant if real else None,
            settings=merged(_PLAIN, own.settings), belief_anyway=own.belief_anyway, engine=own.engine,
        )  # fmt: skip

    def _record(
        self,
        run: Run,
        path: Path,
        stopped: Callable[[], bool] = lambda: False,
        say: Say = lambda text: None,
        attend: Attend = lambda *_: nullcontext(),
    ) -> Ending:
        """Run to the end and record; a fall is an end too."""
        history, what = History(run.task, compares=False), "walking" if self._walks else "pushing"

        def show(_: object, row: dict[str, float]) -> None:
            say(f"{what}, {row['time']:.1f} s")

        with recorder_of(run, path) as recorder, attend(run.target, recorder, history):
            ending = drive(run.episode, recorder, history, stopped, show)
        if run.judge.fell and ending.error is None:
            return Ending(error=SimulationError("the robot fell; the log up to there is kept"))
        return ending


def open_probe(options: ProbeOptions, robot: Go1OnLink | None = None) -> Probe:
    """The probe of a system: a walking robot behind its box, or actuators that are driven as they are.

    Args:
        robot: A robot to probe in place of a simulation.

    Raises:
        ConfigError: Unknown system or task, nothing to drive, or a belief, plant or setting that does not
            suit.
    """
    folder = _driven(options, robot)
    if folder is None:
        if options.recipe or options.speed:
            raise ConfigError("a recipe drives joints as they are: give the `system` of its robot")
        return PushProbe(options, robot)
    return ActuatorProbe(options, System.load(folder, options.settings, schema=options.schema))


def _driven(options: ProbeOptions, robot: Go1OnLink | None) -> Path | None:
    """Folder of the system whose own actuators are driven; None: the Go1 walks. Refuses other options."""
    folder = find_system(options.system or SYSTEM)
    if folder.resolve() == find_system(SYSTEM).resolve():
        return None
    for flag, value in (("`box`", options.box), ("`task`", options.task)):
        if value:
            raise ConfigError(f"{flag}: {options.system} has none; leave it out")
    if robot:
        raise ConfigError(f"`target=go1` pushes boxes: leave out `system` {options.system}")
    return folder


def robot_to_probe(options: ProbeOptions, robot: Go1OnLink) -> Run:
    """The robot behind the box that it is to probe, for checks; nothing is sent yet.

    Raises:
        ConfigError: See `open_probe`.
    """
    _driven(options, robot)
    return PushProbe(options, robot).on_robot(STEADY, options.seconds, robot)
