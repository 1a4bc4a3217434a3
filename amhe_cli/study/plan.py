"""The cells of a study: tasks by modes by seeds by settings, and how these differ from the defaults."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from amhe_cli.core.belief import Belief
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.core.yaml_file import nested, scalar
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.robots.go1.plant import find_plant
from amhe_cli.robots.go1.run import MODES
from amhe_cli.robots.go1.settings import PushSettings
from amhe_cli.robots.go1.tasks import LONGEST, find_task
from amhe_cli.study.cells import Cell, Setting, setting_of
from amhe_cli.study.run import code
from amhe_cli.study.store import Study
from amhe_cli.system.system import System

#: The paper's own symbols for its seven hyper-parameters.
_SYMBOLS = {
    "L_MHE": "mhe.iterations", "B": "mhe.samples", "dt_update": "mhe.update_period", "H": "mhe.window",
    "alpha": "mhe.learning_rate", "w_mass": "mhe.prior_weight.box_mass",
    "w_friction": "mhe.prior_weight.floor_friction",
}  # fmt: skip


def setting_from(given: Mapping[str, Any]) -> Setting:
    """The settings that differ from the defaults, with the values that the schema makes of them (16.0 is 16).

    Args:
        given: Nested mapping of settings.
    """
    system = system_with(given)
    changed = {path: value for path, value in _leaves(system) if _defaults().get(path) != value}
    others = {key: value for key, value in given.items() if key not in type(system.settings).model_fields}
    return setting_of(changed | dict(_flat(others)))


def defaults_at(setting: Setting) -> dict[str, Any]:
    """Every setting's default, by its path; where a default depends on others, its value under `setting`."""
    mhe = system_with(nested(dict(setting))).settings.mhe
    counts = {"mhe.samples": mhe.sample_count, "mhe.iterations": mhe.iteration_count}
    given = dict(setting)
    default = _defaults() | {"plant": "ours"}
    return default | {path: count for path, count in counts.items() if path not in given}


def ablated(ablations: Sequence[str], base: Setting, defaults: Mapping[str, Any]) -> Iterator[Setting]:
    """Settings that differ from the operating point in one value, or not at all.

    Args:
        ablations: Texts such as 'samples=8,16'.
        base: The operating point.
        defaults: Every setting's default at the operating point, by its path.

    Raises:
        ConfigError: A text does not have that form, there is no such setting, or it has no effect here.
    """
    for text in ablations:
        key, sign, values = text.partition("=")
        listed = scalar(f"[{values}]")
        if not (key.strip() and sign and listed):
            raise ConfigError(f"ablation {text!r}: write KEY=VALUE,VALUE, for instance samples=8,16")
        path = _path(key.strip())
        _check_acts(path, base)
        for value in listed:
            setting = setting_from(nested(dict(base) | {path: value}))
            is_base = path not in dict(base) and dict(setting).get(path) == defaults.get(path)
            yield base if is_base else setting


def with_plant(setting: Setting, plant: str) -> Setting:
    """A setting of runs on a plant, of which our own is the default.

    Raises:
        ConfigError: There is no such plant.
    """
    find_plant(plant)
    return setting if plant == "ours" else setting_of({**dict(setting), "plant": plant})


def system_with(given: Mapping[str, Any]) -> System:
    """The robot's system with settings from a nested mapping."""
    return System.load(SYSTEM, given, schema=PushSettings, warn=False)


def _check_acts(path: str, base: Setting) -> None:
    """Refuse to ablate a setting without effect.

    Raises:
        ConfigError: The setting belongs to the other estimation method.
    """
    group, _, name = path.partition(".")
    mhe = system_with(nested(dict(base))).settings.mhe
    if group == "mhe" and mhe.idle([name]):
        other = {"linearised": "logrank", "logrank": "linearised"}[mhe.method]
        raise ConfigError(
            f"ablation of {name}: it does nothing with the method {mhe.method}; set mhe.method={other}"
        )


def _path(key: str) -> str:
    """The setting that the key of an ablation means: a path, a short name or a symbol of the paper."""
    short = _short_names()
    if key not in short and "." not in key:
        raise ConfigError(f"ablation: {one_of('parameter', key, short)}; or any other setting as GROUP.KEY")
    return short.get(key, key)


@cache
def _short_names() -> dict[str, str]:
    """Name -> path: settings of mhe and control without their group (mhe wins), and the paper's symbols."""
    names = {}
    for group in ("control.", "mhe."):
        names |= {path.removeprefix(group): path for path in _defaults() if path.startswith(group)}
    return names | _SYMBOLS


@cache
def _defaults() -> dict[str, Any]:
    return dict(_leaves(system_with({})))


def _leaves(system: System) -> Iterator[tuple[str, Any]]:
    """Paths and values of all settings, with one prior weight for each parameter."""
    yield from _flat(system.settings.model_dump(mode="json", exclude={"mhe": {"prior_weight"}}))
    names = system.space.names
    for name, weight in zip(names, system.settings.mhe.weights(names), strict=True):
        yield f"mhe.prior_weight.{name}", weight


def _flat(nested: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted paths and values of a nested mapping."""
    for key, value in nested.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


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
        Belief.load(path, system, belief_anyway=True)
    return {task: path.read_text(encoding="utf-8") for task, path in files.items()}
