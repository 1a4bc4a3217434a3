"""A table of a study: for a page and a terminal, as Markdown, LaTeX and CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amhe_cli.core.errors import printable
from amhe_cli.core.files import plain
from amhe_cli.report.tables import NUMBER, Table

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

    @property
    def table(self) -> Table:
        """Its rows."""
        return Table(self.head, ("", *(NUMBER for _ in self.head[1:])), self.rows)


def markdown(table: StudyTable) -> str:
    """The table for GitHub."""
    lines = [table.head, ("---", *["---:"] * (len(table.head) - 1)), *table.rows]
    body = ["| " + " | ".join(map(_unmarked, line)) + " |" for line in lines]
    title, note = _unmarked(table.title), _unmarked(table.note)
    return "\n".join((f"**{title}**", "", *body, *(["", note] if note else []))) + "\n"


def latex(table: StudyTable) -> str:
    """The table for a LaTeX paper that loads booktabs."""
    head, *lines = (" & ".join(map(_escaped, line)) + r" \\" for line in (table.head, *table.rows))
    rows = "\n    ".join((r"\toprule", head, r"\midrule", *lines, r"\bottomrule"))
    return rf"""\begin{{table}}[htbp]
  \centering
  \caption{{{_escaped(table.title)}}}
  \label{{tab:{table.name}}}
  \begin{{tabular}}{{@{{}}l{"r" * (len(table.head) - 1)}@{{}}}}
    {rows}
  \end{{tabular}}
\end{{table}}
"""


def comma_separated(table: StudyTable) -> str:
    """The table as CSV, one row for each record."""
    out = io.StringIO()
    names = list(dict.fromkeys(name for record in table.records for name in record))
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(plain(record) for record in table.records)
    return out.getvalue()


#: Suffix of a file -> what makes its content.
FORMATS = {"md": markdown, "tex": latex, "csv": comma_separated}


def _unmarked(words: str) -> str:
    """A text that Markdown shows as it is, in one line."""
    return _MARKUP.sub(r"\\\g<0>", printable(words))


def _escaped(words: str) -> str:
    return re.sub("|".join(map(re.escape, _LATEX)), lambda found: _LATEX[found[0]], words)
