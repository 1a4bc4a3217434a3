"""What a model lacks, or a log has wrong: in result.json, on a terminal, and as a section of a page."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from amhe_cli.core.files import plain
from amhe_cli.estimation.core.result import Missing, MissingRow
from amhe_cli.report import numbers
from amhe_cli.report.figures import missing_figure
from amhe_cli.report.page import Key, Section
from amhe_cli.report.tables import NUMBER, STRONG, Table, rich_table


def missing_record(found: Missing | None) -> dict[str, Any] | None:
    """The key `missing` of result.json; None: the model misses nothing."""
    if found is None:
        return None
    names = ("kind", "place", "text", "share", "rivals", "repair")
    rows = [{name: getattr(row, name) for name in names} for row in found.rows]
    return plain({"rows": rows, "chance": found.chance, "tested": found.tested, "untested": found.untested})


def missing_table(found: Missing) -> Table:
    """One line for each cause: where, what, what it explains, and what would let the model have it."""
    return Table(
        ("where", "what the model lacks, or the log has wrong", "explains", "parameters that have it"),
        ("", STRONG, NUMBER, ""),
        [(row.place, _text(row), numbers.percent(row.share), _repair(row)) for row in found.rows],
    )


def _text(row: MissingRow) -> str:
    also = f" (or: {', '.join(row.rivals[:2])})" if row.rivals else ""
    return f"{row.text}{also}"


def _repair(row: MissingRow) -> str:
    return ", ".join(row.repair)


def rest(found: Missing) -> str:
    """What is said of all that was tested and explains nothing."""
    if found.untested:
        return f"what the model lacks was not looked for: {found.untested}"
    subject = "nothing else" if found.rows else "nothing"
    return f"{subject} of {found.tested} causes explains more than chance ({numbers.percent(found.chance)})"


def print_missing(found: Missing, console: Console) -> None:
    """Print the causes, and what was tested beside them."""
    if found.rows:
        console.print()
        console.print(rich_table(missing_table(found)))
    console.print(rest(found), style="dim")


def missing_section(found: Missing) -> Section:
    """The causes as a table, each with a picture of its force."""
    figure = missing_figure(found.rows)
    return Section(
        "What is missing",
        text="What explains the motion that the model does not, on parts of the logs that were not fitted. "
        "Each cause is fitted beside the parameters and the other causes.",
        legend=(Key("not explained without it", "#475569", "dot"), Key("the cause", "#2563eb", "dot"))
        if figure else (),
        table=missing_table(found) if found.rows else None,
        figure=figure or "",
        note=f"{rest(found).capitalize()}.",
        name="missing",
    )  # fmt: skip
