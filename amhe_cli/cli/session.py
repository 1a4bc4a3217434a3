"""What the commands share while one of them runs: verbosity, warnings, the streams, the exit code."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from amhe_cli.core.errors import NOTE, printable

if TYPE_CHECKING:
    from logging import Handler
    from pathlib import Path
    from types import FrameType

    from amhe_cli.report.tables import PlainConsole

DONE, FAILED, USAGE, LOSSY, UNREADABLE, INTERRUPTED, TERMINATED = 0, 1, 2, 3, 4, 130, 143

#: Columns of a table where stdout is no terminal; a terminal says its own.
PLAIN_WIDTH = 110


#: What says that a command's results are in its folder.
_RECORDS = ("result.json", "study.json", "audit.json")
#: Signals other than Ctrl-C that end a command; SIGHUP comes when its terminal is closed.
TERMINATING = (signal.SIGTERM, signal.SIGHUP)


#: An argument or a setting of the library in a message, in backquotes, perhaps with a value.
_QUOTED = re.compile(r"`([a-z_0-9]+)((?:\.\w+)*)(?:=([^`]*))?`")


def in_options(text: str, options: Mapping[str, str], quote: str = "") -> str:
    """A text of the library as the user of a command reads it; other words in backquotes stay.

    Args:
        text: The text, in which `held_out` stands for the option --held-out, `logs.align=true` for a setting.
        options: See `command.options_of`.
        quote: What to put options into: a page shows what is in backquotes as code.
    """

    def typed(match: re.Match[str]) -> str:
        name, rest, value = match.groups()
        if rest:
            from amhe_cli.cli.settings import groups

            setting = f"{name}{rest}" if value is None else f"{name}{rest}={value}"
            known = "assignments" in options and name in groups()
            return f"{quote}--set {setting}{quote}" if known else match.group()
        option = options.get(f"no_{name}" if value == "False" else name)
        if option is None:
            return match.group()
        return f"{quote}{option if value in (None, 'True', 'False') else f'{option} {value}'}{quote}"

    return _QUOTED.sub(typed, text)


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, treated like Ctrl-C: keep what there is, and go."""


