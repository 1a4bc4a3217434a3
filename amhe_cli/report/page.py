"""A report: one page of HTML that opens without a network; its script only shows numbers and zooms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from amhe_cli.core.text import printable, script_digest
from amhe_cli.report import numbers
from amhe_cli.report.tables import Table

Tone = Literal["good", "mixed", "bad"]


@dataclass(frozen=True, slots=True)
class Statement:
    """A sentence, and whether it is good news."""

    tone: Tone
    text: str


def fixed_statement(fixed: Mapping[str, float], exact: Sequence[str] = ()) -> Iterator[Statement]:
    """Which parameters were taken as known."""
    if fixed:
        yield Statement("mixed", f"Taken as known, and not estimated: {numbers.named(fixed)}.")
    if exact:
        yield Statement("mixed", f"Taken as exact, by identify.assumed: {numbers.joined(exact)}.")


@dataclass(frozen=True, slots=True)
class Key:
    """One entry of a legend.

    Args:
        label: What the line, dot or area means.
        color: CSS colour.
        shape: 'solid', 'dashed' or 'dotted' line, 'dot' or 'patch'; '' for text alone.
    """

    label: str
    color: str = ""
    shape: Literal["solid", "dashed", "dotted", "dot", "patch", ""] = "solid"


@dataclass(frozen=True, slots=True)
class Fold:
    """A part of a section that the reader can open and close."""

    title: str
    content: Markup
    remark: str = ""
    open: bool = True


@dataclass(frozen=True, slots=True)
class Section:
    """A titled part of a page; everything below the title is optional and shown in this order.

    Args:
        title: Heading of the section.
        text: A paragraph.
        legend: The entries of a legend.
        table: A table.
        figure: An SVG element, as `figures.svg` makes it.
        natural: Whether the figure keeps its own width, instead of that of the page.
        folds: Parts that open and close.
        items: A list.
        files: Whether the items are names of files.
        note: A closing remark in small print.
        name: Anchor of the section, for links.
    """

    title: str
    text: str = ""
    legend: Sequence[Key] = ()
    table: Table | None = None
    figure: str = ""
    natural: bool = False
    folds: Sequence[Fold] = ()
    items: Sequence[str] = ()
    files: bool = False
    note: str = ""
    name: str = ""


@dataclass(frozen=True, slots=True)
class Origin:
    """How a result was made.

    Args:
        commands: The command lines.
        values: Seed, settings and versions, by name.
        hashes: SHA-256 of each file that was read, by path.
        note: A closing remark.
    """

    commands: Sequence[str]
    values: Mapping[str, object] = field(default_factory=dict)
    hashes: Mapping[str, str] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True, slots=True)
class Page:
    """The content of a report.

    Args:
        command: The command that made it, without 'amhe'.
        title: What the report is about.
        facts: The line below the title, in parts.
        headline: The result in one line.
        statements: What a reader should know first.
        sections: Tables and figures.
        warnings: Texts of the warnings.
        origin: How the result was made.
    """

    command: str
    title: str
    facts: Sequence[str]
    headline: str
    statements: Sequence[Statement]
    sections: Sequence[Section]
    warnings: Sequence[str]
    origin: Origin

    def html(self) -> str:
        """The page as HTML that needs no other file."""
        return template("page.html.j2").render(page=self, title=f"{self.title} · amhe {self.command}")


def result_page(
    record: Mapping[str, Any],
    provenance: Mapping[str, Any],
    *,
    title: str,
    facts: Sequence[str],
    headline: str,
    statements: Sequence[Statement],
    sections: Sequence[Section],
    settings: Mapping[str, object] | None = None,
) -> str:
    """The page of a command that writes a result.json.

    Args:
        record: Content of result.json: command, version, warnings.
        provenance: Time, command line, seed, versions, and hashes of files in groups.
        title, facts, headline, statements, sections: See `Page`.
        settings: Settings to list with the seed, by name.
    """
    versions = provenance["versions"]
    made = str(provenance["created"]).replace("T", " ").replace("+00:00", " UTC")
    hashes = {
        path: digest
        for group in ("inputs", "logs", "held_out_logs", "system_files")
        for path, digest in provenance.get(group, {}).items()
    }
    return Page(
        record["command"],
        title,
        (*facts, made, f"amhe {record['version']}, MuJoCo {versions['mujoco']}"),
        headline,
        statements,
        sections,
        record["warnings"],
        Origin(
            (provenance["command"],),
            {"seed": provenance["seed"], **(settings or {}), **versions},
            hashes,
        ),
    ).html()


@cache
def template(name: str) -> Any:
    """A template of this room."""
    environment = Environment(
        loader=PackageLoader("amhe_cli.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["digest"] = script_digest
    return environment.get_template(name)


def _shown(value: object) -> object:
    """What stands in the page for a value: a text without control characters; what is HTML stays as it is."""
    return printable(value, keep="\n") if type(value) is str else value


def cell(name: str, *content: object, **more: object) -> Markup:
    """A table cell with something drawn in it: a macro of cells.html.j2 and its arguments."""
    return getattr(template("cells.html.j2").module, name)(*content, **more)
