"""The address of a page that is served, and a browser where the user sits before one."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from amhe_cli.cli.session import Session

if TYPE_CHECKING:
    from amhe_cli.view.server import PageServer


def announce(session: Session, server: PageServer) -> None:
    """Say where the page is, and open it in a browser if this is a terminal on a desktop."""
    import logging

    if not server.private:
        logging.getLogger("amhe_cli").warning(
            "whoever reaches %s sees the log, without a password; without `host` only this computer does",
            server.address,
        )
    session.say("", f"the page is at {server.address}; Ctrl-C ends")
    if sys.stdin.isatty() and sys.stderr.isatty() and _desktop():
        import webbrowser

        webbrowser.open(server.address)


def _desktop() -> bool:
    """Whether a window would appear before the user: not over SSH, and not as text in this terminal."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform == "darwin" or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
