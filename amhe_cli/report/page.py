"""A report: one page of HTML, with the sentence and the table first, and the rest in parts that fold."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from markupsafe import Markup
from rich.console import Console
from rich.text import Text

from amhe_cli.report import numbers
from amhe_cli.report.tables import Table, rich_table
from amhe_cli.web.page import template

Tone = Literal["good", "mixed", "bad"]


@dataclass(frozen=True, slots=True)
class Statement:
    """A sentence, and whether it is good news; a link behind it where there is more."""

    tone: Tone
    text: str
    link: str = ""


def print_result(
    head: str | Text, table: Table, statements: Iterable[Statement], folder: Path, console: Console
) -> None:
    """Print what the page of a result says first, in the colour of its news, and where it is."""
    styles: Mapping[Tone, str] = {"good": "", "mixed": "yellow", "bad": "red"}
    console.print(head, soft_wrap=True)
    console.print()
    console.print(rich_table(table))
    console.print()
    for one in statements:
        console.print(one.text, style=styles[one.tone], soft_wrap=True)
    print_page(folder, console)


def print_page(folder: Path, console: Console) -> None:
    """Print where the page in a folder is, unless it could not be made."""
    if (folder / "report.html").exists():
        console.print(Text(f"report: {folder / 'report.html'}", overflow="fold"), soft_wrap=True)


def fixed_statement(fixed: Mapping[str, float], exact: Sequence[str] = ()) -> Iterator[Statement]:
    """Which parameters were taken as known."""
    if fixed:
        yield Statement("mixed", f"Taken as known, and not estimated: {numbers.named(fixed)}.")
    if exact:
        yield Statement("mixed", f"Taken as exact, by identify.assumed: {numbers.joined(exact)}.")


def diverged_statement(diverged: int, count: int) -> Iterator[Statement]:
    """How many of some rollouts diverged, if any did."""
    if diverged:
        share = numbers.percent(diverged / max(count, 1))
        text = f"{diverged:,} of {count:,} rollouts ({share}) diverged and were left out."
        yield Statement("mixed" if diverged > 0.05 * count else "good", text)


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of a page; everything below the title is optional and shown in this order.

    Args:
        title: Heading of the section.
        text: A paragraph.
        table: A table.
        figure: Figures, as `web.plots.figure` makes them.
        items: A list.
        files: Whether the items are names of files, or commands.
        note: A closing remark in small print.
        folded: The reader opens it; None: it does not fold.
        remark: What stands behind the title.
    """

    title: str
    text: str = ""
    table: Table | None = None
    figure: Markup | str = ""
    items: Sequence[str] = ()
    files: bool = False
    note: str = ""
    folded: bool | None = None
    remark: str = ""

    @property
    def name(self) -> str:
        """Anchor of the section, for links: 'held-out' of 'Held out'."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-")


def page(
    command: str,
    *,
    title: str,
    facts: Sequence[str],
    headline: str,
    statements: Sequence[Statement],
    sections: Sequence[Section],
    warnings: Sequence[str] = (),
) -> str:
    """A report as HTML that needs no other file.

    Args:
        command: The command that made it, without 'amhe'.
        title: What the report is about.
        facts: The line below the title, in parts.
        headline: The result in one line.
        statements: What a reader should know first.
        sections: Tables and figures.
        warnings: Texts of the warnings.
    """
    sections = [*sections]
    if warnings:
        more = Section("Warnings", items=warnings)
        statements = [
            *statements,
            Statement("mixed", f"{len(warnings)} warning{'s' * (len(warnings) > 1)}", more.name),
        ]
        sections.insert(-1, more)
    return template("page.html.j2").render(
        command=command, title=f"{title} · amhe {command}", heading=title, facts=facts, headline=headline,
        statements=statements, sections=sections,
        ghosts=any('class="ghosts"' in one.figure for one in sections),
    )  # fmt: skip


def result_page(
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
    *,
    sections: Sequence[Section],
    facts: Sequence[str],
    settings: Mapping[str, object] | None = None,
    **more: Any,
) -> str:
    """The page of a command that writes a result.json.

    Args:
        record: Content of result.json: command, version, warnings.
        provenance: Time, command line, seed, versions, and hashes of files in groups.
        sections, facts: See `page`.
        settings: Settings to list with the seed, by name.
        more: Further arguments of `page`.
    """
    made = str(provenance["created"]).replace("T", " ").replace("+00:00", " UTC")
    versions = provenance["versions"]
    values = {"seed": provenance["seed"], **(settings or {}), **versions}
    groups = ("inputs", "logs", "held_out_logs", "system_files")
    files = {path: digest for group in groups for path, digest in provenance.get(group, {}).items()}
    rows = [(name, str(value)) for name, value in values.items()]
    rows += [(f"SHA-256 of {path}", digest) for path, digest in files.items()]
    origin = Section(
        "How it was made",
        items=[str(provenance["command"])],
        files=True,
        table=Table(("", ""), ("", "hash"), rows),
        folded=True,
        remark="command, versions, files",
    )
    return page(
        record["command"],
        facts=(*facts, made, f"amhe {record['version']}, MuJoCo {versions['mujoco']}"),
        sections=[*sections, origin],
        warnings=record["warnings"],
        **more,
    )


def cell(name: str, *content: object, **more: object) -> Markup:
    """A table cell with something drawn in it: a macro of cells.html.j2 and its arguments."""
    return getattr(template("cells.html.j2").module, name)(*content, **more)
