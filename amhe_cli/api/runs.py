"""Probing and closed-loop runs in simulation, and a log in three dimensions, as one call each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from amhe_cli.api.arguments import checked
from amhe_cli.core.belief import Belief
from amhe_cli.core.files import filling, plain
from amhe_cli.core.log import Log
from amhe_cli.core.shown import SavedView
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.estimation.design.design import known_record, plan_record
from amhe_cli.estimation.design.playback import log_name
from amhe_cli.estimation.design.probe import ActuatorProbe, ProbeOptions, achieved
from amhe_cli.system.system import System
from amhe_cli.view.open import view_of


def probe(
    system: System,
    *,
    seconds: float = 10.0,
    belief: Belief | str | Path | None = None,
    belief_anyway: bool = False,
    fix: Mapping[str, float] | None = None,
    only: Sequence[str] | None = None,
    seed: int = 0,
    threads: int | None = None,
    engine: str = "cpu",
    recipe: str = "multisine",
    speed: float | None = None,
    rate: float | None = None,
    excitation: str | Path | None = None,
    log: str | Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Design the excitation of a system's actuators that reveals most about the parameters, and simulate it.

    Args:
        system: A system whose actuators are driven as they are.
        seconds: Length of the excitation [s].
        belief: What is believed of the parameters; None: the system's prior.
        belief_anyway, fix, only, seed, threads, engine: As in `identify`.
        recipe: Kind of the excitation: 'chirp', 'multisine', 'steps' or 'sweep'. Simulated under draws of the
            prior, it reaches no limit of joints, speed or force, and touches nothing.
        speed: Largest speed of a joint [rad/s or m/s]; None: that of the settings, or else 3.14 of hinges,
            0.5 of slides.
        rate: Commands a second [Hz]; None: that of the settings.
        excitation: Folder for the commands: `excitation.csv`, `.npz` (times, joints, targets) and `.mcap`;
            None: they are not kept.
        log: File for the log of the simulated probe (.mcap; .csv where the system reads tables); None: it is
            not kept.
        progress: Called with a line of text now and then.

    Returns:
        The content of plan.json: `sequence`, and `parameters` with the prior sd, the expected sd and the sd
        that the simulated log achieves.

    Raises:
        ConfigError: The system has nothing to drive, or an argument is wrong.
        SimulationError: The simulation diverged.
    """
    hush_mujoco()
    seed, threads = checked(seed, threads, times={"seconds": seconds}, files={"log": log})
    start = Path(belief) if isinstance(belief, str) else belief
    options = ProbeOptions(
        seconds=seconds, belief=start, seed=seed, threads=threads, fix=fix or {}, only=only,
        belief_anyway=belief_anyway, engine=engine, recipe=recipe, speed=speed, rate=rate,
    )  # fmt: skip
    opened = ActuatorProbe(options, system)
    say = progress or (lambda text: None)
    plan = opened.design(say)
    if excitation is not None:
        with filling(Path(excitation)) as folder:
            opened.excitation().write(folder)
    with _file(log, log_name(opened.system.signals)) as path:
        ending = opened.run(plan, path, lambda: False, say)
        if ending.error:
            raise ending.error
        found = achieved(opened.system, path, options)
    known = {"expected": plan.expected, "plain": plan.plain, "achieved": found}
    return plain({"fixed": opened.system.fixed} | plan_record(plan) | known_record(known))


def run(
    task: str = "t1",
    mode: str = "adaptive",
    *,
    belief: Belief | str | Path | None = None,
    belief_anyway: bool = False,
    seed: int = 0,
    threads: int | None = None,
    engine: str = "cpu",
    duration: float | None = None,
    settings: Mapping[str, Any] | None = None,
    log: str | Path | None = None,
    progress: Callable[[Mapping[str, float]], None] | None = None,
) -> dict[str, Any]:
    """Let a simulated Go1 push a box through a task.

    Args:
        task: Name of the task: t1 to t5, hw1, hw2.
        mode: What the controller plans with: 'true', 'baseline', 'stale' or 'adaptive' parameters.
        belief: A belief in place of the task's own.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.
        seed: Seed of start poses, sensor noise and sampling.
        threads, engine: As in `identify`.
        duration: Longest time of the run [s]; None: the tasks' own limit.
        settings: Nested settings such as `{"mhe": {"window": 0.5}}`.
        log: File for the log (.mcap); None: it is not kept.
        progress: Called after each control cycle with its numbers, among them `time` [s] and `to_goal` [m].

    Returns:
        The measures of result.json: `success`, `goal_error_m`, `cost`, `time_s` and more.

    Raises:
        ConfigError: An argument is wrong.
        SimulationError: The simulation diverged.
    """
    from amhe_cli.live.recorder import drive
    from amhe_cli.robots.go1.judge import History, run_record
    from amhe_cli.robots.go1.run import RunOptions, open_run, recorder_of
    from amhe_cli.robots.go1.tasks import LONGEST

    hush_mujoco()
    seed, threads = checked(seed, threads, times={"duration": duration}, files={"log": log})
    options = RunOptions(
        task, mode, belief=Path(belief) if isinstance(belief, str) else belief, seed=seed, threads=threads,
        duration=LONGEST if duration is None else duration, settings={} if settings is None else settings,
        belief_anyway=belief_anyway, engine=engine,
    )  # fmt: skip
    opened = open_run(options)
    history, show = History(opened.task), progress or (lambda row: None)
    with closing(opened.episode.belief), _file(log) as path, recorder_of(opened, path) as recorder:
        ending = drive(opened.episode, recorder, history, lambda: False, lambda _, row: show(row))
    if ending.error:
        raise ending.error
    record = run_record(opened.judge.measures(), history, ending)
    return plain({"task": task, "mode": mode, "seed": seed, **record})


@contextmanager
def _file(log: str | Path | None, name: str = "log.mcap") -> Iterator[Path]:
    """The file of a log, or a temporary one."""
    if log is not None:
        yield Path(log)
        return
    with TemporaryDirectory() as folder:
        yield Path(folder) / name


def show(
    system: System,
    logs: Log | Sequence[Log],
    belief: Belief | str | Path | None = None,
    *,
    belief_anyway: bool = False,
    threads: int | None = None,
) -> SavedView:
    """Show logs in three dimensions, with ghosts of what the model predicts from each clip's first state.

    Args:
        system: Model, parameters, signals and settings.
        logs: Logs that were read for this system.
        belief: A belief, or the path of a belief.yaml: its ghost is shown beside the nominal one.
        belief_anyway: Take a belief about another model too, and only warn of what has changed.
        threads: CPU threads; None: all cores. The page does not depend on it.

    Raises:
        ConfigError: An argument is wrong.
        LogError: A log has no instant at which all of the state was measured.
    """
    hush_mujoco()
    _, threads = checked(0, threads)
    system, known = system.starting_from(belief, belief_anyway=belief_anyway)
    given = (logs,) if isinstance(logs, Log) else tuple(logs)
    return SavedView(view_of(system, given, belief=known, threads=threads).page())
