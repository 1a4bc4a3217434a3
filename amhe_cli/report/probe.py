"""A probe: its motions, and how precisely the parameters are known before and after it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from amhe_cli.core.errors import AmheError
from amhe_cli.logs import read_log
from amhe_cli.report import numbers
from amhe_cli.report.folder import write_page
from amhe_cli.report.page import Section, Statement, fixed_statement, result_page
from amhe_cli.report.shown import log_figure
from amhe_cli.report.tables import NUMBER, Table, rich_table
from amhe_cli.system.system import System

#: What stands below the first table.
AT_BEST = (
    "sd at best, of noise alone under an exact model: amhe identify adds what rests on gains, limits and the "
    "time step"
)


def print_plan(record: Mapping[str, Any], console: Console) -> None:
    """Print the sequence of motions and the expected posterior sds; `record` is the content of plan.json."""
    console.print(_motions(record), soft_wrap=True)
    console.print()
    _print_known(record, {"prior": "prior sd", "expected": "expected", "plain": _plain(record)}, console)
    console.print(AT_BEST, style="dim")


def print_achieved(record: Mapping[str, Any], following: str, folder: Path, console: Console) -> None:
    """Print the achieved beside the expected sds of a result.json, the command to run next, and the page."""
    console.print()
    if _is_achieved(record):
        columns = {"prior": "prior sd", "expected": "expected", "achieved": "achieved"}
        _print_known(record, columns, console)
        console.print()
    console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)
    console.print(Text(f"next: {following}", overflow="fold"), soft_wrap=True)


def write_probe_page(folder: Path, log: str, system: System, record: Mapping[str, Any]) -> None:
    """Write report.html beside the results.

    Args:
        folder: Folder of the results.
        log: Name of the recorded log in it.
        system: The system that was probed.
        record: Content of result.json.
    """
    write_page(folder, lambda: _page(folder / log, system, record))


def _page(log: Path, system: System, record: Mapping[str, Any]) -> str:
    return result_page(
        record,
        record["provenance"],
        title=record["system"] + (f", task {record['task']}" if record["task"] else ""),
        facts=(f"target {record['target']}", f"seed {record['seed']}"),
        headline=f"P{_motions(record)[1:]}.",
        statements=list(_statements(record)),
        sections=list(_sections(log, system, record)),
    )


def _statements(record: Mapping[str, Any]) -> Iterator[Statement]:
    if record["error"]:
        yield Statement("bad", f"The probe ended early: {record['error']}.")
    elif record["interrupted"]:
        yield Statement("mixed", "Interrupted: the log ends there.")
    if _is_achieved(record):
        narrowed = [row["achieved_sd"] < 0.5 * row["prior_sd"] for row in record["parameters"]]
        text = f"The log at least halves the sd of {sum(narrowed)} of {len(narrowed)} parameters."
        yield Statement("good" if all(narrowed) else "mixed", text)
    yield Statement("mixed", f"Each number is the {AT_BEST}.")
    yield from fixed_statement(record["fixed"])


def _sections(log: Path, system: System, record: Mapping[str, Any]) -> Iterator[Section]:
    columns = {"prior": "prior sd", "expected": "expected", "plain": _plain(record)}
    columns |= {"achieved": "achieved"} if _is_achieved(record) else {}
    yield Section(
        "How precisely the parameters are known",
        text="Expected is the sd after the motion in simulation, under draws of the prior; achieved is that "
        "of the recorded log. In percent: of the value.",
        table=_known(record, columns),
    )
    rows = [
        (part["name"], f"{part['start']:g}", f"{part['seconds']:g}", part["title"])
        for part in record["sequence"]
    ]
    looks = ("name", NUMBER, NUMBER, "soft wrap")
    yield Section("Motions", table=Table(("motion", "start [s]", "lasts [s]", ""), looks, rows))
    try:
        recorded = read_log(log, system)
    except AmheError as error:
        yield Section("What was recorded", text=f"The log cannot be read: {error}")
    else:
        yield Section("What was recorded", figure=log_figure(recorded))


def _is_achieved(record: Mapping[str, Any]) -> bool:
    return all("achieved_sd" in row for row in record["parameters"])


def _motions(record: Mapping[str, Any]) -> str:
    names = ", ".join(part["name"] for part in record["sequence"])
    return f"probe of {record['probe_seconds']:g} s: {names}"


def _plain(record: Mapping[str, Any]) -> str:
    return f"{record['probe_seconds']:g} s {record['plain_title']}"


def _print_known(known: Mapping[str, Any], columns: Mapping[str, str], console: Console) -> None:
    if fixed := known.get("fixed"):
        console.print(f"fixed: {numbers.named(fixed)}")
    console.print(rich_table(_known(known, columns)))


def _known(known: Mapping[str, Any], columns: Mapping[str, str]) -> Table:
    """Sds, in percent where relative; one row for each parameter and one for their best combination.

    Args:
        known: `parameters` and `together` of plan.json or result.json.
        columns: Key of each sd, without '_sd' -> heading.
    """
    rows = [(row["name"], *_sds(row, columns)) for row in known["parameters"]]
    if (best := known["together"]) is not None:
        rows.append((best["name"], *_sds(best | {"relative": True, "unit": ""}, columns)))
    return Table(("parameter", *columns.values()), ("name", *(NUMBER for _ in columns)), rows)


def _sds(row: Mapping[str, Any], columns: Mapping[str, str]) -> list[str]:
    def shown(sd: float | None) -> str:
        if sd is None:
            return numbers.MISSING
        return (
            numbers.percent(sd) if row["relative"] else numbers.quantity(numbers.rounded(sd, sd), row["unit"])
        )

    return [shown(row.get(f"{key}_sd")) for key in columns]
