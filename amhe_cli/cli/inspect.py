"""`amhe inspect`: what is in a log, and what a system would miss in it."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import options
from amhe_cli.cli.session import Session


@click.command(cls=options.Command, short_help="What is in a log, and what a system lacks in it.")
@click.argument("logs", nargs=-1, required=True, type=options.EXISTING, metavar="LOG...")
@options.where
@options.common
@click.pass_obj
def inspect(
    session: Session,
    logs: tuple[Path, ...],
    system: str | None,
    topics: dict[str, str],
    msg_path: Path | None,
    start: float | None,
    end: float | None,
) -> None:
    """List what is in LOG...: topics, types, rates, gaps, clocks, problems.

    With a system, named by --system or by the log itself, also what it needs and what is missing.
    """
    from amhe_cli.assembly import LogSource, inspection
    from amhe_cli.report.inspection import inspection_record, print_inspection

    session.hush_mujoco()
    found = inspection(LogSource(logs, topics, msg_path, start, end), system)
    if session.json:
        session.print_json(inspection_record(found, session.seconds, session.warnings))
    else:
        print_inspection(found, session.console())
