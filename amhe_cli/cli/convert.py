"""`amhe convert`: a log in another format."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, option
from amhe_cli.cli.progress import Shown, progress
from amhe_cli.cli.session import Session


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
        with progress(session, log.name, _shown) as show:
            run(log, place, system, progress=show, **how)
        if not session.json:
            print(f"wrote {place}")
    session.gave(session.record(files=[str(place) for place in places]))


def _shown(count: int) -> Shown:
    return f"{count:,} messages read", count, None


def _name(log: Path) -> str:
    """Name of the file that a log becomes: dataset#3 is dataset-3."""
    return (log.stem if log.is_file() else log.name).replace("#", "-").replace(".", "_")
