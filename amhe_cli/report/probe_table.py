"""A probe on a terminal: what is done, and how well the parameters are known before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from amhe_cli.report import numbers


def print_plan(record: Mapping[str, Any], console: Console) -> None:
    """Print the sequence and the expected posterior sd; `record` is the content of plan.json."""
    seconds = f"{record['probe_seconds']:g} s"
    names = ", ".join(part["name"] for part in record["sequence"])
    console.print(f"probe of {seconds}: {names}", soft_wrap=True)
    console.print()
    plain = record["plain_title"]
    print_known(record, {"prior": "prior sd", "expected": "expected", "plain": f"{seconds} {plain}"}, console)


def print_achieved(record: Mapping[str, Any], then: str, console: Console) -> None:
    """Print what the log tells beside what was expected, and the command that comes then; of result.json."""
    console.print()
    if all("achieved_sd" in row for row in record["parameters"]):
        columns = {"prior": "prior sd", "expected": "expected", "achieved": "achieved"}
        print_known(record, columns, console)
        console.print()
    console.print(Text(f"next: {then}", overflow="fold"), soft_wrap=True)


def print_known(known: Mapping[str, Any], columns: Mapping[str, str], console: Console) -> None:
    """Print sds, in percent where relative, one row a parameter and one for what is known together.

    Args:
        known: With `parameters` and `together` of plan.json or result.json.
        columns: Whose sd -> heading.
        console: On stdout.
    """
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("parameter", no_wrap=True)
    for heading in columns.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in known["parameters"]:
        table.add_row(row["name"], *_sds(row, columns, row["relative"], row["unit"]))
    if known["together"] is not None:
        table.add_row(known["together"]["name"], *_sds(known["together"], columns, True, ""))
    console.print(table)


def _sds(row: Mapping[str, Any], columns: Mapping[str, str], relative: bool, unit: str) -> Sequence[str]:
    def shown(sd: float | None) -> str:
        if sd is None:
            return "-"
        return numbers.percent(sd) if relative else numbers.quantity(numbers.rounded(sd, sd), unit)

    return [shown(row.get(f"{key}_sd")) for key in columns]
