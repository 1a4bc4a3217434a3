"""`amhe view`: a log or a result, and its ghosts, in a browser."""

from __future__ import annotations

import time

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, argument, command, option
from amhe_cli.cli.kinds import LOG, PORT
from amhe_cli.cli.session import Session, stopping


@command(
    "A log and what the model predicts, in a browser.",
    argument("source", LOG, metavar="LOG|RESULT"),
    options.where,
    options.believed("The belief.yaml of an identification: its ghost is shown beside that of before."),
    options.written("PAGE.html", "Write one page that needs no network, and serve nothing."),
    option("--host ADDRESS", "To serve on.", default="127.0.0.1"),
    option("--port", "To serve on.", PORT, default=0, show_default="any free one"),
    options.tuning,
)
def view(session: Session, given: Given) -> None:
    """Show a LOG, or the logs of a RESULT folder, in three dimensions beside what the model predicts.

    The log is cut into clips. From the first state of each, a ghost shows the prediction under nominal
    parameters, and another one that under --belief. Clips are ordered by misfit, those that were held out of
    a fit first. A RESULT is the folder that `amhe identify`, `amhe mhe-replay` or `amhe run` wrote; its logs
    must still be where they were. The page is served to this computer until Ctrl-C.
    """
    from amhe_cli.api.arguments import cores
    from amhe_cli.cli.viewed import viewed
    from amhe_cli.cli.watching import announce
    from amhe_cli.core.files import write_whole
    from amhe_cli.view.open import view_of
    from amhe_cli.view.server import PageServer

    given.refuse_existing()
    found = viewed(given.source, given.inputs)
    opened, known = (
        found.open()
        .fixing(found.record.fixed)
        .starting_from(given.belief or found.belief, belief_anyway=given.belief_anyway)
    )
    logs, held_out = found.read(opened)
    shown = view_of(
        opened,
        logs,
        held_out=held_out,
        threads=cores(),
        about=given.source.name,
        warnings=session.warnings,
        **found.beside(opened, (logs or held_out)[0], known),
    )
    if given.out is not None:
        page = shown.page()
        write_whole(given.out, page)
        if not session.gave(session.record(page=str(given.out), bytes=len(page.encode()))):
            session.console().print(f"page: {given.out}", soft_wrap=True)
        return
    page = shown.page(asks=True)
    with (
        stopping(session) as stopped,
        PageServer(page, given.host, given.port, answer=shown.answer) as server,
    ):
        announce(session, server)
        while not stopped():
            time.sleep(0.1)
