"""The outcome of a run on a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from amhe_cli.report import numbers, run_words


def print_run(record: Mapping[str, Any], title: str, folder: Path, console: Console) -> None:
    """Print the verdict, the measures, belief and truth, and where the files are.

    Args:
        record: Content of result.json.
        title: Of the task.
        folder: Of the files.
        console: On stdout.
    """
    tone, text = run_words.verdict(record)
    style = {"good": "green", "mixed": "yellow", "bad": "red"}[tone]
    console.print(Text.assemble((f"{record['task']} ({title}), mode {record['mode']}: "), (text, style)))
    console.print()
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    for name, justify in (("measure", "left"), ("value", "right"), ("unit", "left")):
        table.add_column(name, justify=justify, no_wrap=True)  # type: ignore[arg-type]
    for name, value, unit in run_words.measures(record):
        table.add_row(name, value, unit)
    console.print(table)
    console.print()
    console.print(belief_line(record))
    if (folder / "report.html").exists():
        console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)


def belief_line(record: Mapping[str, Any]) -> str:
    """'belief (truth): box_mass 2 (4), floor_friction 0.3 (0.6)'."""
    if not record["belief"]:
        return f"belief: {numbers.MISSING}"
    truth = record["truth"]
    told = [
        f"{name} {value:.3g}" + (f" ({truth[name]:.3g})" if name in truth else "")
        for name, value in record["belief"].items()
    ]
    return f"belief (truth) at the end: {', '.join(told)}"
