"""What a model lacks, or a log has wrong: in result.json, on a terminal, and as a section of a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Console

from amhe_cli.core.files import plain
from amhe_cli.estimation.core.result import AtHorizon, Missing, MissingRow, Repair
from amhe_cli.report import numbers
from amhe_cli.report.comparison import heads, horizon_record, together
from amhe_cli.report.figures import missing_figure
from amhe_cli.report.held_out import sized
from amhe_cli.report.page import Section, Statement, page
from amhe_cli.report.tables import NUMBER, STRONG, TEXT, Table, rich_table


def missing_record(found: Missing | None) -> dict[str, Any] | None:
    """The key `missing` of result.json; None: the model misses nothing."""
    if found is None:
        return None
    names = ("name", "kind", "place", "text", "share", "rivals", "repair")
    rows = [{name: getattr(row, name) for name in names} for row in found.rows]
    rest = {name: getattr(found, name) for name in ("chance", "tested", "untested", "looked")}
    return plain({"rows": rows, **rest})


def missing_table(found: Missing) -> Table:
    """One line for each cause: where, what, what it explains, and what `--repair` calls it."""
    return Table(
        ("where", "what the model lacks, or the log has wrong", "explains", "repair"),
        ("", TEXT, NUMBER, ""),
        [
            (row.place, _text(row), numbers.percent(row.share), row.name if row.repair else "")
            for row in found.rows
        ],
    )


def _text(row: MissingRow) -> str:
    also = f" (or: {', '.join(row.rivals[:2])})" if row.rivals else ""
    return f"{row.text}{also}"


def rest(found: Missing) -> str:
    """What is said of all that was tested and explains nothing."""
    if found.untested:
        return f"what the model lacks was not looked for: {found.untested}"
    subject = "nothing else" if found.rows else "nothing"
    text = f"{subject} of {found.tested} causes explains more than chance"
    text += f" ({numbers.percent(found.chance)})" if found.chance < 1.0 else ""
    if found.looked == 1.0:
        return text
    where = f"the {numbers.percent(found.looked)} of the motion in which nothing touches"
    return f"{text}; looked at: {where}, as the forces of contacts are the model's own"


def repairs_record(tried: Sequence[Repair]) -> list[dict[str, Any]]:
    """The key `repairs` of result.json."""
    names = ("name", "text", "parameters", "kept", "verdict")
    return [
        {name: getattr(one, name) for name in names}
        | {"horizons": [horizon_record(("before", one.name), at, 0) for at in one.horizons]}
        for one in tried
    ]


def repairs_table(tried: Sequence[Repair]) -> Table:
    """The models in the order in which they were tried, with their rms errors on held-out clips."""
    horizons = next((one.horizons for one in tried if one.horizons), ())
    rows = [("the model as given", *_errors(horizons, 0), "")]
    names = [one.name if one.parameters or one.kept else "" for one in tried]
    for i, one in enumerate(tried):
        dropped = f"without {one.name}" in names and one.name not in names[i + 1 :]
        said = "kept" if one.kept else "dropped later" if dropped else "not kept"
        label = one.name if one.name.startswith("without") else f"with {one.name}"
        errors = _errors(one.horizons, 1) or [numbers.MISSING] * len(horizons)
        rows.append((label, *errors, said))
    looks = ("name", *(NUMBER for _ in horizons), STRONG)
    return Table(("model", *heads(horizons), ""), looks, rows)


def _errors(horizons: Sequence[AtHorizon], i: int) -> list[str]:
    """Rms errors of one of two models at each horizon, over all joints and poses of a unit."""
    units = [dict.fromkeys(unit for _, unit in at.errors) for at in horizons]
    return [
        ", ".join(sized(together(at, i, unit), unit) for unit in own)
        for at, own in zip(horizons, units, strict=True)
    ]


def _verdicts(tried: Sequence[Repair]) -> list[str]:
    return [f"{one.name} ({one.text}): {one.verdict}" for one in tried]


def print_missing(found: Missing, console: Console) -> None:
    """Print the causes, and what was tested beside them."""
    if found.rows:
        console.print()
        console.print(rich_table(missing_table(found)))
    console.print(rest(found), style="dim")


def print_repairs(tried: Sequence[Repair], console: Console) -> None:
    """Print what was tried, and what held-out clips say of it."""
    console.print()
    console.print(rich_table(repairs_table(tried)))
    for text in _verdicts(tried):
        console.print(text, style="dim", soft_wrap=True)


def repairs_section(tried: Sequence[Repair]) -> Section:
    """The models that were tried."""
    kept = any(one.kept for one in tried)
    copy = " The folder system beside this page is a copy of the system with what was kept." * kept
    return Section(
        "What was repaired",
        text="Each cause was added to the model before it, and all was identified again. It was kept where "
        f"the error of clips that were not fitted fell by more than chance.{copy}",
        table=repairs_table(tried),
        items=_verdicts(tried),
        folded=False,
    )


def missing_section(found: Missing) -> Section:
    """The causes as a table, each with a picture of its force."""
    return Section(
        "What is missing",
        text="What explains the motion that the model does not, on parts of the logs that were not fitted. "
        "Each cause is fitted beside the parameters and the other causes. Drawn is the force or torque "
        "that is left [N, N m], against what the cause depends on.",
        table=missing_table(found) if found.rows else None,
        figure=missing_figure(found.rows),
        note=f"{rest(found).capitalize()}.",
        folded=not found.rows,
    )


def missing_page(source: str, found: Missing, command: str) -> str:
    """The page of `amhe explain`.

    Args:
        source: Name of the result.
        found: What it lacks.
        command: The command line.
    """
    most, tried = found.rows[:1], [row.name for row in found.rows if row.repair]
    lacks = [f"{numbers.percent(one.share)} of what the model misses: {one.text}." for one in most]
    cure = f"amhe identify with --repair tries {numbers.some(tried)}." if tried else ""
    return page(
        "explain",
        title=source,
        facts=(f"causes tried: {found.tested}",) if found.tested else (),
        headline=lacks[0] if lacks else f"{rest(found).capitalize()}.",
        statements=[Statement("mixed", cure)] if cure else [],
        sections=[
            *([missing_section(found)] if found.rows else []),
            Section("How it was made", items=[command], files=True, folded=True),
        ],
    )
