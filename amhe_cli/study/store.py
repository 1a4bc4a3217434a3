"""The folder of a study, and its cells run on any executor, each result kept as soon as it arrives.

`study.json` describes the study, `cells/` holds one result file for each cell.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from amhe_cli.core.errors import AmheError, ConfigError
from amhe_cli.core.files import write_whole
from amhe_cli.robots.go1.tasks import LONGEST
from amhe_cli.study.cells import Cell, Setting, setting_of
from amhe_cli.study.executors import Pool, gathered
from amhe_cli.study.results import CellResult, blank, read_result, result_of

STUDY, CELLS = "study.json", "cells"


@dataclass(frozen=True, slots=True)
class Study:
    """Description that all cells of a folder share.

    Args:
        code: Versions and hashes of what decides a result.
        defaults: Every setting's default, by its path.
        setting: The operating point: settings that the user changed for all cells.
        duration: Longest time of a run [s].
        commands: Command lines that ran cells here, oldest first.
        made: Time of the first one, UTC.
        machine: Hardware and operating system of the machine that ran the commands.
    """

    code: Mapping[str, str]
    defaults: Mapping[str, Any]
    setting: Setting = ()
    duration: float = LONGEST
    commands: tuple[str, ...] = ()
    made: str = ""
    machine: Mapping[str, str] = field(default_factory=dict)

    @property
    def cut_short(self) -> bool:
        """Whether runs were stopped before the tasks' own limit."""
        return self.duration < LONGEST


class Store:
    """Result files in a folder; each appears whole or not at all."""

    def __init__(self, folder: Path, study: Study) -> None:
        self.folder, self.study = folder, study

    def path(self, cell: Cell) -> Path:
        """Path of a cell's file."""
        return self.folder / CELLS / cell.file_name(self.study.code)

    def write(self, cell: Cell, record: Mapping[str, Any]) -> None:
        """Write the record of a cell.

        Raises:
            AmheError: The record cannot be written, as on a full disk.
        """
        write_file(self.path(cell), json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n")

    def results(self) -> list[CellResult]:
        """Results so far, sorted by the names of their files.

        Raises:
            AmheError: A result cannot be read.
        """
        return [read_result(file) for file in sorted((self.folder / CELLS).glob("*.json"))]

    def missing(self, cells: list[Cell]) -> list[Cell]:
        """Cells that have no result yet, or failed."""
        done = {self.path(result.cell) for result in self.results() if result.reason is None}
        return [cell for cell in cells if self.path(cell) not in done]


def open_store(folder: Path) -> Store:
    """The study in a folder.

    Raises:
        ConfigError: The folder holds no study.
    """
    path = folder / STUDY
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        record["setting"] = setting_of(record["setting"])
        return Store(folder, TypeAdapter(Study).validate_python(record))
    except OSError:
        raise ConfigError(f"{folder}: holds no {STUDY}; name a folder that `amhe eval -o` wrote") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise ConfigError(f"{path}: cannot be read; start over in another folder") from None


def start(folder: Path, study: Study, resume: bool, force: bool, cells: Sequence[Cell] = ()) -> Store:
    """The store to write to: a new one, or one to continue.

    Args:
        resume: Continue with the content of the folder.
        force: Overwrite the content of the folder.

    Raises:
        ConfigError: The folder is not empty, or holds a study that this one must not be mixed with.
    """
    if folder.is_file():
        raise ConfigError(f"{folder}: is a file; -o needs a folder")
    if folder.exists() and any(folder.iterdir()) and not force:
        if not resume:
            raise ConfigError(
                f"{folder}: is not empty; give `resume=True` to go on, or choose another folder"
            )
        store = open_store(folder)
        before = store.study
        _check(folder, before, study)
        _check_beliefs(store, cells)
        commands = tuple(dict.fromkeys((*before.commands, *study.commands)))
        study = replace(before, commands=commands)
    try:
        (folder / CELLS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror}); choose another with -o") from None
    if force:
        for path in (folder / CELLS).glob("*.json"):
            path.unlink()
    record = asdict(study) | {"setting": dict(study.setting)}
    write_file(folder / STUDY, json.dumps(record, indent=1) + "\n")
    return Store(folder, study)


def _check(folder: Path, before: Study, now: Study) -> None:
    """Refuse to mix what cannot be compared."""
    go_on = f"choose another folder, or see what it holds with `report` {folder}"
    for name, version in now.code.items():
        if before.code.get(name) != version:
            raise ConfigError(
                f"{folder}: holds cells of {name} {before.code.get(name)}, and this is {version}: {go_on}"
            )
    if (before.setting, before.duration) != (now.setting, now.duration):
        raise ConfigError(
            f"{folder}: holds cells of other settings or another `duration`; give the same, or {go_on}"
        )


def _check_beliefs(store: Store, cells: Sequence[Cell]) -> None:
    """Refuse a second belief for a run that exists: tables would count its seed twice."""
    known = {replace(one.cell, belief=None): one.cell.belief for one in store.results()}
    for cell in cells:
        if known.get(replace(cell, belief=None), cell.belief) != cell.belief:
            raise ConfigError(
                f"{store.folder}: holds {cell.title} with another `belief`: give the same, or choose another "
                "folder with -o"
            )


def write_file(path: Path, text: str) -> None:
    """Write a file of a study, whole or not at all.

    Raises:
        AmheError: The file cannot be written.
    """
    try:
        write_whole(path, text)
    except OSError as error:
        raise AmheError(
            f"{path}: {error.strerror}; the cells before it are kept: mend that, and go on with `resume=True`"
        ) from None


def conduct(
    store: Store,
    cells: Sequence[Cell],
    run: Callable[[Mapping[str, Any]], dict[str, Any]],
    pool: Pool,
    stopped: Callable[[], bool],
    on_result: Callable[[CellResult], None],
) -> None:
    """Run cells; one that fails is recorded with its reason and does not stop the others.

    Args:
        store: Store of the results; it is written to from here, so that workers need no common disk.
        run: Runs one cell: from a request to the content of a result file.
        pool: Executor that the cells are run on.
        stopped: Called now and then; returns whether to give up the cells that are running.
        on_result: Called with each result.

    Raises:
        AmheError: A failure that would stop every cell: other code on a worker, a full disk, a scheduler that
            is gone.
    """
    requests = {cell: {"cell": cell.plain(), "code": dict(store.study.code)} for cell in cells}
    for cell, brought in gathered(run, requests, pool, stopped):
        if isinstance(brought, AmheError):
            raise brought
        if isinstance(brought, Exception):
            brought = blank(requests[cell], f"{type(brought).__name__}: {brought}")
        store.write(cell, brought)
        on_result(result_of(brought))
