"""The result of an identification on a terminal: one table, one line on validation, where the files are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from amhe_cli.estimation.offline.result import HeldOut, Identification, ParameterResult
from amhe_cli.report import numbers, words

#: Colour of each verdict.
STYLES = {"identified": "green", "weak": "yellow", "prior": "dim", "model-sensitive": "magenta"}


#: Columns: heading, alignment, what stands in them.
_COLUMNS: tuple[tuple[str, Literal["left", "right"], Callable[[ParameterResult], str | Text]], ...] = (
    ("parameter", "left", lambda p: p.name),
    ("estimate ± sd", "right", lambda p: numbers.with_sd(p.estimate, p.sd)),
    ("unit", "left", lambda p: numbers.unit_of(p.unit)),
    ("90 % interval", "right", lambda p: numbers.interval(p.lower, p.upper)),
    ("prior", "right", lambda p: numbers.rounded(p.prior, p.prior_sd)),
    ("shrinkage", "right", lambda p: numbers.shrinkage(p.shrinkage)),
    ("verdict", "left", lambda p: Text(p.verdict, style=STYLES.get(p.verdict, ""))),
)


def print_identification(
    result: Identification, folder: Path, console: Console, truth: Mapping[str, float]
) -> None:
    """Print the parameters, what validation says, and where the files are."""
    _print_parameters(result, console)
    console.print()
    for parameter in result.parameters:
        if parameter.verdict != "identified" and parameter.reasons:
            console.print(f"{parameter.name}: {parameter.reasons[0]}", style="dim")
    for c in words.known_together(result)[: words.MAX_COMBINATIONS]:
        console.print(f"known together: {c.text} to {numbers.percent(c.sd)}")
    console.print(f"held-out: {held_out_line(result.held_out)}")
    if truth:
        console.print(truth_line(result, truth))
    if result.interrupted:
        console.print("interrupted: this is the best so far", style="yellow")
    console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)


def _print_parameters(result: Identification, console: Console) -> None:
    """Print the table; a narrow terminal gets fewer columns, never cut names or numbers."""
    for left_out in ((), ("prior",), ("prior", "shrinkage")):
        table = _parameters(result, left_out)
        width = console.measure(table, options=console.options.update(width=1000)).maximum
        if width <= console.width:
            break
    console.width = max(width, console.width)
    console.print(table)


def _parameters(result: Identification, left_out: Sequence[str]) -> Table:
    columns = [column for column in _COLUMNS if column[0] not in left_out]
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    for name, justify, _ in columns:
        table.add_column(name, justify=justify, no_wrap=True)
    for parameter in result.parameters:
        table.add_row(*(cell(parameter) for _, _, cell in columns))
    return table


def truth_line(result: Identification, truth: Mapping[str, float]) -> str:
    """'truth told by the log: mass 0.55, damping 0.03; outside its 90 % interval: damping'."""
    told = [p for p in result.parameters if p.name in truth]
    values = ", ".join(f"{p.name} {truth[p.name]:g}" for p in told)
    outside = [p.name for p in told if not p.lower <= truth[p.name] <= p.upper]
    verdict = f"outside the 90 % interval: {', '.join(outside)}" if outside else "inside all 90 % intervals"
    return f"truth told by the log: {values}; {verdict}"


def held_out_line(held_out: HeldOut | None) -> str:
    """'6 clips: cost 12.3 -> 1.04, position error 42 mm -> 9 mm'."""
    if held_out is None:
        return "nothing was held out; the fit is not validated"
    parts = [f"cost {held_out.initial_cost:.3g} -> {held_out.cost:.3g}"]
    pairs = (
        ("position error", numbers.length, held_out.initial_position_error_m, held_out.position_error_m),
        (
            "orientation error",
            numbers.angle,
            held_out.initial_orientation_error_rad,
            held_out.orientation_error_rad,
        ),
    )
    for name, form, before, after in pairs:
        if form(after) != numbers.MISSING:
            parts.append(f"{name} {form(before)} -> {form(after)}")
    return f"{held_out.clips} clip{'s' * (held_out.clips != 1)}: {', '.join(parts)}"
