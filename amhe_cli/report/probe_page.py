"""The page of a probe: its motions, what they reveal of the parameters, and what was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from amhe_cli.core.errors import AmheError
from amhe_cli.logs import read_log
from amhe_cli.report import numbers
from amhe_cli.report.folder import write_page
from amhe_cli.report.page import Section, Statement, cell, fixed_statement, result_page
from amhe_cli.report.probe import AT_BEST, has_achieved, known_table, motions, plain_heading, sd_text
from amhe_cli.report.shown import log_figure
from amhe_cli.report.tables import NUMBER, Table
from amhe_cli.system.system import System

#: A parameter that is told so much worse than by plain motion is named.
LITTLE = 0.9
#: So many motions are shown at once.
_FEW = 20


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
        headline=headline(record),
        statements=list(_statements(record)),
        sections=list(_sections(log, system, record)),
    )


def headline(record: Mapping[str, Any]) -> str:
    """What the probe tells, beside plain motion of the same length; 'Probe of 5 s: chirp 3: ...'."""
    key = "achieved_sd" if has_achieved(record) else "expected_sd"
    told = [
        (row["name"], row["plain_sd"] / row[key], *(sd_text(row, one) for one in ("plain", key[:-3])))
        for row in record["parameters"]
        if row.get("plain_sd") and row.get(key)
    ]
    if not told:
        return f"Probe of {motions(record)}."
    name, _, plain, own = max(told, key=lambda row: row[1])
    worse = [f"{other} {then} → {now}" for other, gain, then, now in told if gain < LITTLE]
    price = f", at the price of {numbers.joined(worse)}" if worse else ""
    return f"Probe of {motions(record)}. Against plain motion: {name} {plain} → {own}{price}."


def _statements(record: Mapping[str, Any]) -> Iterator[Statement]:
    if record["error"]:
        yield Statement("bad", f"The probe ended early: {record['error']}.")
    elif record["interrupted"]:
        yield Statement("mixed", "Interrupted: the log ends there.")
    if has_achieved(record):
        narrowed = [row["achieved_sd"] < 0.5 * row["prior_sd"] for row in record["parameters"]]
        text = f"The log at least halves the sd of {sum(narrowed)} of {len(narrowed)} parameters."
        yield Statement("good" if all(narrowed) else "mixed", text)
    yield Statement("mixed", f"Each number is the {AT_BEST}.")
    yield from fixed_statement(record["fixed"])


def _sections(log: Path, system: System, record: Mapping[str, Any]) -> Iterator[Section]:
    columns = {"prior": "prior sd", "expected": "expected", "plain": plain_heading(record)}
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
    looks = ("name", NUMBER, NUMBER, "soft wrap")
    yield Section("Motions", table=Table(("motion", "start [s]", "lasts [s]", ""), looks, rows))
    if tried := record.get("tried"):
        chosen = {part["name"] for part in record["sequence"]}
        rows = [
            (
                f"{one['name']}{' (chosen)' * (one['name'] in chosen)}",
                cell("bar", one["sd_over_prior"], numbers.percent(one["sd_over_prior"]), long=True),
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
