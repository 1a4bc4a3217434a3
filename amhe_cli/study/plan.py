"""What the user asked `amhe eval` for becomes cells; a cell becomes a run, here or on another machine."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import amhe_cli
from amhe_cli.core.belief_file import read_belief
from amhe_cli.core.errors import ConfigError, Ending, one_of
from amhe_cli.core.yaml_file import scalar
from amhe_cli.engine.quiet import hush_mujoco
from amhe_cli.robots.go1.history import History
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.robots.go1.record import run_record
from amhe_cli.robots.go1.run import MODES, RunOptions, open_run
from amhe_cli.robots.go1.tasks import LONGEST, find_task
from amhe_cli.study.cells import Cell, Setting, cell_of, grid, setting_of
from amhe_cli.study.results import blank, thinned
from amhe_cli.study.store import Study
from amhe_cli.system import overrides
from amhe_cli.system.load import find_system, load_system
from amhe_cli.system.provenance import run_provenance, sha256, versions
from amhe_cli.system.system import System

#: Rooms and files that only ask and tell, or are of another target: a change of theirs changes no result.
_ONLOOKERS = (
    "cli", "evaluation", "executors.py", "report",
    "emulator", "go1_assembly.py", "go1_link", "poses", "probing",
)  # fmt: skip
#: Groups of settings whose keys `--ablate` takes without the group's name; the first that has one wins.
_SHORT = ("mhe", "control")
#: The paper's own symbols for its seven hyper-parameters.
_SYMBOLS = {
    "L_MHE": "mhe.iterations", "B": "mhe.samples", "dt_update": "mhe.update_period", "H": "mhe.window",
    "alpha": "mhe.learning_rate", "w_mass": "mhe.prior_weight.box_mass",
    "w_friction": "mhe.prior_weight.floor_friction",
}  # fmt: skip
#: The mode that an ablation is of where none is named: the one that has all the settings.
_ABLATED = "adaptive"


@dataclass(frozen=True, slots=True)
class EvalOptions:
    """What the user asked for.

    Args:
        tasks, modes: By name; no modes: all, and of an ablation the adaptive one.
        seeds: How many.
        ablations: As typed, 'samples=8,16'.
        beliefs: Task -> file of a belief that replaces the baseline's numbers.
        duration: The longest that a cell may take [s].
        assignments, config: Settings of all cells, as everywhere.
    """

    tasks: Sequence[str]
    modes: Sequence[str] = ()
    seeds: int = 15
    ablations: Sequence[str] = ()
    beliefs: Mapping[str, Path] | None = None
    duration: float = LONGEST
    assignments: Sequence[str] = ()
    config: Path | None = None


def planned(options: EvalOptions, study: Study) -> list[Cell]:
    """All cells of a study.

    Raises:
        ConfigError: An unknown task, mode or parameter, a value that is none, a belief that does not suit,
            or nothing to run.
    """
    modes = list(options.modes) or ([_ABLATED] if options.ablations else list(MODES))
    for mode in modes:
        if mode not in MODES:
            raise ConfigError(one_of("mode", mode, MODES))
    exists = {name: [m for m in MODES if m != "stale" or find_task(name).stale] for name in options.tasks}
    settings = [study.setting, *_ablated(options.ablations, study)]
    cells = grid(options.tasks, modes, options.seeds, settings, _beliefs(options), exists, options.duration)
    if not cells:
        raise ConfigError(
            f"nothing to run: there is no mode {' or '.join(modes)} of {', '.join(options.tasks)}"
        )
    return cells


def study_of(options: EvalOptions, command_line: str, made: str, machine: Mapping[str, str]) -> Study:
    """What all cells of this command share."""
    setting = _setting(overrides.gathered(options.config, os.environ, options.assignments))
    return Study(code(), _meant(setting), setting, options.duration, (command_line,), made, machine)


def run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    """Run one cell; what the run itself breaks on is told in its record.

    Args:
        request: `cell` (Cell.plain) and `code`, that the cell is to be run with.

    Returns:
        The content of its result file.

    Raises:
        ConfigError: This machine has other code, or the cell cannot be set up.
    """
    _check_code(request["code"])
    hush_mujoco()
    begun = time.monotonic()
    cell = cell_of(request["cell"])
    try:
        outcome, trace = _run(cell)
        reason = None
    except ConfigError:
        raise
    except Exception as error:  # whatever breaks one run must not end the others
        outcome, trace, reason = {}, {}, f"{type(error).__name__}: {error}"
    return blank(request, reason) | {
        "outcome": outcome,
        "trace": trace,
        "seconds": round(time.monotonic() - begun, 2),
    }


def _run(cell: Cell) -> tuple[dict[str, Any], dict[str, Any]]:
    with _belief_file(cell.belief) as belief:
        run = open_run(
            RunOptions(
                cell.task, cell.mode, belief=belief, seed=cell.seed, duration=cell.duration,
                assignments=_assignments(cell.setting), environment={},
            )
        )  # fmt: skip
    history, costs, doubts = History(run.task), [], []
    doubt = np.full(len(run.episode.names), np.nan)  # of what is believed, where somebody estimates it
    for cycle in run.episode.cycles():
        history.add(cycle)
        costs.append(run.judge.last_cost)
        doubts.append(doubt)
        doubt = next((news.estimate.sd for news in reversed(cycle.news) if news.estimate), doubt)
    outcome = run_record(run.judge.measures(), history, Ending())
    columns = {**history.columns(), "running_cost": np.array(costs)}
    if np.isfinite(doubts).any():
        columns |= {
            f"belief_sd/{name}": sd for name, sd in zip(run.episode.names, np.array(doubts).T, strict=True)
        }
    if not run.task.one_leg:  # no figure shows the feet of a walking robot
        del columns["foot_x"], columns["foot_y"]
    return outcome, thinned(columns, run.system.settings.control.period)


def _check_code(asked: Mapping[str, str]) -> None:
    for name, wanted in asked.items():
        if code()[name] != wanted:
            raise ConfigError(
                f"a worker runs {name} {code()[name]}, and this command {wanted}: install the same everywhere"
            )


@cache
def code() -> dict[str, str]:
    """Versions and hashes of all that decides a result, besides its cell."""
    package = Path(amhe_cli.__file__).parent
    sources = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        place = path.relative_to(package)
        if place.parts[0] not in _ONLOOKERS:
            sources.update(f"{place.as_posix()} {sha256(path)}\n".encode())
    files = run_provenance("", 0, find_system(SYSTEM), ())["system_files"]
    model = hashlib.sha256(json.dumps(files, sort_keys=True).encode())
    numbers = {name: version for name, version in versions().items() if name != "python"}
    return {**numbers, "sources": sources.hexdigest()[:12], "model": model.hexdigest()[:12]}


def _ablated(ablations: Sequence[str], study: Study) -> Iterator[Setting]:
    """Settings that differ from the operating point in one value, or not at all."""
    for typed in ablations:
        key, sign, values = typed.partition("=")
        listed = scalar(f"[{values}]")
        if not (key.strip() and sign and listed):
            raise ConfigError(f"--ablate {typed!r}: write KEY=VALUE,VALUE, for instance samples=8,16")
        path = _path(key.strip())
        _check_acts(path, study)
        for value in listed:
            typed = [*_assignments(study.setting), f"{path}={json.dumps(value)}"]
            setting = _setting(overrides.parse_set(typed))
            same = path not in dict(study.setting) and dict(setting).get(path) == study.defaults.get(path)
            yield study.setting if same else setting


def _check_acts(path: str, study: Study) -> None:
    """Refuse to ablate what does nothing.

    Raises:
        ConfigError: The setting is of the other method.
    """
    group, _, name = path.partition(".")
    mhe = _system(overrides.parse_set(_assignments(study.setting))).settings.mhe
    if group == "mhe" and mhe.idle([name]):
        other = {"linearised": "logrank", "logrank": "linearised"}[mhe.method]
        raise ConfigError(
            f"--ablate {name}: it does nothing with the method {mhe.method}; add --set mhe.method={other}"
        )


def _path(key: str) -> str:
    """The setting that a key of `--ablate` means."""
    short = {p.partition(".")[2]: p for g in reversed(_SHORT) for p in _defaults() if p.startswith(f"{g}.")}
    short |= _SYMBOLS
    if key in short or "." in key:
        return short.get(key, key)
    raise ConfigError(f"--ablate: {one_of('parameter', key, short)}; or any other setting as GROUP.KEY")


def _assignments(setting: Setting) -> list[str]:
    return [f"{path}={json.dumps(value)}" for path, value in setting]


def _setting(given: Mapping[str, Any]) -> Setting:
    """How settings differ from the defaults, each as the schema reads it: 16.0 samples are 16."""
    system, defaults = _system(given), _defaults()
    changed = {path: value for path, value in _leaves(system) if defaults.get(path) != value}
    others = {key: value for key, value in given.items() if key not in type(system.settings).model_fields}
    return setting_of(changed | dict(_flat(others)))


@cache
def _defaults() -> dict[str, Any]:
    return dict(_leaves(_system({})))


def _meant(setting: Setting) -> dict[str, Any]:
    """Defaults, with what "none" stands for at an operating point."""
    mhe = _system(overrides.parse_set(_assignments(setting))).settings.mhe
    counts = {"mhe.samples": mhe.sample_count, "mhe.iterations": mhe.iteration_count}
    return _defaults() | {path: count for path, count in counts.items() if path not in dict(setting)}


def _system(given: Mapping[str, Any]) -> System:
    return load_system(find_system(SYSTEM), given, warn=False)


def _leaves(system: System) -> Iterator[tuple[str, Any]]:
    """Paths and values of all settings, those that name a parameter included."""
    yield from _flat(system.settings.model_dump(mode="json", exclude={"mhe": {"prior_weight"}}))
    names = system.space.names
    for name, weight in zip(names, system.settings.mhe.weights(names), strict=True):
        yield f"mhe.prior_weight.{name}", weight


def _flat(nested: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Paths and values of what is no mapping."""
    for key, value in nested.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def _beliefs(options: EvalOptions) -> dict[str, str]:
    """Content of the belief files, read here: workers have no disk in common."""
    system, contents = _system({}), {}
    for task, path in (options.beliefs or {}).items():
        find_task(task)
        read_belief(path, system)  # what is wrong with it is said now, not in the first cell
        contents[task] = path.read_text(encoding="utf-8")
    return contents


@contextmanager
def _belief_file(content: str | None) -> Iterator[Path | None]:
    if content is None:
        yield None
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "belief.yaml"
        path.write_text(content, encoding="utf-8")
        yield path
