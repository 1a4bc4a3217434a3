"""Probing a box with a walking Go1: primitives rehearsed in simulation, the best sequence, its run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from amhe_cli.control.tasks import Believed, find_task
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import AmheError, ConfigError, SimulationError
from amhe_cli.go1_assembly import open_go1_run
from amhe_cli.live.drive import Ending, drive
from amhe_cli.live.history import History
from amhe_cli.probing.design import accuracy, best_counts, ensemble, spread_out
from amhe_cli.probing.plan import Plan, parts_of
from amhe_cli.probing.primitives import APPROACH, LIBRARY, STEADY, Primitive
from amhe_cli.probing.probe import ProbeOptions, Say, believing, engine_of, read
from amhe_cli.probing.pushing import ProbeTask, probe_task
from amhe_cli.probing.rehearsal import rehearsal_of, rehearsed_information
from amhe_cli.probing.robot import Attend, Robot
from amhe_cli.run_assembly import Run, RunOptions, open_run, system_of
from amhe_cli.run_files import recorder_of
from amhe_cli.system.system import System


def _nobody(*_: object) -> AbstractContextManager[None]:
    return nullcontext()


class PushProbe:
    """See `probe.Probe`.

    Args:
        options: As given.
        robot: To probe in place of a simulation.

    Raises:
        ConfigError: Unknown task, a belief that does not suit, a setting, what only a simulation can do.
    """

    def __init__(self, options: ProbeOptions, robot: Robot | None = None) -> None:
        self._options, self._task, self._robot = options, find_task(options.task), robot
        self.task = options.task
        run = RunOptions(options.task, assignments=options.assignments, config=options.config)
        self._own = system_of(run, self._task)
        self.system: System = believing(self._own, options.belief)
        if robot:  # what it refuses is refused before the rehearsals
            self.on_robot((STEADY,), robot)

    def design(self, say: Say) -> Plan:
        """See `Probe`."""
        room = self._options.seconds - APPROACH.seconds
        library = [primitive for primitive in LIBRARY if primitive.seconds <= room + 1e-9]
        if not library:
            shortest = APPROACH.seconds + min(primitive.seconds for primitive in LIBRARY)
            raise ConfigError(
                f"--for {self._options.seconds:g}: too short; the approach and the shortest push take "
                f"{shortest:g} s"
            )
        seconds = np.array([primitive.seconds for primitive in library])
        draws = ensemble(self.system.space, self.system.settings.probe.pairs, self._options.rng(0))
        found = np.stack([self._rehearsed(library, i, z, len(draws), say) for i, z in enumerate(draws)])
        space = self.system.space
        counts = best_counts(found, seconds, space.prior_precision, room)
        sequence = [library[i] for i in spread_out(counts)]
        total = np.einsum("n,enij->eij", counts.astype(float), found)
        steady = found[:, library.index(STEADY)] * float(counts @ seconds) / STEADY.seconds
        return Plan(
            parts_of([(p.name, p.title, p.seconds) for p in (APPROACH, *sequence)]),
            accuracy(space, total),
            accuracy(space, steady),
            "straight push",
        )

    def run(self, plan: Plan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """See `Probe`: closed-loop on the task's own box, or the robot's, under the belief."""
        known = {primitive.name: primitive for primitive in LIBRARY}
        sequence = tuple(known[part.name] for part in plan.parts[1:])
        if not self._robot:
            run = self._open(self._as_it_is(sequence), self._options.seed, "baseline")
            return self._record(run, path, stopped, say)
        run = self.on_robot(sequence, self._robot)
        try:
            return self._record(run, path, stopped, say, self._robot.attend)
        except AmheError as error:  # it never came to run: the plan is worth keeping
            path.unlink()
            return Ending(error=error)

    def on_robot(self, sequence: tuple[Primitive, ...], robot: Robot) -> Run:
        """A sequence on the robot; nothing is sent yet.

        Raises:
            ConfigError: What the wire's options or the settings do not allow.
        """
        task, own = self._as_it_is(sequence), self._options
        options = replace(self._run_options(task, own.seed, "baseline"), target="go1", belief=own.belief)
        return open_go1_run(replace(options, plant=own.plant), robot.wire, task)

    def _rehearsed(
        self, library: list[Primitive], number: int, z: FloatArray, count: int, say: Say
    ) -> FloatArray:
        """Information of every primitive (n, d, d) if z (d,) were true and believed."""
        say(f"rehearsing, draw {number + 1} of {count}")
        named = dict(zip(self.system.space.names, self.system.space.theta_of(z), strict=True))
        box = Believed(float(named["box_mass"]), float(named["floor_friction"]))
        seed = int(self._options.rng(1 + number).integers(2**31))
        run = self._open(self._probe(rehearsal_of(library), box), seed, "true")
        with TemporaryDirectory() as folder:
            path = Path(folder) / "rehearsal.mcap"
            self._record(run, path, lambda: False, lambda text: None)
            log = read(self.system, path)
        truth = self.system.space.z_of(np.array([run.first_truth[name] for name in self.system.space.names]))
        engine, rng = engine_of(self.system, self._options.threads), self._options.rng(5 + number)
        return rehearsed_information(self.system, library, log, engine, truth, rng)

    def _probe(self, sequence: tuple[Primitive, ...], box: Believed) -> ProbeTask:
        prior = self._own.space.named(self._own.space.nominal)
        return probe_task(self._task, sequence, box, Believed(prior["box_mass"], prior["floor_friction"]))

    def _as_it_is(self, sequence: tuple[Primitive, ...]) -> ProbeTask:
        return self._probe(sequence, Believed(self._task.box.mass, self._task.box.floor_friction))

    def _run_options(self, task: ProbeTask, seed: int, mode: str) -> RunOptions:
        own = self._options
        return RunOptions(
            own.task, mode, seed=seed, threads=own.threads, duration=task.nominal_time,
            assignments=own.assignments, config=own.config,
        )  # fmt: skip

    def _open(self, task: ProbeTask, seed: int, mode: str) -> Run:
        options, own = self._run_options(task, seed, mode), self._options
        if mode != "true":
            options = replace(options, belief=own.belief, plant=own.plant)
        return open_run(options, task)

    def _record(
        self, run: Run, path: Path, stopped: Callable[[], bool], say: Say, attend: Attend = _nobody
    ) -> Ending:
        """Run to the end; a fall is an ending too."""
        history = History(run.task)
        with recorder_of(run, path) as recorder, attend(run.target, recorder, history):
            ending = drive(
                run.episode, recorder, history, stopped, lambda _, row: say(f"pushing, {row['time']:.1f} s")
            )
        if run.judge.fell and ending.error is None:
            return Ending(error=SimulationError("the robot fell; the log up to there is kept"))
        return ending
