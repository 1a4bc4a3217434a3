"""A probe on a terminal and on a page: its motions, and how precisely the parameters are known by it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from amhe_cli.core.errors import AmheError
from amhe_cli.logs import read_log
from amhe_cli.report import numbers
from amhe_cli.report.folder import write_page
from amhe_cli.report.page import Section, Statement, cell, fixed_statement, print_page, result_page
from amhe_cli.report.shown import log_figure
from amhe_cli.report.tables import NUMBER, Table, rich_table
from amhe_cli.system.system import System

#: What stands below the first table.
AT_BEST = (
    "sd at best, of noise alone under an exact model: amhe identify adds what rests on gains, limits and the "
    "time step"
)
#: A parameter that is known so much worse than by plain motion is named.
LITTLE = 0.9
#: So many motions are shown at once.
_FEW = 20


def print_plan(record: Mapping[str, Any], console: Console) -> None:
    """Print the sequence of motions and the expected posterior sds; `record` is the content of plan.json."""
    console.print(f"probe of {motions(record)}", soft_wrap=True)
    console.print()
    _print_known(record, planned_columns(record), console)
    console.print(AT_BEST, style="dim")


def print_achieved(record: Mapping[str, Any], following: str, folder: Path, console: Console) -> None:
    """Print the achieved beside the expected sds of a result.json, the command to run next, and the page."""
    console.print()
    if has_achieved(record):
        columns = {"prior": "prior sd", "expected": "expected", "achieved": "achieved"}
        _print_known(record, columns, console)
        console.print(AT_BEST, style="dim")
        console.print()
    print_page(folder, console)
    console.print(Text(f"next: {following}", overflow="fold"), soft_wrap=True)


def has_achieved(record: Mapping[str, Any]) -> bool:
    """Whether a result.json has what its log reveals."""
    return all("achieved_sd" in row for row in record["parameters"])


def motions(record: Mapping[str, Any]) -> str:
    """'20 s: push, turn'."""
    names = ", ".join(part["name"] for part in record["sequence"])
    return f"{record['probe_seconds']:g} s: {names}"


def planned_columns(record: Mapping[str, Any]) -> dict[str, str]:
    """Headings of the sds of a plan; those after a plain motion of the same length, where there is one."""
    plain = {"plain": f"{record['probe_seconds']:g} s {record['plain_title']}"}
    return {"prior": "prior sd", "expected": "expected"} | (plain if record["plain_title"] else {})


def _print_known(known: Mapping[str, Any], columns: Mapping[str, str], console: Console) -> None:
    if fixed := known.get("fixed"):
        console.print(f"fixed: {numbers.named(fixed)}")
    console.print(rich_table(known_table(known, columns)))


def known_table(known: Mapping[str, Any], columns: Mapping[str, str]) -> Table:
    """Sds, in percent where relative; one row for each parameter.

    Args:
        known: `parameters` of plan.json or result.json.
        columns: Key of each sd, without '_sd' -> heading.
    """
    rows = [(row["name"], *(sd_text(row, key) for key in columns)) for row in known["parameters"]]
    return Table(("parameter", *columns.values()), ("name", *(NUMBER for _ in columns)), rows)


def sd_text(row: Mapping[str, Any], key: str) -> str:
    """An sd of a parameter, in percent where it is relative."""
    sd = row.get(f"{key}_sd")
    if sd is None:
        return numbers.MISSING
    return numbers.percent(sd) if row["relative"] else numbers.quantity(numbers.rounded(sd, sd), row["unit"])


def write_probe_page(folder: Path, log: str, system: System, record: Mapping[str, Any]) -> None:
    """Write report.html beside the results; `log` is the name of the recorded log there."""
    write_page(folder, lambda: _page(folder / log, system, record))


def _page(log: Path, system: System, record: Mapping[str, Any]) -> str:
    return result_page(
        record,
        record["provenance"],
        title=record["system"] + (f", task {record['task']}" if record["task"] else ""),
        facts=(f"target {record['target']}", f"seed {record['seed']}"),
        headline=headline(record),
        statements=list(_statements(record)),
        sections=list(_sections(log, system, record)),
    )


def headline(record: Mapping[str, Any]) -> str:
    """What the probe shows, beside plain motion of the same length; 'Probe of 5 s: chirp 3: ...'."""
    told = [
        (row["name"], row["plain_sd"] / row["expected_sd"], sd_text(row, "plain"), sd_text(row, "expected"))
        for row in record["parameters"]
        if row.get("plain_sd") and row.get("expected_sd")
    ]
    if not told:
        return f"Probe of {motions(record)}."
    name, _, plain, own = max(told, key=lambda row: row[1])
    worse = [f"{other} {then} → {now}" for other, gain, then, now in told if gain < LITTLE]
    price = f", at the price of {numbers.joined(worse)}" if worse else ""
    return f"Probe of {motions(record)}. Expected sd against plain motion's: {name} {plain} → {own}{price}."


def _statements(record: Mapping[str, Any]) -> Iterator[Statement]:
    if record["error"]:
        yield Statement("bad", f"The probe ended early: {record['error']}.")
    elif record["interrupted"]:
        yield Statement("mixed", "Interrupted: the log ends there.")
    if has_achieved(record):
        narrowed = [row["achieved_sd"] < 0.5 * row["prior_sd"] for row in record["parameters"]]
        text = f"The log at least halves the sd of {sum(narrowed)} of {len(narrowed)} parameters."
        yield Statement("good" if all(narrowed) else "mixed", text)
    tried = {one["name"]: one["sd_over_prior"] for one in record.get("tried") or ()}
    chosen = [tried.get(part["name"], 0.0) for part in record["sequence"]]
    if tried.get(record["plain_title"], math.inf) < min(chosen):
        yield Statement("mixed", "Plain motion is as good here: raise `probe.candidates`, or take longer.")
    yield Statement("mixed", f"Each number is the {AT_BEST}.")
    yield from fixed_statement(record["fixed"])


def _sections(log: Path, system: System, record: Mapping[str, Any]) -> Iterator[Section]:
    columns = planned_columns(record)
    columns |= {"achieved": "achieved"} if has_achieved(record) else {}
    yield Section(
        "How precisely the parameters are known",
        text="Expected is the sd after the motion in simulation, under draws of the prior; achieved is that "
        "of the recorded log. In percent: of the value.",
        table=known_table(record, columns),
    )
    rows = [
        (part["name"], f"{part['start']:g}", f"{part['seconds']:g}", part["title"])
        for part in record["sequence"]
    ]
    looks = ("name", NUMBER, NUMBER, "soft text")
    yield Section("Motions", table=Table(("motion", "start [s]", "lasts [s]", ""), looks, rows))
    if tried := record.get("tried"):
        most = max(one["sd_over_prior"] for one in tried)
        chosen, of_plain = {part["name"] for part in record["sequence"]}, record["plain_title"]
        plain = " (plain motion, to compare with)"
        rows = [
            (
                f"{one['name']}{' (chosen)' * (one['name'] in chosen)}{plain * (one['name'] == of_plain)}",
                cell("bar", one["sd_over_prior"] / most, numbers.percent(one["sd_over_prior"]), long=True),
            )
            for one in sorted(tried, key=lambda one: one["sd_over_prior"])
        ]
        yield Section(
            "What was tried",
            text="The sd that each motion would leave of all parameters together, as a share of the "
            "prior's (geometric mean): shorter is better.",
            table=Table(("motion", "sd over the prior's"), ("name", ""), rows),
            folded=len(rows) > _FEW,
        )
    try:
        recorded = read_log(log, system)
    except AmheError as error:
        yield Section("What was recorded", text=f"The log cannot be read: {error}")
    else:
        yield Section("What was recorded", figure=log_figure(recorded))
