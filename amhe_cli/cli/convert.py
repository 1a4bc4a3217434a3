"""`amhe convert`: a log in another format."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import log_path, options, parsing
from amhe_cli.cli.progress import Shown, progress
from amhe_cli.cli.session import Session


@click.command(cls=parsing.Command, short_help="A log as tables: CSV, npz.")
@click.argument(
    "logs", nargs=-1, required=True, type=log_path.LOG, callback=log_path.episodes, metavar="LOG..."
)
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    metavar="OUT",
    help="What to write: OUT.csv or OUT.npz; without an ending, a folder of CSV files.",
)
@click.option(
    "--each",
    type=click.Choice(("csv", "npz", "folder")),
    help="Write each LOG in this form into the folder OUT; needed for several logs.",
)
@options.system_or("none: everything that is numeric is written")
@options.topics
@options.msg_path
@options.force
@options.common
@click.pass_obj
def convert(
    session: Session,
    logs: tuple[Path, ...],
    out: Path,
    each: str | None,
    system: str | None,
    topics: dict[str, str],
    msg_path: Path | None,
    force: bool,
) -> None:
    """Write LOG... as tables, with the log's metadata.

    With --system only the signals of that system are written, by their names.
    """
    from amhe_cli.core.errors import ConfigError
    from amhe_cli.logs.convert import check_out, convert
    from amhe_cli.system.system import System

    session.hush_mujoco()
    if topics and not system:
        raise ConfigError("`topics`: name the `system` that these signals belong to")
    if len(logs) > 1 and each is None:
        raise click.UsageError("several logs: name the form of each with --each, and a folder with -o")
    ending = {None: "", "folder": ""}.get(each, f".{each}")
    places = [out] if each is None else [out / (_name(log) + ending) for log in logs]
    if len(set(places)) < len(places):
        raise ConfigError("several logs have the same name; convert them one by one")
    for place in places:
        check_out(place, force)
    chosen = System.load(system) if system else None
    for log, place in zip(logs, places, strict=True):
        with progress(session, log.name, _shown) as show:
            convert(log, place, chosen, topics=topics, msg_path=msg_path, force=force, progress=show)
        if not session.json:
            print(f"wrote {place}")
    if session.json:
        session.print_json(session.record(files=[str(place) for place in places]))


def _shown(count: int) -> Shown:
    return f"{count:,} messages read", count, None


def _name(log: Path) -> str:
    """Name of the file that a log becomes: dataset#3 is dataset-3."""
    return (log.stem if log.is_file() else log.name).replace("#", "-").replace(".", "_")
