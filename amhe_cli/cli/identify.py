"""`amhe identify`: from logs to parameters with honest uncertainty."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import options
from amhe_cli.cli.session import Session


@click.command(cls=options.Command, short_help="Logs to parameters with honest uncertainty.")
@click.argument("logs", nargs=-1, required=True, type=options.EXISTING, metavar="LOG...")
@options.where
@click.option(
    "--held-out",
    multiple=True,
    type=options.EXISTING,
    metavar="LOG",
    help="Log used only to validate; repeat for more.  [default: a quarter of the logs' time]",
)
@click.option(
    "--belief",
    type=options.EXISTING_FILE,
    metavar="FILE",
    help="Start from an earlier belief.yaml instead of the system's own prior.",
)
@click.option(
    "--method",
    type=click.Choice(["linearised", "cmaes"]),
    default="linearised",
    show_default=True,
    help="Estimator; linearised falls back on cmaes where it does not help.",
)
@click.option(
    "--max-time",
    type=options.Number(min=0, min_open=True),
    metavar="S",
    help="Stop in time, with the best so far.",
)
@click.option(
    "--checkpoint",
    type=click.Path(dir_okay=False, path_type=Path),
    callback=options.in_existing_folder,
    metavar="FILE",
    help="Save the search here as it goes; resume from it, to the bit, if it exists.",
)
@options.work
@options.spread_if_asked
@options.tuning
@options.out
@options.common
@click.pass_obj
def identify(
    session: Session,
    logs: tuple[Path, ...],
    system: str | None,
    topics: dict[str, str],
    msg_path: Path | None,
    start: float | None,
    end: float | None,
    held_out: tuple[Path, ...],
    belief: Path | None,
    method: str,
    max_time: float | None,
    checkpoint: Path | None,
    seed: int,
    threads: int,
    workers: int | None,
    cluster: str | None,
    assignments: tuple[str, ...],
    config: Path | None,
    out: Path | None,
    force: bool,
) -> None:
    """Find the parameters that make the simulation follow LOG...

    A LOG is an MCAP file, a rosbag2 folder or a ROS 1 bag. Writes belief.yaml, identified.xml,
    result.json and report.html.
    """
    from amhe_cli.assembly import LogSource, identify_problem
    from amhe_cli.cli.progress import progress
    from amhe_cli.core.executors import executor_of
    from amhe_cli.estimation.offline.identification import IdentifyOptions
    from amhe_cli.estimation.offline.identification import identify as run
    from amhe_cli.report.folder import reserve
    from amhe_cli.report.identification import (
        identification_record,
        print_identification,
        write_identification,
    )
    from amhe_cli.system.provenance import provenance

    session.hush_mujoco()
    folder = reserve(out, "identify", force)
    source = LogSource(logs, topics, msg_path, start, end)
    problem = identify_problem(source, held_out, system, assignments, config, belief)
    with progress(session) as on_iteration, executor_of(workers, cluster) as executor:
        search = IdentifyOptions(method, seed, threads, max_time, checkpoint, problem.prior, executor)
        result = run(problem.system, problem.training, problem.held_out, search, on_iteration)
    session.interrupted = result.interrupted
    origin = provenance(session.command_line, seed, result.method, problem.system, logs, held_out)
    record = session.record(**identification_record(result, problem.truth), seed=seed, out=str(folder))
    write_identification(folder, problem.system, result, record, origin)
    if session.json:
        session.print_json(record)
    else:
        print_identification(result, folder, session.console(), problem.truth)
