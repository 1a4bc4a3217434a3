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
    from amhe_cli.assembly import LogSource, inspections
    from amhe_cli.report.inspection import inspection_record, losses, print_inspection

    session.hush_mujoco()
    found = inspections(LogSource(logs, topics, msg_path, start, end), system)
    session.warnings += [text for one in found for text in losses(one)]
    if session.json:
        session.print_json(session.record(logs=[inspection_record(one) for one in found]))
        return
    for one in found:
        print_inspection(one, session.console())
