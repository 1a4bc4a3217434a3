"""`amhe init`: a first system folder from a model and logs."""

from __future__ import annotations

from pathlib import Path

import click

from amhe_cli.cli import log_path, options
from amhe_cli.cli.session import Session


@click.command(cls=options.Command, short_help="A model and logs to a first system folder.")
@click.argument("model", type=options.EXISTING_FILE)
@click.argument(
    "logs", nargs=-1, required=True, type=log_path.LOG, callback=log_path.episodes, metavar="LOG..."
)
@click.option(
    "-o",
    "--out",
    "--system",
    "out",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="The system folder to write.  [default: amhe-out/init-<date>-<time>/]",
)
@options.force
@options.msg_path
@options.common
@click.pass_obj
def init(
    session: Session,
    model: Path,
    logs: tuple[Path, ...],
    out: Path | None,
    force: bool,
    msg_path: Path | None,
) -> None:
    """Write a system folder for MODEL (MJCF or URDF) whose signals are found in LOG...

    Its system.yaml is commented: the signals matched to joints by name, candidate parameters, and what
    was guessed. Read it, correct it, then: amhe identify LOG --system DIR.
    """
    from amhe_cli.init.folder import init_system
    from amhe_cli.report.folder import reserve

    session.hush_mujoco()
    folder = reserve(out, "init", force)
    guessed = init_system(model, logs, folder, msg_path=msg_path, force=force)
    if session.json:
        session.print_json(session.record(system=str(folder), guessed=guessed))
        return
    for sentence in guessed:
        print(sentence)
    print(f"wrote {folder}/system.yaml: read it, correct it, then: amhe identify LOG --system {folder}")
