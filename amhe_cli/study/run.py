"""One cell becomes one run, here or on another machine, if the code that decides its result is the same."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import amhe_cli
from amhe_cli.core.errors import ConfigError, Ending
from amhe_cli.core.yaml_file import nested
from amhe_cli.engine.cpu import hush_mujoco
from amhe_cli.estimation.online.horizon import Estimate
from amhe_cli.robots.go1.judge import History, run_record
from amhe_cli.robots.go1.model import SYSTEM
from amhe_cli.robots.go1.run import RunOptions, open_run
from amhe_cli.robots.go1.settings import settings_of
from amhe_cli.study.cells import Cell, cell_of
from amhe_cli.study.results import blank, thinned
from amhe_cli.system.provenance import sha256, system_files, versions
from amhe_cli.system.system import System

#: The rooms and files whose code runs in a cell; a test runs one and looks for others.
RUN_IN_CELLS = (
    "core", "logs", "system", "engine", "matching", "estimation", "control", "live", "robots",
    "study/__init__.py", "study/cells.py", "study/results.py", "study/run.py",
)  # fmt: skip


@cache
def code() -> dict[str, str]:
    """Versions of the libraries, and hashes of our sources and of the robot's model."""
    files = system_files(System.load(SYSTEM, warn=False))
    numbers = {name: version for name, version in versions().items() if name != "python"}
    return {**numbers, "sources": _hash(source_files(Path(amhe_cli.__file__).parent)), "model": _hash(files)}


def source_files(package: Path) -> dict[str, str]:
    """Hashes of the source files that run in cells, by their path in the package."""
    places = [package / name for name in RUN_IN_CELLS]
    files = [file for place in places for file in ([place] if place.is_file() else place.rglob("*.py"))]
    return {file.relative_to(package).as_posix(): sha256(file) for file in files}


def _hash(files: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()[:12]


def run_cell(request: Mapping[str, Any]) -> dict[str, Any]:
    """Run one cell; if the run itself fails, its record holds the reason.

    Args:
        request: `cell` (`Cell.plain`), and `code`: the versions and hashes that this machine must have too.

    Returns:
        The content of the cell's result file.

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
    except Exception as error:  # a run that fails must not end the others
        outcome, trace, reason = {}, {}, f"{type(error).__name__}: {error}"
    return blank(request, reason) | {
        "outcome": outcome,
        "trace": trace,
        "seconds": round(time.monotonic() - begun, 2),
    }


def _check_code(wanted: Mapping[str, str]) -> None:
    for name, version in wanted.items():
        if code()[name] != version:
            raise ConfigError(
                f"a worker runs {name} {code()[name]}, and this command {version}: "
                "install the same everywhere"
            )


def _run(cell: Cell) -> tuple[dict[str, Any], dict[str, Any]]:
    """Outcome and trace of a cell."""
    settings = dict(cell.setting)
    plant = settings.pop("plant", None)
    with _belief_file(cell.belief) as belief:
        run = open_run(
            RunOptions(
                cell.task, cell.mode, belief=belief, seed=cell.seed, duration=cell.duration,
                plant=plant, settings=nested(settings), belief_anyway=True,
            )
        )  # fmt: skip
    history, costs, sds = History(run.task), [], []
    names = run.system.space.names
    sd = np.full(len(names), np.nan)  # of the parameters, as last estimated; NaN before the first estimate
    for cycle in run.episode.cycles():
        history.add(cycle)
        costs.append(run.judge.last_cost)
        sds.append(sd)
        sd = next((one.sd for one in reversed(cycle.news) if isinstance(one, Estimate)), sd)
    outcome = run_record(run.judge.measures(), history, Ending())
    columns = {**history.columns(), "running_cost": np.array(costs)}
    if np.isfinite(sds).any():
        columns |= {f"belief_sd/{name}": column for name, column in zip(names, np.array(sds).T, strict=True)}
    if not run.task.one_leg:  # no figure shows the feet of a walking robot
        del columns["foot_x"], columns["foot_y"]
    return outcome, thinned(columns, settings_of(run.system).control.period)


@contextmanager
def _belief_file(content: str | None) -> Iterator[Path | None]:
    if content is None:
        yield None
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "belief.yaml"
        path.write_text(content, encoding="utf-8")
        yield path
