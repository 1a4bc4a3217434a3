"""`amhe`: the group of commands, and how every ending becomes an exit code.

0 done; 1 failed; 2 usage or configuration; 3 done with warnings under --strict; 4 input that cannot be
read; 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Sequence
from io import TextIOWrapper

import click

from amhe_cli.cli import about
from amhe_cli.cli.at_the_robot import calibrate, emulate
from amhe_cli.cli.audit import audit
from amhe_cli.cli.beliefs import export, pool
from amhe_cli.cli.check import check
from amhe_cli.cli.command import COMMON_OPTIONS
from amhe_cli.cli.compare import compare
from amhe_cli.cli.eval import evaluate
from amhe_cli.cli.explain import explain
from amhe_cli.cli.identify import identify
from amhe_cli.cli.init import drives, init
from amhe_cli.cli.logs import convert, inspect
from amhe_cli.cli.mhe_replay import mhe_replay
from amhe_cli.cli.probe import probe
from amhe_cli.cli.record import record
from amhe_cli.cli.run import run as run_task
from amhe_cli.cli.session import (
    FAILED,
    INTERRUPTED,
    TERMINATED,
    TERMINATING,
    UNREADABLE,
    USAGE,
    Session,
    terminable,
)
from amhe_cli.cli.view import view
from amhe_cli.cli.watch import watch

#: The commands, by what they are for.
GROUPS = {
    "Start": (inspect, init, check, audit, identify, view),
    "More": (compare, explain, pool, probe, mhe_replay, export, convert, drives),
    "Live": (watch, record),
    "Go1": (run_task, evaluate, emulate, calibrate),
    "Help": about.COMMANDS,
}


class _Grouped(click.Group):
    """A group whose help lists its commands by what they are for."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands, a heading for each group of them."""
        widest = max(map(len, self.commands))
        for title, members in GROUPS.items():
            with formatter.section(title):
                rows = [(str(one.name).ljust(widest), one.get_short_help_str(limit=80)) for one in members]
                formatter.write_dl(rows)


amhe = _Grouped(
    "amhe",
    help="Physical parameters of robots and what they push, from their logs, with honest uncertainty.\n\n"
    "To try it, in any folder: amhe identify example:pendulum; amhe examples lists more.",
    commands={str(one.name): one for members in GROUPS.values() for one in members},
    params=list(COMMON_OPTIONS),
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    no_args_is_help=True,
)


#: Linear algebra on one thread, also in child processes: on several, sums are taken in another order, and
#: the last digits of results would depend on their number. Rollouts have threads of their own.
_ONE_THREAD: dict[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def main() -> None:
    """Entry point of the command `amhe`."""
    _open_closed_streams()
    os.environ.update(_ONE_THREAD)  # numpy reads them when it is imported, which no command has done yet
    # what a command imports is no garbage: to search it all, three times and at the end, costs 0.3 s of CPU
    gc.set_threshold(700, 10, 100)
    code = run(sys.argv[1:])
    gc.freeze()
    # the work is done: a signal during Python's own clearing up must not turn a success into a failure
    for number in (signal.SIGINT, *TERMINATING):
        signal.signal(number, signal.SIG_IGN)
    engine = sys.modules.get("amhe_cli.engine.auto")  # which is loaded where cards open
    if engine and any(thread.name == engine.OPENING for thread in threading.enumerate()):
        # they compile, which nothing can stop: what the libraries clear up at the end is not theirs to see
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _open_closed_streams() -> None:
    """Open what a daemon or `>&-` closed: else the next file that is opened would take its place."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115, PTH123 (it stays open)


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code; every message is on stderr by then."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal without Unicode shows '?', it does not end the run
            stream.reconfigure(errors="replace")
    session = Session(arguments)
    with terminable(session):
        try:
            code = amhe.main(list(arguments), prog_name="amhe", standalone_mode=False, obj=session)
            return code if isinstance(code, int) else session.exit_code
        except (click.Abort, KeyboardInterrupt):  # click makes an Abort of Ctrl-C
            lost = f"; the results are in {session.folder}" if session.written else "; nothing was written"
            session.say("", f"interrupted{lost if 'out' in session.options else ''}")
            return TERMINATED if session.terminated else INTERRUPTED
        except Exception as error:
            return _failed(session, error)
        finally:
            session.end()


def _failed(session: Session, error: Exception) -> int:
    """Tell the user of an error, and give the exit code that stands for its kind."""
    from amhe_cli.core.errors import AmheError, ConfigError, LogError, printable

    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return USAGE
    if isinstance(error, click.UsageError):
        text = " ".join(error.format_message().split())  # click lists choices over many lines
        session.say("error", f"{text.rstrip('.')} (see '{session.command} --help')")
        return USAGE
    if isinstance(error, AmheError):
        several = isinstance(error, ConfigError)  # one line for each mistake; others have one line in all
        session.say("error", str(error) if several else printable(str(error)))
        return (
            USAGE if isinstance(error, ConfigError) else UNREADABLE if isinstance(error, LogError) else FAILED
        )
    if isinstance(error, OSError):
        session.say("error", f"{error.filename}: {error.strerror}" if error.filename else str(error))
        return FAILED
    import traceback

    traceback.print_exception(error)
    session.say("error", "this is a bug in amhe: please report it with the lines above")
    return FAILED
