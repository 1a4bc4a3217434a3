"""`amhe inspect`, `amhe convert`: what is in a log and missing in it, and the log in another format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, option
from amhe_cli.cli.progress import of_messages, progress
from amhe_cli.cli.session import UNREADABLE, Session

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.logs import Inspection
    from amhe_cli.logs.data_set import Member
    from amhe_cli.system.system import System


@command(
    "What is in a log, and what a system lacks in it.",
    options.logs,
    options.where,
    options.written("FILE.json", "Write what --json prints, too."),
)
def inspect(session: Session, given: Given) -> int | None:
    """List what is in LOG...: topics, types, rates, gaps, clocks, problems.

    With a system, named by --system or by the log itself, also what it needs and what is missing; exit code 4
    where a log is not usable for it.
    """
    from amhe_cli.logs import members
    from amhe_cli.report.inspection import inspection_record, losses, print_inspection

    given.refuse_existing()
    inputs = given.inputs
    found = [_inspection(one, inputs) for path in given.logs for one in members(path)]
    session.warnings += [text for one in found for text in losses(one)]
    record = session.record(logs=[inspection_record(one) for one in found])
    for one in () if session.gave(record) else found:
        print_inspection(one, session.console())
    given.write_out(record)
    return UNREADABLE if any(one.usable is False for one in found) else None


def _inspection(log: Member, inputs: Inputs) -> Inspection:
    """Look through a log, and check it for the system that the user or the log names, if any."""
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.logs import inspect_log, read_metadata
    from amhe_cli.system.description.folders import bundled_systems

    path = log.path
    named = read_metadata(path).get("system")
    if inputs.names_system([path]) or named in bundled_systems():
        system = inputs.open([path]).reading(log.topics)
        start, end = log.start or inputs.start, log.end or inputs.end
        return looked_at(inspect_log(path, system, start=start, end=end, msg_path=inputs.msg_path), system)
    if inputs.topics or inputs.start is not None or inputs.end is not None:
        raise ConfigError("--topic, --from and --to are about a system's signals: name it with --system")
    if named:
        import logging  # not at the top: --help needs none

        logging.getLogger(__name__).warning(
            "%s: about the system %r, which does not come with amhe: with `system=DIR` it is checked for it",
            path,
            named,
        )
    return inspect_log(path, msg_path=inputs.msg_path)


def looked_at(found: Inspection, system: System) -> Inspection:
    """An inspection with remarks on what is wrong in the log at first sight."""
    from dataclasses import replace

    from amhe_cli.estimation.explain.inputs import first_look

    if found.log is None:
        return found
    columns = [name for topic in found.survey.topics if topic.encoding == "table" for name in topic.entries]
    return replace(found, remarks=tuple(first_look(system, found.log, columns)))


@command(
    "A log as tables: CSV, npz.",
    options.logs,
    option(
        "-o --out OUT",
        "What to write: OUT.csv or OUT.npz; without an ending, a folder of CSV files.",
        click.Path(path_type=Path),
        required=True,
    ),
    option(
        "--each",
        "Write each LOG in this form into the folder OUT; needed for several logs.",
        ("csv", "npz", "folder"),
    ),
    options.system_or("none: everything that is numeric is written"),
    options.topics,
    options.msg_path,
    options.force("into an existing OUT"),
)
def convert(session: Session, given: Given) -> None:
    """Write LOG... as tables, with the log's metadata.

    With --system only the signals of that system are written, by their names.
    """
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.logs.convert import check_out
    from amhe_cli.logs.convert import convert as run
    from amhe_cli.system.system import System

    logs, out, each = given.logs, given.out, given.each
    if given.topics and not given.system:
        raise ConfigError("`topics`: name the `system` that these signals belong to")
    if len(logs) > 1 and each is None:
        raise click.UsageError("several logs: name the form of each with --each, and a folder with -o")
    ending = {None: "", "folder": ""}.get(each, f".{each}")
    places = [out] if each is None else [out / (_name(log) + ending) for log in logs]
    if len(set(places)) < len(places):
        raise ConfigError("several logs have the same name; convert them one by one")
    for place in places:
        check_out(place, given.force)
    system = System.load(given.system) if given.system else None
    how = given.pick("topics", "msg_path", "force")
    for log, place in zip(logs, places, strict=True):
        with progress(session, log.name, of_messages) as show:
            run(log, place, system, progress=show, **how)
        if not session.json:
            print(f"wrote {place}")
    session.gave(session.record(files=[str(place) for place in places]))


def _name(log: Path) -> str:
    """Name of the file that a log becomes: dataset#3 is dataset-3."""
    return (log.stem if log.is_file() else log.name).replace("#", "-").replace(".", "_")
