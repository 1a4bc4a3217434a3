"""A probe on a terminal: its motions, and how precisely the parameters are known before and after it."""

from __future__ import annotations

from collections.abc import Mapping
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
    seconds = f"{record['probe_seconds']:g} s"
    names = ", ".join(part["name"] for part in record["sequence"])
    console.print(f"probe of {seconds}: {names}", soft_wrap=True)
    console.print()
    plain = record["plain_title"]
    print_known(record, {"prior": "prior sd", "expected": "expected", "plain": f"{seconds} {plain}"}, console)
    console.print(AT_BEST, style="dim")


def print_achieved(record: Mapping[str, Any], following: str, console: Console) -> None:
    """Print the achieved beside the expected sds of a result.json, and the command to run next."""
    console.print()
    if all("achieved_sd" in row for row in record["parameters"]):
        columns = {"prior": "prior sd", "expected": "expected", "achieved": "achieved"}
        print_known(record, columns, console)
        console.print()
    console.print(Text(f"next: {following}", overflow="fold"), soft_wrap=True)


def print_known(known: Mapping[str, Any], columns: Mapping[str, str], console: Console) -> None:
    """Print sds, in percent where relative; one row for each parameter and one for their best combination.

    Args:
        known: `parameters` and `together` of plan.json or result.json.
        columns: Key of each sd, without '_sd' -> heading.
        console: Console on stdout.
    """
    if fixed := known.get("fixed"):
        console.print(f"fixed: {numbers.named(fixed)}")
    rows = [(row["name"], *_sds(row, columns, row["relative"], row["unit"])) for row in known["parameters"]]
    if (best := known["together"]) is not None:
        rows.append((best["name"], *_sds(best, columns, True, "")))
    looks = ("", *(NUMBER for _ in columns))
    console.print(rich_table(Table(("parameter", *columns.values()), looks, rows)))


def _sds(row: Mapping[str, Any], columns: Mapping[str, str], relative: bool, unit: str) -> list[str]:
    def shown(sd: float | None) -> str:
        if sd is None:
            return numbers.MISSING
        return numbers.percent(sd) if relative else numbers.quantity(numbers.rounded(sd, sd), unit)

    return [shown(row.get(f"{key}_sd")) for key in columns]