class Session:
    """One run of one command.

    Attributes:
        name: Name of the command.
        command: 'amhe identify': how every line on stderr begins.
        options: What the user types for the arguments of the library: see `command.options_of`.
        command_line: What the user typed, for provenance.
        warnings: What the library warned of, once each; the content of result.json's `warnings`.
        listed: Takes warnings that the command has a list of its own for; None: they go to stderr.
        interrupted: The command was stopped before it was through, and kept what it had.
        terminated: By SIGTERM or SIGHUP, not by Ctrl-C.
        failed: The command did its work, and its outcome is a failure.
        folder: Where it writes its results; None: nowhere, or not yet known.
    """

    def __init__(self, arguments: Sequence[str] = ()) -> None:
        self.name = self.command = "amhe"
        self.options: Mapping[str, str] = {}
        self.command_line = shlex.join(["amhe", *arguments])
        self.started = time.monotonic()
        self.warnings: list[str] = []
        self.listed: list[str] | None = None
        self.interrupted = False
        self.terminated = False
        self.failed = False
        self.folder: Path | None = None
        self.strict = False
        self.json = False
        self.quiet = False
        self.verbose = 0
        self.no_color = False
        self._on_terminal = [stream.fileno() for stream in (sys.stdout, sys.stderr) if stream.isatty()]

    def terminate(self) -> None:
        """Note a signal of `TERMINATING`; a terminal that has been closed takes no more words."""
        self.terminated = True
        if closed := [descriptor for descriptor in self._on_terminal if not os.isatty(descriptor)]:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for descriptor in closed:
                os.dup2(nowhere, descriptor)
            os.close(nowhere)

    @property
    def seconds(self) -> float:
        """Time since the command began."""
        return time.monotonic() - self.started

    @property
    def written(self) -> bool:
        """Whether its results are in its folder."""
        files = [] if self.folder is None else [self.folder / name for name in _RECORDS]
        return any(file.exists() and time.time() - file.stat().st_mtime < self.seconds for file in files)

    @property
    def exit_code(self) -> int:
        """Of a command that came to its end without an error."""
        if self.interrupted:
            return TERMINATED if self.terminated else INTERRUPTED
        if self.failed:
            return FAILED
        return LOSSY if self.strict and self.warnings else DONE

    def say(self, kind: str, text: str) -> None:
        """Write one message, such as 'amhe identify: error: ...', on stderr; it speaks of options.

        Warnings and errors end with what prints more about them, where docs/troubleshooting.md has an entry.
        """
        label, more = f"{kind}: " if kind else "", ""
        if kind in ("warning", "error"):
            from amhe_cli.cli.advice import entry_of

            entry = entry_of(text)
            more = f" (amhe help {entry})" if entry else ""
        first, *rest = [printable(line) for line in (in_options(text, self.options) + more).split("\n")]
        with suppress(OSError):  # nobody reads it any more
            print(
                f"{self.command}: {label}{first}", *(f"  {line}" for line in rest), sep="\n", file=sys.stderr
            )

    def begin(self, simulates: bool) -> None:
        """Start listening to the library's log, before a command's body runs."""
        import logging

        if simulates:
            from amhe_cli.engine.cpu import hush_mujoco

            hush_mujoco()  # by default it writes MUJOCO_LOG.TXT where the user stands
        logging.captureWarnings(True)  # a library's RuntimeWarning is for us, not for users
        logger = logging.getLogger("amhe_cli")
        logger.handlers[:] = [_listener(self)]
        least = logging.WARNING if self.quiet else NOTE
        logger.setLevel([least, logging.INFO, logging.DEBUG][min(self.verbose, 2)])
        logger.propagate = False

    def end(self) -> None:
        """Leave the log as it was: a process may run more than one command."""
        if "logging" not in sys.modules:  # no command has begun
            return
        import logging

        logging.captureWarnings(False)
        logger = logging.getLogger("amhe_cli")
        logger.handlers.clear()
        logger.setLevel(logging.NOTSET)
        logger.propagate = True

    def console(self, stderr: bool = False) -> PlainConsole:
        """Rich console on stdout, or on stderr."""
        from amhe_cli.report.tables import PlainConsole

        stream = sys.stderr if stderr else sys.stdout
        plain = not stream.isatty() and "COLUMNS" not in os.environ
        return PlainConsole(
            file=stream, no_color=self.no_color or None, width=PLAIN_WIDTH if plain else None, soft_wrap=False
        )

    def record(self, **more: object) -> dict[str, object]:
        """What every result.json has, and `more`."""
        from amhe_cli import __version__

        return {
            "schema_version": 1,
            "command": self.name,
            "version": __version__,
            "seconds": round(self.seconds, 3),
            "warnings": list(self.warnings),
            **more,
        }

    def gave(self, record: object) -> bool:
        """Write one JSON object on stdout, if --json asks for it; whether it does."""
        if self.json:
            import json

            print(json.dumps(record, indent=2, allow_nan=False))
        return self.json


def _listener(session: Session) -> Handler:
    import logging  # not at the top: --help needs none

    class Listener(logging.Handler):
        def __init__(self) -> None:
            super().__init__()
            self.said: set[str] = set()  # each is said once

        def emit(self, record: logging.LogRecord) -> None:
            text = in_options(record.getMessage(), session.options)
            if record.levelno >= logging.WARNING:
                if session.listed is not None:
                    session.listed.append(text)
                    return
                session.warnings += [text] * (text not in session.warnings)
            if text in self.said:
                return
            self.said.add(text)
            kind = "note" if record.levelno == NOTE else record.levelname.lower()
            session.say(kind, printable(text))

    return Listener()


@contextmanager
def stopping(session: Session) -> Iterator[Callable[[], bool]]:
    """Give a function that says whether to stop; a second signal ends the command at once.

    Ctrl-C, SIGTERM and SIGHUP become a question of a loop, so that what is being written stays whole: an
    exception would come in the middle of a message.
    """
    requested = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal requested
        if number in TERMINATING:
            session.terminate()
        if requested and number != signal.SIGHUP:  # kernel and shell both send it
            raise Terminated if session.terminated else KeyboardInterrupt
        requested = True

    with _handling((signal.SIGINT, *TERMINATING), note):
        yield lambda: requested


@contextmanager
def terminable(session: Session) -> Iterator[None]:
    """Turn SIGTERM and SIGHUP into an exception that commands may end well on, as Ctrl-C is."""

    def terminate(number: int, frame: FrameType | None) -> None:
        session.terminate()
        raise Terminated

    with _handling(TERMINATING, terminate):
        yield


@contextmanager
def _handling(numbers: Sequence[int], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle signals so within the block, but for those that are ignored, as under nohup."""
    heard = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in heard}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)
