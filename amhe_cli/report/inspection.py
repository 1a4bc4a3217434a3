"""What is in a log, on a terminal and as plain values."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from amhe_cli.core.files import plain
from amhe_cli.core.signals import Signal
from amhe_cli.logs import Inspection, Survey, TopicSurvey
from amhe_cli.report import numbers

#: Names in a message that are listed before the rest is counted.
MAX_ENTRIES = 6

#: A silence this many times a topic's period is worth showing.
GAP_PERIODS = 5.0


def inspection_record(found: Inspection) -> dict[str, Any]:
    """Content of `amhe inspect --json` for one log."""
    return plain(
        {
            **asdict(found.survey),
            "path": str(found.survey.path),
            "system": found.system,
            "usable": found.usable,
            "usable_seconds": found.duration,
            "problem": found.problem,
            "signals": [
                {
                    "name": check.signal.name,
                    "topic": check.signal.topic,
                    "needs": _needs(check.signal),
                    "problem": check.problem,
                    "valid": check.valid,
                }
                for check in found.checks
            ],
        }
    )


def losses(found: Inspection) -> list[str]:
    """What a script should know to be wrong with a log, a line each."""
    path = found.survey.path
    lost = [f"{path}: {problem}" for problem in found.survey.problems]
    return lost if found.usable in (None, True) else [*lost, f"{path}: not usable for system {found.system}"]


def print_inspection(found: Inspection, console: Console) -> None:
    """Print the topics, what is wrong, and how the log suits the system."""
    survey = found.survey
    messages = sum(topic.count for topic in survey.topics)
    title = Text.assemble(
        (str(survey.path), "bold"), f"  {survey.format}, {survey.duration:.4g} s, {messages:,} messages"
    )
    console.print(title, soft_wrap=True)
    if survey.metadata:
        said = ", ".join(f"{key} = {value}" for key, value in survey.metadata.items())
        console.print(f"says of itself: {said}", style="dim")
    _print_topics(survey, console)
    for line in _remarks(survey):
        console.print(line)
    if found.system is not None:
        console.print()
        _print_suitability(found, console)
    console.print()


def _print_topics(survey: Survey, console: Console) -> None:
    """Two lines a topic: the numbers in columns, and what it carries below, so that long names have room."""
    rows = [("topic", "messages", "rate", "longest gap")]
    rows += [(t.name, f"{t.count:,}", _rate(t.rate), _gap(t)) for t in survey.topics]
    name, *widths = (max(len(row[i]) for row in rows) for i in range(4))
    for number, (row, topic) in enumerate(zip(rows, (None, *survey.topics), strict=True)):
        cells = "   ".join(text.rjust(width) for text, width in zip(row[1:], widths, strict=True))
        console.print(f"{row[0]:<{name}}   {cells}", style="dim" if number == 0 else "", soft_wrap=True)
        if topic is not None:
            console.print(Padding(_carries(topic), (0, 0, 0, 4)))


def _rate(rate: float) -> str:
    if not rate:
        return numbers.MISSING
    return f"{rate:,.0f} Hz" if rate >= 1000.0 else f"{rate:.4g} Hz"


def _gap(topic: TopicSurvey) -> str:
    if topic.count < 2:
        return numbers.MISSING
    silence = (
        f"{topic.longest_gap:.2g} s" if topic.longest_gap >= 1.0 else f"{1e3 * topic.longest_gap:.3g} ms"
    )
    long = topic.longest_gap * topic.rate > GAP_PERIODS
    return f"{silence} at {topic.gap_at:.2f} s" if long else silence


def _carries(topic: TopicSurvey) -> Text:
    """Type, clock, and what signals can take from it."""
    kind = topic.type.replace("/msg/", "/")
    if topic.problem:
        return Text.assemble((kind, "dim"), ": ", (topic.problem, "yellow"))
    shown = ", ".join(topic.entries[:MAX_ENTRIES])
    more = f" and {len(topic.entries) - MAX_ENTRIES} more" if len(topic.entries) > MAX_ENTRIES else ""
    if topic.encoding == "table":
        return Text(f"columns {shown}{more}", style="dim")
    what = ", ".join(topic.quantities) or "fields by path"
    clock = f", {topic.clock} stamps" if topic.count else ""
    return Text(f"{kind}{clock}: {what}{f' of {shown}{more}' if shown else ''}", style="dim")


def _remarks(survey: Survey) -> list[str]:
    notes = [f"{topic.name}: {note}" for topic in survey.topics for note in topic.notes]
    return [
        *(f"damage: {problem}" for problem in survey.problems),
        *(f"note: {note}" for note in notes),
        *(f"clocks: {offset}" for offset in survey.offsets),
    ]


def _print_suitability(found: Inspection, console: Console) -> None:
    console.print(Text.assemble("for system ", (str(found.system), "bold")))
    for check in found.checks:
        console.print(f"  {check.signal.name}: {check.signal.topic}, {_needs(check.signal)}", soft_wrap=True)
        answer = Text(f"found, {numbers.percent(check.valid)} of its time without a gap", style="green")
        console.print(Padding(Text(check.problem, style="yellow") if check.problem else answer, (0, 0, 0, 4)))
    if found.usable:
        console.print(f"usable: {found.duration:.4g} s in which all signals are there", style="green")
    else:
        missing = ", ".join(check.signal.name for check in found.checks if check.problem)
        console.print(
            f"not usable: {found.problem or f'{missing} cannot be read'}", style="yellow", soft_wrap=True
        )


def _needs(signal: Signal) -> str:
    names = f" of {', '.join(signal.names)}" if signal.names else ""
    return f"{', '.join(signal.quantities)}{names}"
