"""`amhe view`: a log or a result, and its ghosts, in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import log_path, options, parsing
from amhe_cli.cli.estimation_options import believed
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.cli.settings import Overrides


@click.command(cls=parsing.Command, short_help="A log and what the model predicts, in a browser.")
@click.argument("source", type=log_path.LOG, metavar="LOG|RESULT")
@options.where
@believed("The belief.yaml of an identification: its ghost is shown beside the nominal one.")
@parsing.fresh_file(
    "save", "--save", use="Write one page that needs no network, and serve nothing.", metavar="PAGE.html"
)
@click.option("--host", default="127.0.0.1", show_default=True, metavar="ADDRESS", help="To serve on.")
@click.option(
    "--port",
    type=parsing.WholeNumber(0, 65535),
    default=0,
    show_default="any free one",
    metavar="N",
    help="To serve on.",
)
@options.tuning
@options.common
@click.pass_obj
def view(
    session: Session,
    source: Path,
    inputs: Inputs,
    belief: Path | None,
    belief_anyway: bool,
    save: Path | None,
    host: str,
    port: int,
    overrides: Overrides,
) -> None:
    """Show a LOG, or the logs of a RESULT folder, in three dimensions beside what the model predicts.

    The log is cut into clips. From the first state of each, a ghost shows the prediction under nominal
    parameters, and another one that under --belief. Clips are ordered by misfit, those that were held out of
    a fit first. A RESULT is the folder that `amhe identify`, `amhe mhe-replay` or `amhe run` wrote; its logs
    must still be where they were. The page is served to this computer until Ctrl-C.
    """
    from amhe_cli.api.arguments import cores
    from amhe_cli.cli.viewed import viewed
    from amhe_cli.core.files import write_whole
    from amhe_cli.view.open import page_of

    session.hush_mujoco()
    found = viewed(source, inputs, overrides)
    opened, known = (
        found.open()
        .fixing(found.record.fixed)
        .starting_from(belief or found.belief, belief_anyway=belief_anyway)
    )
    logs, held_out = found.read(opened)
    page = page_of(
        opened,
        logs,
        held_out=held_out,
        threads=cores(),
        title=f"{opened.name}: {source.name}",
        warnings=session.warnings,
        **found.beside(opened, (logs or held_out)[0], known),
    )
    if save is not None:
        write_whole(save, page)
        if session.json:
            return session.print_json(session.record(page=str(save), bytes=len(page.encode())))
        return session.console().print(f"page: {save}", soft_wrap=True)
    _serve(session, page, host, port)


def _serve(session: Session, page: str, host: str, port: int) -> None:
    import time

    from amhe_cli.cli.watching import announce
    from amhe_cli.view.server import PageServer

    with stopping(session) as stopped, PageServer(page, host, port) as server:
        announce(session, server)
        while not stopped():
            time.sleep(0.1)
