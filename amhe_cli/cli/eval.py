"""`amhe eval`: tasks by modes by seeds, on this machine or a cluster, and what they say together."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import completion, options
from amhe_cli.cli.command import Given, command, flag, option
from amhe_cli.cli.kinds import COUNT, FOLDER, listed, pairs
from amhe_cli.cli.progress import Shown, progress
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.study.results import CellResult
    from amhe_cli.study.store import Store


def _beliefs(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> dict[str, Path]:
    """TASK=FILE, repeated, as a dictionary."""
    files = pairs(Path)(ctx, param, value)
    for file in files.values():
        if not file.is_file():
            raise click.BadParameter(f"there is no file '{file}'", ctx, param)
    return files


@command(
    "Tasks by modes by seeds: tables and figures.",
    option(
        "--tasks T,...",
        "As of amhe run.",
        shell_complete=completion.listed(options.TASKS),
        callback=listed,
        default="t1,t2,t3,t4,t5",
    ),
    option(
        "--modes M,...",
        "Likewise.  [default: all; with --ablate, adaptive]",
        shell_complete=completion.listed(options.MODES),
        callback=listed,
    ),
    option("--seeds", "Seeds 0 to N - 1 of each, the same for all modes.", COUNT, default=15),
    option("--plants P,...", "Robots to run on, as of amhe run --plant.  [default: ours]", callback=listed),
    option(
        "ablations --ablate KEY=V,... ...",
        "Try values of one setting, all others at the operating point; repeat for more. A key without a dot "
        "is a setting of mhe, or else of control, or one of the paper's: L_MHE, B, dt_update, H, alpha, "
        "w_mass, w_friction.",
    ),
    option(
        "beliefs --belief TASK=FILE ...",
        "A belief.yaml that the baseline of a task believes; repeat for more.",
        callback=_beliefs,
    ),
    options.robot,
    options.duration,
    options.engine,
    options.spread,
    flag("--resume", "Go on in OUT: run what is missing or has failed."),
    option("--report OUT", "Run nothing; make summary, tables and figures of OUT again.", FOLDER),
    options.tuning,
    options.output,
    name="eval",
)
def evaluate(session: Session, given: Given) -> None:
    """Run tasks in modes over seeds, and make the paper's tables and figures of what came out.

    Each run is a cell with a result file of its own in OUT/cells; what is done is kept, whatever stops the
    rest. Writes summary.json, tables (Markdown, LaTeX, CSV) and report.html with the figures.
    Exit code 1 where a cell brought no result.
    """
    from amhe_cli.study.executors import pool_of
    from amhe_cli.study.plan import EvalOptions, planned, study_of
    from amhe_cli.study.run import run_cell
    from amhe_cli.study.store import conduct, open_store, start
    from amhe_cli.system.provenance import machine, now

    if given.engine != "cpu":
        raise click.UsageError("eval runs one cell on each core of its workers: leave --engine out")
    if given.report:
        return _tell(session, open_store(given.report), 0)
    if given.resume and given.out is None:
        raise click.UsageError("--resume goes on in a folder: name it with -o OUT")
    wanted = given.pick("tasks", "modes", "seeds", "plants", "ablations", "beliefs")
    chosen = EvalOptions(settings=given.overrides.all, duration=given.seconds, **wanted)
    study = study_of(chosen, session.command_line, now(), machine())
    cells = planned(chosen, study)
    store = start(given.out or given.reserve(), study, given.resume, given.force, cells)
    missing = store.missing(cells)
    if len(missing) < len(cells):
        session.say("", f"{len(cells) - len(missing)} of {len(cells)} cells are done already")
    shown = _counted(len(missing))
    with stopping(session) as stopped, progress(session, "eval", shown, every=True) as on_result:
        conduct(store, missing, run_cell, pool_of(given.workers, given.cluster), stopped, on_result)
    left = len(store.missing(cells))
    session.interrupted = stopped()
    _tell(session, store, left)
    if session.interrupted:
        session.say(
            "", f"interrupted with {left} of {len(cells)} cells to go: go on with --resume -o {store.folder}"
        )


def _counted(total: int) -> Callable[[CellResult], Shown]:
    """What is shown of a result: '3/60: t1 true seed 2: success, 0.021 m from the goal, ...; 12 min left'."""
    count, begun = 0, time.monotonic()

    def shown(result: CellResult) -> Shown:
        nonlocal count
        count += 1
        minutes = (time.monotonic() - begun) / count * (total - count) / 60.0
        left = f"about {minutes:.0f} min left" if minutes < 90.0 else f"about {minutes / 60.0:.1f} h left"
        return f"{count}/{total}: {result.cell.title}: {_outcome(result)}; {left}", count, total

    return shown


def _outcome(result: CellResult) -> str:
    if result.reason is not None:
        return f"failed: {result.reason}"
    word = "success" if result.measure("success") else "fell" if result.measure("fell") else "no success"
    return f"{word}, {result.measure('goal_error_m'):.3f} m from the goal, {result.measure('time_s'):.1f} s"


def _tell(session: Session, store: Store, left: int) -> None:
    """Write and print what the cells say; fail where some brought nothing."""
    from amhe_cli.report.study.page import write_study
    from amhe_cli.report.tables import rich_table
    from amhe_cli.robots.go1.run import MODES
    from amhe_cli.robots.go1.tasks import TASKS as ALL

    report = write_study(store, {name: task.floor for name, task in ALL.items()}, MODES)
    counts: dict[str, Any] = {"cells": report.cells, "failed": report.failures, "missing": left}
    if not session.gave(session.record(**counts, summary=report.summary, out=str(store.folder))):
        console = session.console()
        for table in report.tables:
            console.print(f"{table.title}\n")
            console.print(rich_table(table.table))
            console.print(f"{table.note}\n" if table.note else "", soft_wrap=True)
        print(f"report: {store.folder / 'report.html'}")
    session.failed = bool(report.failures) or (left > 0 and not session.interrupted)
    for title, reason in report.failures.items():
        session.say("error", f"{title}: {reason}")
