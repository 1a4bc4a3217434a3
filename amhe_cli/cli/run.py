"""`amhe run`: a Go1, simulated or real, pushes a box through a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import at_the_robot, options
from amhe_cli.cli.command import Given, command, option
from amhe_cli.cli.session import Session, stopping
from amhe_cli.cli.watching import watched, watching_run

if TYPE_CHECKING:
    from amhe_cli.cli.progress import Shown
    from amhe_cli.core.errors import Ending
    from amhe_cli.live.episode import Cycle
    from amhe_cli.report.run import TaskFacts
    from amhe_cli.robots.go1.judge import History
    from amhe_cli.robots.go1.run import Run

_TASKS = (
    "t1: straight to a goal; t2: along a circle; t3: the mass changes; t4: the floor changes; "
    "t5: with one front leg; hw1, hw2: load and turf, as on hardware."
)


@command(
    "A Go1 pushes a box: closed-loop control under a belief.",
    option("--task", _TASKS, options.TASKS, required=True),
    at_the_robot.target("What is controlled."),
    at_the_robot.REACH,
    at_the_robot.dry_run_option(at_the_robot.CHECKS),
    option(
        "--mode",
        "What the controller plans with: the plant's own parameters, the task's fixed wrong ones, or the "
        "newest estimate, starting from the baseline's.",
        options.MODES,
        default="adaptive",
    ),
    options.believed("A belief.yaml in place of the task's own for modes baseline, stale and adaptive."),
    options.unknowns,
    options.robot,
    options.work,
    options.duration,
    option(
        "--plant NAME|XML",
        "Another Go1 to simulate, of the family (docs/tasks.md) or by its MJCF; the planner keeps its own.",
    ),
    watched,
    options.method,
    options.tuning,
    options.output,
)
def run(session: Session, given: Given) -> None:
    """Run a task to its end and say how well it went.

    Writes log.mcap, result.json and report.html. Exit code 1 where the robot falls, the simulation
    diverges, or the task is not done within its own time; a run that --seconds cut short is no failure.
    A real robot (--target go1): read docs/go1.md first.
    """
    from amhe_cli.core.files import filling
    from amhe_cli.report.run import print_run, verdict, write_run
    from amhe_cli.robots.go1.judge import run_record
    from amhe_cli.robots.go1.run import RunOptions, open_run
    from amhe_cli.system.provenance import estimator_provenance

    task, mode, target, dry_run = given.task, given.mode, given.target, given.dry_run
    belief, seed, plant, overrides = given.belief, given.seed, given.plant, given.overrides
    if mode != "adaptive" and "method" in overrides.chosen.get("mhe", {}):
        raise click.UsageError("--method is for the online estimator, which only --mode adaptive runs")
    if dry_run and target != "go1":
        raise click.UsageError("--dry-run is of a real robot: give --target go1 too")
    folder = given.reserve()
    how = given.pick("plant", "threads", "engine", "belief_anyway")
    chosen = RunOptions(
        task, mode, target, belief, seed, duration=given.seconds, settings=overrides.all, **how
    )
    if reached := at_the_robot.wire_of(target, given):
        from amhe_cli.robots.go1.link.open import open_go1_run  # a simulation loads no link

        opened = open_go1_run(chosen, reached)
    else:
        opened = open_run(chosen)
    # the estimator's process has begun: it ends with the command, whatever step of opening fails
    click.get_current_context().with_resource(closing(opened.episode.belief))
    if dry_run:
        return at_the_robot.dry_run(session, opened)
    with stopping(session) as stopped, filling(folder, keep=True, force=given.force) as scratch:
        ending, history, link = _driven(session, opened, scratch, stopped, given.view)
        if isinstance(ending.error, OSError):  # as on a full disk: no page either, but the log is kept
            raise ending.error
        session.interrupted = ending.interrupted
        record = session.record(
            task=task, mode=mode, target=target, seed=seed, lock_step=not opened.live,
            **run_record(opened.judge.measures(), history, ending),
            duration=given.seconds, cut_short=given.seconds < options.LONGEST, out=str(folder), **link,
        )  # fmt: skip
        files = [Path(p) for p in (belief, plant) if p and Path(p).is_file()]
        origin = estimator_provenance(session.command_line, seed, "mpopi", opened.system, files)
        error = ending.error
        try:
            write_run(scratch, _facts(opened, link), history.columns(), record, origin)
        except Exception as fault:  # a fault of the page must not cost the log
            error = error or fault
    if not session.gave(record):
        print_run(record, _facts(opened, link), folder, session.console())
    if at_the_robot.is_trip(error):
        session.failed = True
        return
    if error:
        raise error
    tone, text = verdict(record)
    session.failed = tone == "bad"
    if session.failed:
        session.say("error", f"{text}; the log is kept in {folder}")


def _driven(
    session: Session, run: Run, folder: Path, stopped: Callable[[], bool], view: bool
) -> tuple[Ending, History, dict[str, Any]]:
    """Drive a run to its end, with its log and live page; how it ended, its history, and its link."""
    from amhe_cli.cli.progress import progress
    from amhe_cli.live.recorder import drive
    from amhe_cli.robots.go1.judge import History
    from amhe_cli.robots.go1.run import recorder_of

    history, title = History(run.task), f"{run.options.task} {run.options.mode}"
    with ExitStack() as stack:
        recorder = stack.enter_context(recorder_of(run, folder / "log.mcap"))
        watching = stack.enter_context(watching_run(session, run)) if view else None

        def go() -> Ending:
            with progress(session, title, _shown(), stays=run.plant is None) as show:

                def on_cycle(cycle: Cycle, row: dict[str, float]) -> None:
                    show(row)
                    if watching:
                        watching(cycle, row)

                return drive(run.episode, recorder, history, stopped, on_cycle)

        ending = at_the_robot.attended(run.target, session, go)
        return ending, history, at_the_robot.link_record(run.target, recorder, history)


def _facts(run: Run, link: Mapping[str, Any]) -> TaskFacts:
    from amhe_cli.report.run import TaskFacts
    from amhe_cli.robots.go1.judge import CLOSE_ENOUGH, ON_TIME
    from amhe_cli.robots.go1.settings import settings_of

    return TaskFacts(
        run.task.title,
        run.task.floor,
        run.task.change_texts(),
        ON_TIME * run.task.nominal_time,
        CLOSE_ENOUGH,
        {p.name: p.unit for p in run.system.space.parameters},
        settings_of(run.system).control.period * link.get("link", {}).get("slow", 1.0),
    )


def _shown() -> Callable[[Mapping[str, float]], Shown]:
    """What is shown of a cycle; the bar is the way that the box has made."""
    far = 0.0

    def shown(row: Mapping[str, float]) -> Shown:
        nonlocal far
        far = max(far, row["to_goal"])
        state = (
            f"{row['time']:.1f} s, box {row['to_goal']:.2f} m from the goal, "
            f"{row['speed']:+.2f} m/s, plan {row['plan_ms']:.0f} ms"
        )
        return state, far - row["to_goal"], far

    return shown
