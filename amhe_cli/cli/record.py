"""`amhe record`: live topics into a log."""

from __future__ import annotations

import time
from contextlib import closing

import click

from amhe_cli.cli import options
from amhe_cli.cli.command import Given, command
from amhe_cli.cli.progress import of_messages, progress
from amhe_cli.cli.session import Session, stopping


@command(
    "Live topics into a log that identify takes.",
    options.listening,
    options.system_or("none: all topics whose types are known are recorded"),
    options.topics,
    options.msg_path,
    options.seconds("Stop after S seconds.  [default: when it is interrupted]"),
    options.written("OUT.mcap", "The log to write."),
    options.tuning,
)
def record(session: Session, given: Given) -> None:
    """Write the messages of live topics into OUT.mcap, as they are, until Ctrl-C.

    With --system only the topics of that system are recorded, and the log names it.
    """
    from amhe_cli.core.settings import LiveSettings
    from amhe_cli.logs import LogWriter
    from amhe_cli.logs.live.messages import STEP
    from amhe_cli.logs.live.ros import renamed
    from amhe_cli.logs.live.sources import open_transport
    from amhe_cli.logs.messages.definitions import Definitions

    out, msg_path, inputs = given.out, given.msg_path, given.inputs
    given.refuse_existing()
    if out is None or out.suffix != ".mcap":
        raise click.UsageError("name the log to write with -o OUT.mcap")
    if given.topics and not given.system:
        raise click.UsageError("--topic: name the --system that these signals belong to")
    opened = inputs.open([]) if given.system else None
    said = inputs.overrides.all.get("live") or {}
    live = opened.settings.live if opened else LiveSettings.model_validate(said)
    signals = renamed(opened.signals, live.remap) if opened else ()
    wanted = frozenset(signal.topic for signal in signals) if opened else None
    transport = open_transport(given.source, given.follow, wanted, signals, Definitions(msg_path), live)
    if transport is None:
        raise click.UsageError(f"--source: {given.source} is a log already")
    counts: dict[str, int] = {}
    about = {"system": opened.name} if opened else {}
    with (
        stopping(session) as stopped,
        closing(transport),
        LogWriter(out, about) as log,
        progress(session, "record", of_messages) as show,
    ):
        end = time.monotonic() + (given.seconds or float("inf"))
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
    if session.gave(session.record(topics=counts, out=str(out))):
        return
    listed = ", ".join(f"{topic} {count:,}" for topic, count in sorted(counts.items()))
    session.console().print(f"{listed or 'no message came'}\nwritten to {out}", soft_wrap=True)
