"""`amhe mhe-replay`: the online estimator over a log, as if it were live."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import options
from amhe_cli.cli.estimator_options import estimator
from amhe_cli.cli.session import Session


@click.command("mhe-replay", cls=options.Command, short_help="A log to parameters over time, as if live.")
@click.argument("log", required=False, type=options.EXISTING, metavar="[LOG]")
@options.where
@click.option(
    "--belief",
    type=options.EXISTING_FILE,
    metavar="FILE",
    help="Start from a belief.yaml, its sd floored so that it can still move, instead of the system's prior.",
)
@estimator
@options.work
@options.tuning
@options.out
@options.common
@click.pass_obj
def mhe_replay(
    session: Session,
    log: Path | None,
    system: str | None,
    topics: dict[str, str],
    msg_path: Path | None,
    start: float | None,
    end: float | None,
    belief: Path | None,
    seed: int,
    threads: int,
    assignments: tuple[str, ...],
    config: Path | None,
    out: Path | None,
    force: bool,
) -> None:
    """Estimate parameters over the time of LOG, with the newest window at each update.

    LOG is an MCAP file, a rosbag2 folder or a ROS 1 bag; none: a bundled one, of a Go1 that pushes a box
    onto another floor. Writes estimates.mcap, estimates.csv, result.json and report.html. With a longer
    --window, updates are further apart in proportion, unless their period is given, too.
    """
    from amhe_cli.assembly import LogSource
    from amhe_cli.cli.replay_progress import replay_progress
    from amhe_cli.cli.stopping import stopping
    from amhe_cli.estimation.online.predictions import predictions, replay_fits
    from amhe_cli.estimation.online.replay import caution, replayed
    from amhe_cli.replay_assembly import bundled_log, open_replay
    from amhe_cli.report.folder import reserve
    from amhe_cli.report.replay import print_replay, write_replay
    from amhe_cli.report.replay_files import replay_record
    from amhe_cli.system.provenance import estimator_provenance

    session.hush_mujoco()
    folder = reserve(out, "mhe-replay", force)
    path = log or bundled_log()
    source = LogSource((path,), topics, msg_path, start, end)
    problem = open_replay(source, system, belief, seed, threads, assignments, config)
    with stopping(session) as stopped:
        with replay_progress(session, len(problem.windows)) as show:
            done = replayed(problem, show, stopped)
        caution(done)
        session.interrupted = done.interrupted
        predicted, fits = predictions(done, problem.engine), replay_fits(done, problem.engine)
        record = session.record(**replay_record(done), seed=seed, out=str(folder))
        inputs = [path, *([belief] if belief else [])]
        method = done.system.settings.mhe.method
        origin = estimator_provenance(session.command_line, seed, method, done.system, inputs)
        write_replay(folder, done, predicted, fits, record, origin)
    if session.json:
        session.print_json(record)
    else:
        if problem.paced:
            setting = problem.system.settings.mhe
            session.console().print(
                f"windows of {setting.window:g} s, updates every {setting.update_period:g} s"
            )
        print_replay(record, folder, session.console())
