"""Ctrl-C, SIGTERM and SIGHUP as a question of a loop, where an exception would come at the wrong moment."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from amhe_cli.cli.session import TERMINATING, Session, Terminated


@contextmanager
def stopping(session: Session) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether to stop; a second signal ends the command at once.

    What is being written stays whole: nothing is torn apart in the middle of a message.
    """
    requested = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if number in TERMINATING:
            session.terminate()
        if requested and number != signal.SIGHUP:  # kernel and shell both send it
            raise Terminated if session.terminated else KeyboardInterrupt
        requested = True

    numbers = [n for n in (signal.SIGINT, *TERMINATING) if signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in numbers}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
