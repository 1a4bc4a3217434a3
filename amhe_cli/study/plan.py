"""The cells of a study: tasks by modes by seeds by settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amhe_cli.core.belief import read_belief
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.robots.go1.run import MODES
from amhe_cli.robots.go1.tasks import LONGEST, find_task
from amhe_cli.study.cells import Cell
from amhe_cli.study.code import code
from amhe_cli.study.settings import ablated, defaults_at, setting_from, system_with, with_plant
from amhe_cli.study.store import Study

#: The mode of an ablation for which no mode is named: the only one in which every setting acts.
_ABLATED = "adaptive"
#: Modes that have a belief of their own, not that of an identification.
_OWN_BELIEF = ("true", "stale")


@dataclass(frozen=True, slots=True)
class EvalOptions:
    """The request for a study.

    Args:
        tasks, modes: Names of tasks and modes; no `modes`: all, or the adaptive mode where there are
            ablations.
        seeds: Number of seeds, from 0 on.
        plants: Plants to run on, by name or file; none: our own.
        ablations: Settings to try, each a text such as 'samples=8,16'.
        beliefs: Task -> belief file that replaces the baseline's parameters.
        duration: Time limit of each run [s].
        settings: Settings of all cells, as a nested mapping.
    """

    tasks: Sequence[str]
    modes: Sequence[str] = ()
    seeds: int = 15
    plants: Sequence[str] = ()
    ablations: Sequence[str] = ()
    beliefs: Mapping[str, Path] = field(default_factory=dict)
    duration: float = LONGEST
    settings: Mapping[str, Any] = field(default_factory=dict)


def planned(options: EvalOptions, study: Study) -> list[Cell]:
    """All cells of a study, seed by seed, so that its first part already covers each mode.

    Raises:
        ConfigError: A task, mode, setting or value does not exist, a belief file does not fit, or the request
            leaves nothing to run.
    """
    modes = list(options.modes) or ([_ABLATED] if options.ablations else list(MODES))
    for mode in modes:
        if mode not in MODES:
            raise ConfigError(one_of("mode", mode, MODES))
    tasks = {name: find_task(name) for name in options.tasks}
    settings = [study.setting, *ablated(options.ablations, study.setting, study.defaults)]
    settings = [with_plant(setting, plant) for plant in options.plants or ["ours"] for setting in settings]
    beliefs = _belief_texts(options.beliefs)
    cells = [
        Cell(task, mode, seed, setting, None if mode in _OWN_BELIEF else beliefs.get(task), options.duration)
        for seed in range(options.seeds)
        for setting in dict.fromkeys(settings)
        for task in tasks
        for mode in modes
        if mode != "stale" or tasks[task].stale
    ]
    if not cells:
        raise ConfigError(
            f"nothing to run: there is no mode {' or '.join(modes)} of {', '.join(options.tasks)}"
        )
    return cells


def study_of(options: EvalOptions, command_line: str, made: str, machine: Mapping[str, str]) -> Study:
    """The description that all cells of a request share.

    Args:
        options: The request.
        command_line: The command that makes it.
        made: The current time (UTC).
        machine: Hardware and operating system of this machine.
    """
    setting = setting_from(options.settings)
    return Study(code(), defaults_at(setting), setting, options.duration, (command_line,), made, machine)


def _belief_texts(files: Mapping[str, Path]) -> dict[str, str]:
    """Contents of belief files by task, for workers on other machines.

    Raises:
        ConfigError: A file is no belief of this system; better now than in the first cell.
    """
    system = system_with({})
    for task, path in files.items():
        find_task(task)
        read_belief(path, system, belief_anyway=True)
    return {task: path.read_text(encoding="utf-8") for task, path in files.items()}
