"""`amhe watch`: the online estimator beside a system that is running."""

from __future__ import annotations

import os
import shlex
import sys
import time
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command, flag, option
from amhe_cli.cli.kinds import LOG, MODEL, PORT, Number
from amhe_cli.cli.session import Session, stopping
from amhe_cli.cli.watching import watched, watching_windows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from subprocess import Popen

    from amhe_cli.audit.audit import Line
    from amhe_cli.core.belief import Belief
    from amhe_cli.estimation.online.horizon import Estimate
    from amhe_cli.report.watch import WatchReport
    from amhe_cli.system.system import System
    from amhe_cli.view.server import PageServer

#: Time between two pictures on a terminal, and two lines elsewhere [s].
_PICTURE, _LINE = 0.2, 10.0
#: An update, and the estimator's start, hang after so long [s]: nobody's control waits for them.
_HANGS = 10.0, 120.0
#: Events that are kept for result.json.
_WARNINGS = 100


def _command(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """A command that can be run."""
    from shutil import which

    try:
        if value is None or which(shlex.split(value)[0]):
            return value
    except (ValueError, IndexError):
        pass
    raise click.BadParameter(f"{value!r} is no command that is found", ctx, param)


@command(
    "Parameters of a robot that is running, live.",
    options.listening,
    options.system,
    options.topics,
    options.msg_path,
    options.believed("Start from a belief.yaml, its sd floored so that it can still move."),
    options.narrowing,
    options.followed,
    flag("--resume", "Go on from the belief.yaml in OUT, if there is one, and add to its files."),
    option("--speed", "LOG: play it so many times as fast.", Number("X", min=0, min_open=True), default=1.0),
    option(
        "--alarm RULE ...",
        "Warn while a parameter's 90 % interval is beyond a limit, such as 'load_mass>1.2'. Repeatable.",
    ),
    option(
        "--against MODEL",
        "Keep a table of what the estimates say of this file's numbers, as `amhe audit` does.",
        MODEL,
    ),
    option(
        "--on-jump CMD",
        "Run a command at each jump; AMHE_ESTIMATE in its environment is the estimate, as JSON.",
        callback=_command,
    ),
    option("--metrics PORT", "Serve the values for Prometheus at http://127.0.0.1:PORT/metrics.", PORT),
    watched,
    options.seconds("Stop after S seconds.  [default: when it is interrupted]"),
    options.seed,
    options.engine,
    options.tuning,
    options.output,
)
def watch(session: Session, given: Given) -> None:
    """Estimate parameters from what a running system sends, until Ctrl-C.

    Shows parameters with intervals, warns of jumps and of --alarm, and publishes /amhe/params, /amhe/jump
    and /diagnostics where the source can. Writes estimates.csv and estimates.mcap, belief.yaml every 10 s,
    and result.json at the end.
    """
    from amhe_cli.core.belief import completed
    from amhe_cli.core.files import json_text, write_whole
    from amhe_cli.estimation.online.horizon import check_window
    from amhe_cli.estimation.online.workers import InProcess, SeenWorker, Worker
    from amhe_cli.live.watch import Alarm, estimator_of
    from amhe_cli.live.watch import watch as run_watch
    from amhe_cli.logs.live.sources import open_source
    from amhe_cli.logs.messages.definitions import Definitions
    from amhe_cli.report.watch import PUBLISHED, WatchReport
    from amhe_cli.system.provenance import estimator_provenance

    source, seed, belief = given.source, given.seed, given.belief
    source = str(LOG.convert(source, None, None)) if source.startswith("example:") else source
    log = [Path(source)] if Path(source).exists() else []
    if not (given.system or log):
        raise click.UsageError("name the system that is watched with --system NAME|DIR")
    given.force = given.force or given.resume
    folder = given.reserve()
    kept = folder / "belief.yaml"
    opened, known = given.inputs.open(log).starting_from(
        kept if given.resume and kept.exists() else belief, **given.pick("fix", "only", "belief_anyway")
    )
    mhe = opened.settings.mhe
    check_window(mhe, opened.dt)
    alarms = [Alarm.parsed(rule, opened.space.names) for rule in given.alarm]
    audit = given.against and _audit(opened, given.against)
    origin = estimator_provenance(session.command_line, seed, mhe.method, opened, [belief] if belief else [])
    factory = partial(estimator_of, opened, known, seed, given.engine)
    with ExitStack() as closed:
        stopped = closed.enter_context(stopping(session))
        found, transport = closed.enter_context(
            open_source(source, given.follow, opened, Definitions(given.msg_path), given.speed)
        )
        for topic, kind in PUBLISHED.items():
            transport.announce(topic, kind)
        budget = mhe.budget or mhe.update_period
        worker: Worker = closed.enter_context(closing(InProcess(factory, budget, *_HANGS)))
        if given.view:
            start = completed(known, opened).estimate if known else opened.space.nominal
            look = closed.enter_context(watching_windows(session, opened, start, transport.about))
            worker = SeenWorker(worker, look)
        port = opened.settings.live.foxglove
        sent = [transport.publish, *_to_foxglove(session, closed, port, given.msg_path)]
        report = closed.enter_context(
            WatchReport(folder, opened, found, origin, sent, {str(a): a.holds for a in alarms}, audit)
        )
        show = closed.enter_context(_shown(session, report))
        if given.metrics is not None:
            closed.enter_context(_served(session, given.metrics, report.metrics))
        end = time.monotonic() + (given.seconds or float("inf"))
        for _ in _reported(session, run_watch(opened, found, worker), report, show, given.on_jump):
            if stopped() or time.monotonic() > end or (session.strict and session.warnings):
                break
    record = session.record(**report.record(), out=str(folder))
    write_whole(folder / "result.json", json_text(record))
    if session.gave(record):
        return
    text = f"{report.values or 'no window was estimated'}\nresults: {folder}"
    session.console().print(text, soft_wrap=True)


def _audit(system: System, vendor: Path | str) -> Callable[[Belief], list[Line]]:
    """What holds the numbers of a model file against a belief."""
    from amhe_cli.audit.files import held_against
    from amhe_cli.cli.inputs import model_file, urdf_options
    from amhe_cli.system.model.files import compiled, read_spec

    path = model_file(vendor)
    return partial(held_against, system, file=compiled(read_spec(path, urdf_options(path)), repr(path.name)))


def _reported(
    session: Session,
    events: Iterator[Estimate | str | None],
    report: WatchReport,
    show: Callable[[str], None],
    on_jump: str | None,
) -> Iterator[None]:
    """Report each event, and run the user's command at each jump."""
    child = None
    for event in events:
        show(report.take(event))
        if isinstance(event, str):
            if event not in session.warnings and len(session.warnings) < _WARNINGS:
                session.warnings.append(event)
        elif event is not None and event.mark == "jump":
            child = _run(on_jump, report.record(), child)
        yield


@contextmanager
def _shown(session: Session, report: WatchReport) -> Iterator[Callable[[str], None]]:
    """Give a function that shows the state, and events, as the session wants them shown."""
    console = session.console(stderr=True)
    told, before = time.monotonic(), ""

    def say(text: str) -> None:
        nonlocal told, before
        if not text and time.monotonic() - told >= _LINE and not session.quiet:
            told = time.monotonic()
            text = f"{report.values or 'no estimate yet'}; {report.status()[1]}"
        if text and text != before:
            session.say("", text)
            before = text

    if session.quiet or not console.is_terminal:
        yield say
        return
    from rich.live import Live

    with Live(console=console, auto_refresh=False) as live:

        def draw(text: str) -> None:
            nonlocal told
            if time.monotonic() - told >= _PICTURE:
                told = time.monotonic()
                live.update(report.drawn(), refresh=True)

        yield draw


def _to_foxglove(
    session: Session, closed: ExitStack, port: int | None, msg_path: Path | None
) -> Iterator[Callable[[str, str, bytes], None]]:
    """What shows messages to Foxglove, where it is requested."""
    if port is None:
        return
    from amhe_cli.logs.live.foxglove import FoxgloveServer
    from amhe_cli.logs.messages.definitions import Definitions

    server = closed.enter_context(closing(FoxgloveServer(port, Definitions(msg_path))))
    session.say("", f"Foxglove finds the estimates at {server.address}")
    yield server.publish


def _served(session: Session, port: int, text: Callable[[], str]) -> PageServer:
    from amhe_cli.view.server import PageServer

    server = PageServer(text, port=port, path="/metrics", kind="text/plain; version=0.0.4")
    session.say("", f"metrics are at {server.address}metrics")
    return server


def _run(command: str | None, about: dict[str, Any], last: Popen[bytes] | None) -> Popen[bytes] | None:
    """Run the user's command, unless the last one still runs."""
    import json
    import subprocess

    if command is None or (last is not None and last.poll() is None):
        return last
    environment = os.environ | {"AMHE_ESTIMATE": json.dumps(about)}
    with suppress(OSError):  # it was there when the watch began
        return subprocess.Popen(
            shlex.split(command), env=environment, stdin=subprocess.DEVNULL, stdout=sys.__stderr__,
            start_new_session=True,
        )  # fmt: skip
    return last
