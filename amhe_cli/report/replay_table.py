"""The outcome of a replay on a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from amhe_cli.report import numbers, replay_words


def print_replay(record: Mapping[str, Any], folder: Path, console: Console) -> None:
    """Print the parameters at the end, what became of the windows, and where the files are.

    Args:
        record: Content of result.json.
        folder: Of the files.
        console: On stdout.
    """
    console.print(f"{record['log']}, at {record['end_s']:.2f} s", soft_wrap=True)
    console.print()
    console.print(_table(record["parameters"]))
    console.print()
    for c in record["combinations"]:
        console.print(f"known together: {c['text']} to {numbers.percent(c['sd'])}")
    console.print(replay_words.windows_line(record))
    console.print(speed_line(record))
    if record["interrupted"]:
        console.print("interrupted: these are the estimates up to there", style="yellow")
    console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)


def _table(parameters: list[Mapping[str, Any]]) -> Table:
    told = any(p["truth"] is not None for p in parameters)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("parameter", no_wrap=True)
    table.add_column("estimate ± sd", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("90 % interval", justify="right", no_wrap=True)
    table.add_column("start", justify="right", no_wrap=True)
    if told:
        table.add_column("truth", justify="right", no_wrap=True)
        table.add_column("coverage", justify="right", no_wrap=True)
    for p in parameters:
        cells = [
            p["name"],
            numbers.with_sd(p["estimate"], p["sd"]),
            numbers.unit_of(p["unit"]),
            numbers.interval(p["lower"], p["upper"]),
            f"{p['start']:.3g}",
        ]
        if told:
            cells += [_true(p), numbers.MISSING if p["coverage"] is None else numbers.percent(p["coverage"])]
        table.add_row(*cells)
    return table


def _true(parameter: Mapping[str, Any]) -> str:
    return numbers.MISSING if parameter["truth"] is None else f"{parameter['truth']:.4g}"


def speed_line(record: Mapping[str, Any]) -> str:
    """'4.1 times real time; an update takes 35 ms (median), 52 ms (99 %)'."""
    ms = record["update_ms"]
    took = [numbers.MISSING if ms[key] is None else f"{ms[key]:.0f} ms" for key in ("p50", "p99")]
    factor = record["real_time_factor"]
    return f"{factor:.1f} times real time; an update takes {took[0]} (median), {took[1]} (99 %)"
