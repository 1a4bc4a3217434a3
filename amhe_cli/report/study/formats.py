"""A table in forms for people and for programs."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amhe_cli.core.files import plain
from amhe_cli.core.text import printable

#: Characters with a special meaning in LaTeX, and how they are written.
_LATEX = {
    "\\": r"\textbackslash{}", "%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "$": r"\$",
    "±": r"$\pm$", "≤": r"$\le$", "≥": r"$\ge$", "–": "--", "×": r"$\times$", "−": "$-$",
}  # fmt: skip

#: What Markdown takes for markup; an underscore within a word is none, nor are brackets without a link.
_MARKUP = re.compile(r"[\\|<&`*~]|(?<=\])[(\[:]|(?<![^\W_])_|_(?![^\W_])")


@dataclass(frozen=True, slots=True)
class StudyTable:
    """Text for people, numbers for programs.

    Args:
        name: Name of its files.
        title: Title of the table.
        head: Headings of the columns.
        rows: Rows, with one text for each column.
        records: The same content as numbers, in long form.
        note: What a reader should know.
    """

    name: str
    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    records: Sequence[Mapping[str, Any]]
    note: str = ""


def text(table: StudyTable) -> str:
    """The table for a terminal: columns side by side, the first to the left."""
    lines = [table.head, *table.rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.head))]

    def laid(line: Sequence[str]) -> str:
        first, *rest = (cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        return "  ".join((line[0].ljust(len(first)), *rest)).rstrip()

    ruled = [laid(table.head), "-" * (sum(widths) + 2 * (len(widths) - 1)), *map(laid, table.rows)]
    return "\n".join((table.title, "", *ruled, *(["", table.note] if table.note else []))) + "\n"


def markdown(table: StudyTable) -> str:
    """The table for GitHub."""
    lines = [table.head, ("---", *["---:"] * (len(table.head) - 1)), *table.rows]
    body = ["| " + " | ".join(map(_unmarked, line)) + " |" for line in lines]
    title, note = _unmarked(table.title), _unmarked(table.note)
    return "\n".join((f"**{title}**", "", *body, *(["", note] if note else []))) + "\n"


def latex(table: StudyTable) -> str:
    """The table for a LaTeX paper that loads booktabs."""
    columns = "l" + "r" * (len(table.head) - 1)
    lines = [" & ".join(map(_escaped, line)) + r" \\" for line in (table.head, *table.rows)]
    return "\n".join(
        (
            r"\begin{table}[htbp]", r"  \centering", rf"  \caption{{{_escaped(table.title)}}}",
            rf"  \label{{tab:{table.name}}}", rf"  \begin{{tabular}}{{@{{}}{columns}@{{}}}}", r"    \toprule",
            f"    {lines[0]}", r"    \midrule", *(f"    {line}" for line in lines[1:]), r"    \bottomrule",
            r"  \end{tabular}", r"\end{table}", "",
        )
    )  # fmt: skip


def comma_separated(table: StudyTable) -> str:
    """The table as CSV, one row for each record."""
    out = io.StringIO()
    names = list(dict.fromkeys(name for record in table.records for name in record))
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(plain(record) for record in table.records)
    return out.getvalue()


def as_json(table: StudyTable) -> str:
    """The table as JSON: the numbers and the title."""
    record = {"name": table.name, "title": table.title, "note": table.note, "rows": plain(table.records)}
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


#: Suffix of a file -> function that makes its content.
FORMATS: Mapping[str, Callable[[StudyTable], str]] = {
    "txt": text, "md": markdown, "tex": latex, "csv": comma_separated, "json": as_json,
}  # fmt: skip


def _unmarked(words: str) -> str:
    """A text that Markdown shows as it is, in one line."""
    return _MARKUP.sub(r"\\\g<0>", printable(words))


def _escaped(words: str) -> str:
    return re.sub("|".join(map(re.escape, _LATEX)), lambda found: _LATEX[found[0]], words)
