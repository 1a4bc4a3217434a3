"""A probe on a terminal: its motions, and how precisely the parameters are known before and after it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from amhe_cli.report import numbers
from amhe_cli.report.tables import NUMBER, Table, rich_table

#: What stands below the first table.
AT_BEST = (
    "sd at best, of noise alone under an exact model: amhe identify adds what rests on gains, limits and the "
    "time step"
)


def print_plan(record: Mapping[str, Any], console: Console) -> None:
    """Print the sequence of motions and the expected posterior sds; `record` is the content of plan.json."""
    console.print(f"probe of {motions(record)}", soft_wrap=True)
    console.print()
    _print_known(
        record, {"prior": "prior sd", "expected": "expected", "plain": plain_heading(record)}, console
    )
    console.print(AT_BEST, style="dim")


def print_achieved(record: Mapping[str, Any], following: str, folder: Path, console: Console) -> None:
    """Print the achieved beside the expected sds of a result.json, the command to run next, and the page."""
    console.print()
    if has_achieved(record):
        columns = {"prior": "prior sd", "expected": "expected", "achieved": "achieved"}
        _print_known(record, columns, console)
        console.print(AT_BEST, style="dim")
        console.print()
    console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)
    console.print(Text(f"next: {following}", overflow="fold"), soft_wrap=True)


def has_achieved(record: Mapping[str, Any]) -> bool:
    """Whether a result.json has what its log reveals."""
    return all("achieved_sd" in row for row in record["parameters"])


def motions(record: Mapping[str, Any]) -> str:
    """'20 s: push, turn'."""
    names = ", ".join(part["name"] for part in record["sequence"])
    return f"{record['probe_seconds']:g} s: {names}"


def plain_heading(record: Mapping[str, Any]) -> str:
    """Heading of the sds after a plain motion of the same length."""
    return f"{record['probe_seconds']:g} s {record['plain_title']}"


def _print_known(known: Mapping[str, Any], columns: Mapping[str, str], console: Console) -> None:
    if fixed := known.get("fixed"):
        console.print(f"fixed: {numbers.named(fixed)}")
    console.print(rich_table(known_table(known, columns)))


def known_table(known: Mapping[str, Any], columns: Mapping[str, str]) -> Table:
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
    return [sd_text(row, key) for key in columns]


def sd_text(row: Mapping[str, Any], key: str) -> str:
    """An sd of a parameter, in percent where it is relative."""
    sd = row.get(f"{key}_sd")
    if sd is None:
        return numbers.MISSING
    return numbers.percent(sd) if row["relative"] else numbers.quantity(numbers.rounded(sd, sd), row["unit"])
