"""`amhe record`: live topics into a log."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import click

from amhe_cli.cli import live_options, options, parsing
from amhe_cli.cli.progress import Shown, progress
from amhe_cli.cli.session import Session, stopping

if TYPE_CHECKING:
    from amhe_cli.cli.settings import Overrides


@click.command(cls=parsing.Command, short_help="Live topics into a log that identify takes.")
@live_options.where
@options.system_or("none: all topics whose types are known are recorded")
@options.topics
@options.msg_path
@live_options.for_seconds("Stop after S seconds.  [default: when it is interrupted]")
@parsing.fresh_file("out", "-o", "--out", use="The log to write.", metavar="OUT.mcap")
@options.tuning
@options.common
@click.pass_obj
def record(
    session: Session,
    source: str,
    follow: Path | None,
    system: str | None,
    topics: dict[str, str],
    msg_path: Path | None,
    seconds: float | None,
    out: Path | None,
    overrides: Overrides,
) -> None:
    """Write the messages of live topics into OUT.mcap, as they are, until Ctrl-C.

    With --system only the topics of that system are recorded, and the log names it.
    """
    from amhe_cli.cli.inputs import Inputs
    from amhe_cli.core.settings import LiveSettings
    from amhe_cli.logs import LogWriter
    from amhe_cli.logs.live.open import open_transport
    from amhe_cli.logs.live.transport import STEP
    from amhe_cli.logs.messages.definitions import Definitions

    session.hush_mujoco()
    if out is None or out.suffix != ".mcap":
        raise click.UsageError("name the log to write with -o OUT.mcap")
    if topics and not system:
        raise click.UsageError("--topic: name the --system that these signals belong to")
    opened = Inputs(system, topics, msg_path, None, None).open([], overrides) if system else None
    live = opened.settings.live if opened else LiveSettings.model_validate(overrides.all.get("live") or {})
    signals = opened.signals if opened else ()
    wanted = frozenset(signal.topic for signal in signals) if opened else None
    transport = open_transport(source, follow, wanted, signals, Definitions(msg_path), live)
    if transport is None:
        raise click.UsageError(f"--source: {source} is a log already")
    counts: dict[str, int] = {}
    about = {"system": opened.name} if opened else {}
    with (
        stopping(session) as stopped,
        closing(transport),
        LogWriter(out, about) as log,
        progress(session, "record", _shown) as show,
    ):
        end = time.monotonic() + (seconds or float("inf"))
        while not (stopped() or transport.over or time.monotonic() > end):
            time.sleep(STEP)
            for batch in transport.receive():
                log.copy(batch)
                topic = batch.connection.topic
                counts[topic] = counts.get(topic, 0) + batch.starts.size
            for note in transport.notes():
                session.warnings.append(note)
                session.say("warning", note)
            show(sum(counts.values()))
    found = session.record(topics=counts, out=str(out))
    if session.json:
        return session.print_json(found)
    listed = ", ".join(f"{topic} {count:,}" for topic, count in sorted(counts.items()))
    session.console().print(f"{listed or 'no message came'}\nwritten to {out}", soft_wrap=True)


def _shown(count: int) -> Shown:
    return f"{count:,} messages", count, None
