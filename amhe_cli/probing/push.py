"""Probing a box with a walking Go1: motions rehearsed in simulation, the best of them, its run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from amhe_cli.control.tasks import Believed, find_task
from amhe_cli.core.arrays import FloatArray
from amhe_cli.core.errors import ConfigError, SimulationError
from amhe_cli.live.drive import Ending, drive
from amhe_cli.live.history import History
from amhe_cli.probing.design import accuracy, criterion, ensemble
from amhe_cli.probing.information import information_at
from amhe_cli.probing.motions import APPROACH, MOTIONS, STEADY, Motion
from amhe_cli.probing.plan import Plan, parts_of
from amhe_cli.probing.probe import ProbeOptions, Say, believing, engine_of, read, tiles
from amhe_cli.probing.pushing import ProbeTask, probe_task
from amhe_cli.run_assembly import Run, RunOptions, open_run, system_of
from amhe_cli.run_files import recorder_of
from amhe_cli.system.system import System

#: The least time that is a push, and what is rehearsed of one, after the approach [s].
_SHORTEST, _REHEARSED = 1.0, 3.0


class PushProbe:
    """See `probe.Probe`.

    Args:
        options: As given.

    Raises:
        ConfigError: Unknown task, a belief that does not suit, a setting.
    """

    def __init__(self, options: ProbeOptions) -> None:
        self._options, self._task = options, find_task(options.task)
        self.task = options.task
        run = RunOptions(options.task, assignments=options.assignments, config=options.config)
        self._own = system_of(run, self._task)
        self.system: System = believing(self._own, options.belief)

    def design(self, say: Say) -> Plan:
        """See `Probe`."""
        options, space = self._options, self.system.space
        room = options.seconds - APPROACH.seconds
        if room < _SHORTEST:
            raise ConfigError(
                f"--for {options.seconds:g}: too short; the approach and the shortest push take "
                f"{APPROACH.seconds + _SHORTEST:g} s"
            )
        draws = ensemble(space, self.system.settings.probe.pairs, options.rng(0))
        found = []
        for number, motion in enumerate(MOTIONS):
            say(f"rehearsing {motion.name}, {number + 1} of {len(MOTIONS)}")
            found.append(np.stack([self._told(motion, i, z) for i, z in enumerate(draws)]) * room)
        best = int(np.argmax([criterion(told, space.prior_precision) for told in found]))
        chosen = MOTIONS[best]
        return Plan(
            parts_of([(m.name, m.title, s) for m, s in ((APPROACH, APPROACH.seconds), (chosen, room))]),
            accuracy(space, found[best]),
            accuracy(space, found[MOTIONS.index(STEADY)]),
            "straight push",
        )

    def run(self, plan: Plan, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """See `Probe`: closed-loop on the task's own box, under the belief."""
        motion = next(motion for motion in MOTIONS if motion.name == plan.parts[-1].name)
        own = Believed(self._task.box.mass, self._task.box.floor_friction)
        task = self._probe(motion, plan.seconds, own)
        return self._record(self._open(task, self._options.seed, "baseline"), path, stopped, say)

    def _told(self, motion: Motion, number: int, z: FloatArray) -> FloatArray:
        """Information of a second of a motion (d, d), if z (d,) were true and believed; none if it fell."""
        system, options = self.system, self._options
        named = dict(zip(system.space.names, system.space.theta_of(z), strict=True))
        box = Believed(float(named["box_mass"]), float(named["floor_friction"]))
        seconds = min(options.seconds, APPROACH.seconds + _REHEARSED)
        seed = int(options.rng(1 + number).integers(2**31))
        run = self._open(self._probe(motion, seconds, box), seed, "true")
        with TemporaryDirectory() as folder:
            path = Path(folder) / "rehearsal.mcap"
            ending = self._record(run, path, lambda: False, lambda text: None)
            log = read(system, path)
        windows = [w for w in tiles(system, log) if w.start * log.dt >= APPROACH.seconds]
        if ending.error is not None or not windows:
            return np.zeros((z.size, z.size))
        truth = system.space.z_of(np.array([run.first_truth[name] for name in system.space.names]))
        engine, rng = engine_of(system, options.threads), options.rng(5 + number)
        told = information_at(system, windows, engine, truth, rng).matrix.sum(axis=0)
        return told / sum(window.duration for window in windows)

    def _probe(self, motion: Motion, seconds: float, box: Believed) -> ProbeTask:
        prior = dict(zip(self._own.space.names, map(float, self._own.space.nominal), strict=True))
        believed = Believed(prior["box_mass"], prior["floor_friction"])
        return probe_task(self._task, motion, seconds, box, believed)

    def _open(self, task: ProbeTask, seed: int, mode: str) -> Run:
        own = self._options
        options = RunOptions(
            own.task, mode, seed=seed, threads=own.threads, duration=task.nominal_time,
            assignments=own.assignments, config=own.config,
        )  # fmt: skip
        if mode != "true":
            options = replace(options, belief=own.belief, plant=own.plant)
        return open_run(options, task)

    def _record(self, run: Run, path: Path, stopped: Callable[[], bool], say: Say) -> Ending:
        """Run to the end; a fall is an ending too."""
        history = History(run.task)
        with recorder_of(run, path) as recorder:
            ending = drive(
                run.episode, recorder, history, stopped, lambda _, row: say(f"pushing, {row['time']:.1f} s")
            )
        if run.judge.fell and ending.error is None:
            return Ending(error=SimulationError("the robot fell; the log up to there is kept"))
        return ending
