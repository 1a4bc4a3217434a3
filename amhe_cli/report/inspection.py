"""The content of a log, on a terminal and as plain values."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from amhe_cli.core.errors import and_more, printable
from amhe_cli.core.files import plain
from amhe_cli.core.signals import Signal
from amhe_cli.logs import Inspection, Survey, TopicSurvey
from amhe_cli.report import numbers

#: Names in a message that are listed; further ones are counted.
MAX_ENTRIES = 6

#: A gap of more than this many periods of a topic is shown with its time.
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
            "remarks": found.remarks,
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
    """What is wrong with a log, one line for each problem."""
    path = found.survey.path
    problems = [f"{path}: {problem}" for problem in found.survey.problems]
    if found.usable is False:
        problems.append(f"{path}: not usable for system {found.system}")
    return problems


def print_inspection(found: Inspection, console: Console) -> None:
    """Print the topics, what is wrong with them, and whether the system can use the log."""
    survey = found.survey
    messages = sum(topic.count for topic in survey.topics)
    title = Text.assemble(
        (str(survey.path), "bold"), f"  {survey.format}, {survey.duration:.4g} s, {messages:,} messages"
    )
    console.print(title, soft_wrap=True)
    if survey.metadata:
        texts = ", ".join(f"{key} = {value}" for key, value in survey.metadata.items())
        console.print(printable(f"metadata: {texts}"), style="dim")
    _print_topics(survey, console)
    for line in _remarks(survey):
        console.print(printable(line))
    if found.system is not None:
        console.print()
        _print_suitability(found, console)
    console.print()


def _print_topics(survey: Survey, console: Console) -> None:
    """Two lines for each topic: numbers in columns, and its content below, where long names have room."""
    rows = [("topic", "messages", "rate", "longest gap")]
    rows += [(printable(t.name), f"{t.count:,}", _rate(t.rate), _gap(t)) for t in survey.topics]
    name, *widths = (max(len(row[i]) for row in rows) for i in range(4))
    for number, (row, topic) in enumerate(zip(rows, (None, *survey.topics), strict=True)):
        cells = "   ".join(text.rjust(width) for text, width in zip(row[1:], widths, strict=True))
        console.print(f"{row[0]:<{name}}   {cells}", style="dim" if number == 0 else "", soft_wrap=True)
        if topic is not None:
            console.print(Padding(_content(topic), (0, 0, 0, 4), expand=False))


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


def _content(topic: TopicSurvey) -> Text:
    """Type and clock of a topic, and which quantities it contains."""
    kind = printable(topic.type.replace("/msg/", "/"))
    if topic.problem:
        return Text.assemble((kind, "dim"), ": ", (printable(topic.problem), "yellow"))
    entries = topic.entries or tuple(topic.paths)
    shown = printable(and_more(entries, MAX_ENTRIES))
    if topic.encoding == "table":
        return Text(f"columns {shown}", style="dim")
    what = ", ".join(topic.quantities) or ("fields by path" if topic.paths else "no measurement")
    clock = f", {topic.clock} stamps" if topic.count else ""
    return Text(f"{kind}{clock}: {what}{f' of {shown}' if shown else ''}", style="dim")


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
        source = f"{check.signal.topic}, " if check.signal.topic else ""
        console.print(f"  {check.signal.name}: {source}{_needs(check.signal)}", soft_wrap=True)
        found_text = f"found, without gaps in {numbers.percent(check.valid)} of the time"
        answer = Text(check.problem or found_text, style="yellow" if check.problem else "green")
        console.print(Padding(answer, (0, 0, 0, 4), expand=False))
    for remark in found.remarks:
        console.print(printable(remark), style="yellow", soft_wrap=True)
    if found.usable:
        console.print(f"usable: {found.duration:.4g} s with all signals", style="green")
    else:
        missing = ", ".join(check.signal.name for check in found.checks if check.problem)
        console.print(
            f"not usable: {found.problem or f'{missing} cannot be read'}", style="yellow", soft_wrap=True
        )


def _needs(signal: Signal) -> str:
    names = f" of {', '.join(signal.names)}" if signal.names else ""
    return f"{', '.join(signal.quantities)}{names}"
