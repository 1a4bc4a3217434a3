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
from amhe_cli.control.tasks import LONGEST, find_task
from amhe_cli.core.errors import ConfigError, one_of
from amhe_cli.engine.quiet import hush_mujoco
from amhe_cli.evaluation.cells import Cell, Setting, cell_of, grid, setting_of
from amhe_cli.evaluation.results import blank, thinned
from amhe_cli.evaluation.store import Study
from amhe_cli.go1.model import SYSTEM
from amhe_cli.live.drive import Ending
from amhe_cli.live.history import History
from amhe_cli.report.belief_file import read_belief
from amhe_cli.report.provenance import run_provenance, sha256, versions
from amhe_cli.report.run_record import run_record
from amhe_cli.run_assembly import MODES, RunOptions, open_run
from amhe_cli.system import overrides
from amhe_cli.system.load import find_system, load_system
from amhe_cli.system.system import System
from amhe_cli.system.yaml_file import scalar

#: Rooms and files that only ask and tell: a change of theirs changes no result.
_ONLOOKERS = ("cli", "evaluation", "executors.py", "report")
#: Groups of settings whose keys `--ablate` takes without the group's name; the first that has one wins.
_SHORT = ("mhe", "control")


@dataclass(frozen=True, slots=True)
class EvalOptions:
    """What the user asked for.

    Args:
        tasks, modes: By name; no modes: all, and of an ablation that of `amhe run`.
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
    modes = list(options.modes) or (list(MODES) if not options.ablations else [RunOptions("").mode])
    for mode in modes:
        if mode not in MODES:
            raise ConfigError(one_of("mode", mode, MODES))
    exists = {name: [m for m in MODES if m != "stale" or find_task(name).stale] for name in options.tasks}
    settings = [study.setting, *_ablated(options.ablations, study.setting)]
    cells = grid(options.tasks, modes, options.seeds, settings, _beliefs(options), exists, options.duration)
    if not cells:
        raise ConfigError(
            f"nothing to run: there is no mode {' or '.join(modes)} of {', '.join(options.tasks)}"
        )
    return cells


def study_of(options: EvalOptions, command_line: str, made: str, machine: Mapping[str, str]) -> Study:
    """What all cells of this command share."""
    setting = _setting(overrides.gathered(options.config, os.environ, options.assignments))
    return Study(code(), _defaults(), setting, options.duration, (command_line,), made, machine)


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
    history, costs = History(run.task), []
    for cycle in run.episode.cycles():
        history.add(cycle)
        costs.append(run.judge.last_cost)
    outcome = run_record(run.judge.measures(), history, Ending())
    columns = {**history.columns(), "running_cost": np.array(costs)}
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


def _ablated(ablations: Sequence[str], base: Setting) -> Iterator[Setting]:
    """Settings that differ from the operating point in one value."""
    for typed in ablations:
        key, sign, values = typed.partition("=")
        listed = scalar(f"[{values}]")
        if not (key.strip() and sign and listed):
            raise ConfigError(f"--ablate {typed!r}: write KEY=VALUE,VALUE, for instance samples=8,16")
        path = _path(key.strip())
        for value in listed:
            yield _setting(overrides.parse_set([*_assignments(base), f"{path}={json.dumps(value)}"]))


def _path(key: str) -> str:
    """The setting that a key of `--ablate` means."""
    if "." in key:
        return key
    short = {p.partition(".")[2]: p for g in reversed(_SHORT) for p in _defaults() if p.startswith(f"{g}.")}
    if key not in short:
        raise ConfigError(f"--ablate: {one_of('parameter', key, short)}; or any other setting as GROUP.KEY")
    return short[key]


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


def _system(given: Mapping[str, Any]) -> System:
    return load_system(find_system(SYSTEM), given, warn=False)


def _leaves(system: System) -> Iterator[tuple[str, Any]]:
    return _flat(system.settings.model_dump(mode="json"))


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
